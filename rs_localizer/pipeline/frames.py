# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A frame from message to pose, shared by the live node and the offline replay.

Both feed their messages to a :class:`FrameLocalizer` and publish what
:func:`rs_localizer.io.outputs.messages` makes of the result, so that both say the same. What a
camera and a rig share stands here; ``CameraFrames`` and ``RigFrames`` localize. Poses are those of
``base_frame``.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping

import numpy as np

from rs_localizer.config import NodeConfig
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Notice
from rs_localizer.core.types import Estimate
from rs_localizer.io.camera_info import Calibration
from rs_localizer.io.clouds import Correspondences, select_inliers, thin_cloud
from rs_localizer.io.outputs import Localized
from rs_localizer.io.topics import CAMERA_INFO, MAP_POINTS
from rs_localizer.io.transforms import Transforms, TransformTree
from rs_localizer.pipeline.aid import AidInput
from rs_localizer.pipeline.cloud_checks import oddities
from rs_localizer.pipeline.keypoint_map import Landmarks, read_landmarks
from rs_localizer.pipeline.pose_at_time import PublishedMoment, published_motion
from rs_localizer.pipeline.published import is_mounting_late, of_body
from rs_localizer.pipeline.refusal import Notify, Refusal, unheard
from rs_localizer.pipeline.stream import Stream
from rs_localizer.pipeline.what_fits import Mistakes
from rs_localizer.settings import in_effect, of_estimates
from rs_localizer.tracking import Tracker

ANY_CALIBRATION = Calibration(
    "camera", 640, 480, (500.0, 0.0, 319.5, 0.0, 500.0, 239.5, 0.0, 0.0, 1.0), (), "plumb_bob",
    (1, 1), None,
)  # fmt: skip
"""Stands in until the first camera_info: settings are checked before it."""


class FrameLocalizer(ABC):
    """Localizes frames with the latest cameras, map and settings.

    With ``tracking``, readout times and a rolling-shutter solver it remembers the previous frame;
    new settings, a new camera, points in another frame and a time before the last one start it
    afresh.

    Args:
        config: settings; :meth:`change` takes others.
        notice: called with oddities that are no refusal.
        transforms: where the cameras are on ``base_frame``; asked once a frame, so that a mounting
            may change and move. Without it there is none.

    Raises:
        ValueError: for settings that the localizer refuses.
    """

    def __init__(
        self, config: NodeConfig, notice: Notify = unheard, transforms: Transforms | None = None
    ) -> None:
        self._notice = notice
        self.transforms: Transforms = TransformTree() if transforms is None else transforms
        self.aid: AidInput = AidInput(notice)
        self.calibrations: dict[str, Calibration] = {}
        """What the last usable camera_info of each camera said; of one without a name: ``""``."""
        self.landmarks = Landmarks(notice)
        self._lenses: dict[str, Camera] = {}  # of camera_file
        self.stream = Stream(notice, self._forget_motion)
        self.config = in_effect(config)
        self._apply_settings(self.config)

    @abstractmethod
    def _new_tracker(self, config: NodeConfig, cameras: Mapping[str, Camera]) -> Tracker:
        """Return the tracker of these settings; raises ValueError for those that it refuses."""

    @abstractmethod
    def _forget_frames(self) -> None:
        """Forget the previous frames, except their motion."""

    @abstractmethod
    def flush(self) -> list[Localized | Refusal]:
        """Return the results of frames that still wait for others: none will come."""

    def change(self, config: NodeConfig) -> bool:
        """Use these settings from the next frame on; whether they start the track afresh.

        What no frame's estimate depends on, as of outputs and transforms, leaves track, aid and
        shutter watch as they are.
        """
        config = in_effect(config)
        if of_estimates(config) == of_estimates(self.config):
            self.config = config
            return False
        self._apply_settings(config)
        return True

    def _apply_settings(self, config: NodeConfig) -> None:
        # If this raises, nothing changes: cameras, tracker and settings always belong together.
        cameras = {
            name: self.calibrations.get(name, ANY_CALIBRATION).camera(
                own.readout_time, own.scan_direction
            )
            for name, own in config.shutters.items()
        }
        self.tracker = self._new_tracker(config, cameras)
        self._cameras, self.config = cameras, config
        self._forget_frames()
        self._mistakes = Mistakes(self._notice)

    @property
    def calibration(self) -> Calibration | None:
        """The last usable calibration of the first camera."""
        return self.calibrations.get(self.config.cameras[0])

    @property
    def camera_frame(self) -> str:
        """The optical frame of the first camera that is known; empty as long as none is."""
        known = (self.calibrations.get(name) for name in self.config.cameras)
        return next((calibration.frame for calibration in known if calibration), "")

    @property
    def missing(self) -> tuple[str, ...]:
        """The inputs that have to come before a frame can be localized."""
        infos = tuple(f"{name}/{CAMERA_INFO}".lstrip("/") for name in self.config.cameras)
        infos = () if self.calibrations else infos
        return (*infos, MAP_POINTS) if self.landmarks.lacking else infos

    @property
    def map_points(self) -> Array | None:
        """Landmarks (n,3), or corners (n,4,3) of markers; None: correspondences bring their own."""
        return None if self.landmarks.map is None else self.landmarks.map.points

    def describe(self) -> tuple[dict[str, str], dict[str, str]]:
        """Return values for people, and what is odd, by readable names."""
        watch, values, odd = self.tracker.shutter, self.aid.values(), self.aid.oddities()
        if watch.fault:
            odd["readout_time"] = watch.fault
        if (seen := watch.measured) is not None:
            readout, deviation = 1e3 * seen.readout_time, 1e3 * seen.deviation
            values["Readout time seen (ms)"] = f"{readout:.2f} +- {deviation:.2f}"
        return values, odd

    def reset(self) -> None:
        """Forget the previous frames."""
        self.stream.reset()
        self._forget_motion()

    def _forget_motion(self) -> None:
        self._forget_frames()
        self.tracker.reset()

    def calibrate(self, calibration: Calibration, name: str = "") -> None:
        """Use this calibration of a camera from the next frame on.

        Raises:
            MessageError: for one that no camera can have; the previous stays.
        """
        before = self.calibrations.get(name)
        if name in self._lenses:
            calibration = calibration.with_lens(self._lenses[name])
        if calibration == before:  # drivers repeat it with every image
            return
        own = self.config.shutters[name]
        self._cameras[name] = calibration.camera(own.readout_time, own.scan_direction)
        self._use_camera(name, calibration)
        if before is not None:
            of = f" of {name}" if name else ""
            self._notice(
                Notice.CAMERA_CHANGED,
                f"camera_info{of} changed from {before.frame!r}, {before.width} x {before.height}, "
                f"to {calibration.frame!r}, {calibration.width} x {calibration.height}; the "
                "previous frames are forgotten (if it goes to and fro, two cameras publish it)",
            )

    def _use_camera(self, name: str, calibration: Calibration) -> None:
        self.calibrations[name] = calibration
        self._apply_settings(self.config)

    def awaits_readings(self, stamp_ns: int, patience: float) -> bool:
        """Return True if readings of this frame may come within this many seconds."""
        return False

    def patience(self, stamp_ns: int) -> float:
        """Return how long (s) a frame with this stamp waits for what may come yet; 0: not at all.

        That are readings of its exposure, and the mounting at its last row.
        """
        config = self.config
        if self.awaits_readings(stamp_ns, config.imu.wait):
            return config.imu.wait
        last_ns = stamp_ns + round(1e9 * (config.stamp_offset + config.readout_time))
        late = is_mounting_late(self.transforms, self.camera_frame, config.base_frame, last_ns)
        return config.transform_tolerance if late else 0.0

    def load_files(self) -> None:
        """Use ``camera_file`` and the map ``map_file`` of the settings, if any.

        Raises:
            ValueError: for a file that cannot be read or holds no such map.
        """
        if file := self.config.camera_file:
            from rs_localizer.io.camera_files import read_calibration

            for name in self.config.cameras:
                self._lenses[name] = read_calibration(f"{file}#{name}" if name else file)
        if self.config.map_file:
            self.landmarks.use_map(read_landmarks(self.config.map_file, self.config.map_frame))

    def _result(
        self, cloud: Correspondences, estimate: Estimate, moment: PublishedMoment
    ) -> Localized | Refusal:
        """Return pose and twist of ``base_frame`` at a moment.

        Args:
            cloud: with the rows of the estimate, or with none.
            estimate: of the first camera.
            moment: for which they are valid.
        """
        config, shutter = self.config, self.tracker.shutter
        first = next(iter(self._cameras.values()))
        pose, twist = published_motion(estimate, moment, config, first, shutter)
        seen = np.asarray(estimate.inliers) if len(cloud.table) else np.zeros(0, np.bool_)
        inliers = select_inliers(cloud.table, seen, np.asarray(estimate.residuals))
        of_camera = Localized(
            cloud.stamp_ns, moment.stamp_ns, cloud.frame, self.camera_frame, pose, twist, inliers,
            cloud.dropped, estimate,
        )  # fmt: skip
        return of_body(of_camera, config, self.transforms)

    def _checked(self, cloud: Correspondences, name: str = "") -> Correspondences:
        """Return at most a camera's part of ``max_points``, and give notice of what is odd."""
        camera, most = self._cameras[name], self.config.max_points // len(self._cameras)
        odd = oddities(cloud, camera, self.calibrations[name].frame, most)
        for notice, text in odd.items():
            self._notice(notice, f"{name}: {text}" if name else text)
        return thin_cloud(cloud, most, camera.size)
