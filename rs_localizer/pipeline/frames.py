"""A frame from message to pose: what the live node and the offline replay share.

Both feed their messages to a :class:`FrameLocalizer` and publish what
:func:`rs_localizer.io.outputs.messages` makes of the result, so that both say the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rs_localizer import matching
from rs_localizer.config import MatchBy, NodeConfig
from rs_localizer.core import so3
from rs_localizer.core.camera import Camera
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.prior import Prior
from rs_localizer.io.camera_info import Calibration, read_camera_info
from rs_localizer.io.clouds import (
    Correspondences,
    EmptyCloudError,
    read_correspondences,
)
from rs_localizer.io.imu import read_imu
from rs_localizer.io.keypoints import Keypoints, read_keypoints, read_map
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.messages import MessageError
from rs_localizer.io.outputs import Localized
from rs_localizer.io.topics import CAMERA_INFO, MAP_POINTS
from rs_localizer.io.transforms.rigid import Transforms
from rs_localizer.io.transforms.tree import TransformTree
from rs_localizer.localizer import Localizer
from rs_localizer.matching import Matcher, MatchError
from rs_localizer.pipeline.clock import middle_row_ns
from rs_localizer.pipeline.imu import ImuInput, inertial_settings
from rs_localizer.pipeline.maps import oddities_of_map, read_landmarks
from rs_localizer.pipeline.moments import pose_at, twist_at
from rs_localizer.pipeline.oddities import oddities
from rs_localizer.pipeline.published import NO_TRANSFORM, of_body, of_camera
from rs_localizer.pipeline.readout_watch import ReadoutWatch
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.solvers.table import find_solver
from rs_localizer.tracking import Tracker

# Stands in until the first CameraInfo: kernels are compiled and settings checked before it comes.
_ANY_CALIBRATION = Calibration(
    "camera", 640, 480, (500.0, 0.0, 319.5, 0.0, 500.0, 239.5, 0.0, 0.0, 1.0), (), "plumb_bob",
    (1, 1), None,
)  # fmt: skip
# Something to publish before there is anything.
_STILL = Estimate(
    rotation=np.eye(3),
    translation=np.zeros(3),
    angular_velocity=np.zeros(3),
    linear_velocity=np.zeros(3),
    inliers=np.zeros(0, dtype=np.bool_),
    residuals=np.zeros(0),
    joint_covariance=np.zeros((18, 18)),
    global_shutter_inliers=0,
    iterations=0,
)


class FrameLocalizer:
    """Localizes correspondences, or keypoints by a map, with the latest camera and settings.

    With ``tracking``, a readout time and a rolling-shutter solver it remembers the previous frame;
    new settings, a new camera, points in another frame and a time before the last one start it
    afresh.

    Args:
        config: settings; assigning :attr:`config` changes them from the next frame on.
        notice: told of what is odd but no refusal, by a name and one sentence: ``time_went_back``
            (a recording that starts over), ``map_changed`` (another frame of the points),
            ``map_replaced``, ``map_incomplete``, ``camera_changed``, ``too_many_keypoints``,
            ``readout_time`` (the motion contradicts it, or it was estimated), a
            :class:`rs_localizer.pipeline.reasons.ImuReason` and those of
            :func:`rs_localizer.pipeline.oddities.oddities`. Frames are localized all the same.
        transforms: where the camera is on ``base_frame``; asked once a frame, so that a mounting
            may change and move. Without it there is none.

    Raises:
        ValueError: for settings that the localizer refuses.
    """

    def __init__(
        self,
        config: NodeConfig,
        notice: Callable[[str, str], None] = lambda name, text: None,
        transforms: Transforms | None = None,
    ) -> None:
        self._notice = notice
        self.transforms: Transforms = TransformTree() if transforms is None else transforms
        self._last: tuple[int, str] | None = None  # stamp and map of the last cloud
        self._calibration: Calibration | None = None
        self._matcher: Matcher | None = None
        self._lacks_map = False
        self.readout_watch = ReadoutWatch(notice)
        self.imu = ImuInput(notice)
        self._given = config  # the readout time may be found on the way
        self._use(_ANY_CALIBRATION, config)

    @property
    def config(self) -> NodeConfig:
        return self._config

    @config.setter
    def config(self, config: NodeConfig) -> None:
        self._use(self._calibration or _ANY_CALIBRATION, config)
        self._given = config

    def _use(self, calibration: Calibration, config: NodeConfig) -> None:
        # Nothing changes if this raises: camera, localizer and settings always belong together.
        self._camera, self._localizer, self._tracker = _build(calibration, config)
        self._config = config
        self.readout_watch.reset()

    @property
    def calibration(self) -> Calibration | None:
        """What the last usable camera_info said."""
        return self._calibration

    @property
    def camera_frame(self) -> str:
        """The camera's optical frame; empty as long as it is unknown."""
        return "" if self._calibration is None else self._calibration.frame

    @property
    def missing(self) -> tuple[str, ...]:
        """The inputs that have to come before a frame can be localized."""
        camera = (CAMERA_INFO,) if self._calibration is None else ()
        return (*camera, MAP_POINTS) if self._lacks_map else camera

    @property
    def map(self) -> Map | None:
        """The map that keypoints are matched with."""
        return None if self._matcher is None else self._matcher.map

    def reset(self) -> None:
        """Forget the previous frames."""
        self._last = None
        self.readout_watch.reset()
        if self._tracker is not None:
            self._tracker.reset()

    def warm_up(self) -> None:
        """Compile all that the present settings need, from points to messages."""
        self._localizer.warm_up()
        so3.quaternion(pose_at(_STILL, 0.5).rotation.copy())
        twist_at(_STILL, 0.5, 1.0)
        so3.log(np.eye(3))
        self.readout_watch.warm_up(self._camera)
        matching.warm_up()

    def take_camera_info(self, message: Any) -> None:
        """Use this sensor_msgs/CameraInfo from the next frame on.

        Raises:
            MessageError: for one that cannot be used, saying what was found; the previous stays.
        """
        self.calibrate(read_camera_info(message))

    def calibrate(self, calibration: Calibration) -> None:
        """Use this calibration from the next frame on.

        Raises:
            MessageError: for one that no camera can have; the previous stays.
        """
        if calibration != self._calibration:  # drivers repeat it with every image
            self._use(calibration, self._given)
            before, self._calibration = self._calibration, calibration
            if before is not None:
                self._notice(
                    "camera_changed",
                    f"camera_info changed from {before.frame!r}, {before.width} x {before.height}, "
                    f"to {calibration.frame!r}, {calibration.width} x {calibration.height}; the "
                    "previous frames are forgotten (if it goes to and fro, two cameras publish it)",
                )

    def take_imu(self, message: Any) -> None:
        """Keep this sensor_msgs/Imu for the frames of its time.

        Raises:
            MessageError: for one that cannot be used, saying what was found.
        """
        self.imu.add(read_imu(message))

    def awaits_imu(self, stamp_ns: int, patience: float) -> bool:
        """Whether readings of the frame with this stamp are missing that may come within so many
        seconds.
        """
        if self._tracker is None:
            return False
        time_ns = middle_row_ns(self._config, self._camera, stamp_ns)
        return self.imu.awaits(self._tracker, self._config, time_ns, patience)

    def load_map(self) -> None:
        """Use the map of the setting ``map_file``, if there is one.

        Raises:
            MapError: for a file that cannot be read or holds no map to match keypoints with.
        """
        if self._config.map_file:
            self.use_map(read_landmarks(self._config.map_file, self._config.map_frame))

    def take_map(self, message: Any) -> None:
        """Use this sensor_msgs/PointCloud2 of landmarks from the next frame on.

        Raises:
            MessageError: for one that cannot be used, saying what was found; the previous stays.
        """
        self.use_map(read_map(message))

    def use_map(self, landmarks: Map) -> None:
        """Match keypoints with this map from the next frame on."""
        previous = self.map
        if previous is not None and landmarks.equals(previous):
            return  # published again
        for name, text in oddities_of_map(landmarks, previous).items():
            self._notice(name, text)
        self._matcher = Matcher(landmarks)
        self._lacks_map = False

    def localize(self, message: Any) -> Localized | Refusal:
        """Localize one sensor_msgs/PointCloud2 of correspondences; never raises for bad ones."""
        try:
            cloud = read_correspondences(message)
        except EmptyCloudError as error:
            return Refusal("empty_cloud", str(error))
        except MessageError as error:
            return Refusal("bad_cloud", str(error))
        self._follow(cloud.stamp_ns, cloud.frame)
        result = self._localize(cloud)
        if result:
            self._lacks_map = False  # who sends correspondences needs none
        return result

    def localize_keypoints(self, message: Any) -> Localized | Refusal:
        """Localize one sensor_msgs/PointCloud2 of keypoints; never raises for bad ones.

        Tracked, landmarks are first looked for where the motion predicts them only, then, if that
        gives no pose, all over the map.
        """
        try:
            keypoints = read_keypoints(message)
        except EmptyCloudError as error:
            return Refusal("empty_cloud", str(error))
        except MessageError as error:
            return Refusal("bad_keypoints", str(error))
        if self._matcher is None:
            self._lacks_map = True
            return Refusal("no_map", "no usable map has come yet, on map_points or as map_file")
        self._follow(keypoints.stamp_ns, self._matcher.map.frame)
        try:
            by = self._matcher.choose(keypoints, self._config.matching)
        except MatchError as error:
            return Refusal("bad_keypoints", str(error))
        if by == MatchBy.DESCRIPTOR:
            self._say_if_too_many(keypoints)
            if self._tracker is not None and self._config.matching.gate > 0.0:
                prior = self._tracker.prediction(
                    middle_row_ns(self._config, self._camera, keypoints.stamp_ns)
                )
                result = None if prior is None else self._match(keypoints, prior)
                # Without its mounting a pose is none the worse.
                if result or (result is not None and result.reason == NO_TRANSFORM):
                    return result
        return self._match(keypoints, None)

    def _say_if_too_many(self, keypoints: Keypoints) -> None:
        most = self._config.matching.max_keypoints
        if len(keypoints) > most:
            self._notice(
                "too_many_keypoints",
                f"{len(keypoints)} keypoints have come, matching.max_keypoints of them, {most}, "
                "are matched",
            )

    def _match(self, keypoints: Keypoints, prior: Prior | None) -> Localized | Refusal:
        assert self._matcher is not None
        settings = self._config.matching
        matches = self._matcher.match(keypoints, settings, self._camera, prior)
        if len(matches) == 0:
            return Refusal(
                "no_matches",
                f"none of {len(keypoints)} keypoints matches one of {len(self._matcher.map)} "
                f"landmarks by {matches.by}",
            )
        return self._localize(matching.correspondences(matches, keypoints, self._matcher.map))

    def _localize(self, cloud: Correspondences) -> Localized | Refusal:
        if self._calibration is None:
            return Refusal("no_camera_info", "no usable camera_info has come yet")
        for name, text in oddities(cloud, self._camera, self._calibration.frame).items():
            self._notice(name, text)
        given = (cloud.points, cloud.pixels, cloud.scores)
        if self._tracker is None:
            self.imu.without_tracker(self._config)
            result = self._localizer.localize(*given)
        else:
            time_ns = middle_row_ns(self._config, self._camera, cloud.stamp_ns)
            camera_frame = self._calibration.frame
            result = self.imu.track(
                self._tracker, self._config, time_ns, camera_frame, self.transforms, given
            )
        if not result:
            return Refusal(str(result.reason), result.detail)
        frame = of_camera(cloud, result, self._config, self._camera, self._calibration.frame)
        self._watch_readout(cloud, result)
        return self.mounted(frame)

    def mounted(self, localized: Localized) -> Localized | Refusal:
        """The result of ``base_frame``, from that of the camera."""
        return of_body(localized, self._config, self.transforms)

    def _watch_readout(self, cloud: Correspondences, estimate: Estimate) -> None:
        assert self._calibration is not None
        time_ns = middle_row_ns(self._config, self._camera, cloud.stamp_ns)
        config = self.readout_watch.add(self._config, self._camera, time_ns, estimate, cloud)
        if config is not self._config:
            self._use(self._calibration, config)

    def _follow(self, stamp_ns: int, frame: str) -> None:
        """Start afresh where this frame cannot follow the last one."""
        if self._last is not None:
            last_ns, last_frame = self._last
            if stamp_ns < last_ns:
                self.reset()
                self._notice(
                    "time_went_back",
                    f"the stamp {stamp_ns * 1e-9:.3f} s lies {(last_ns - stamp_ns) * 1e-9:.3f} s "
                    "before the last one; the previous frames are forgotten",
                )
            if frame != last_frame:
                self.reset()
                self._notice(
                    "map_changed",
                    f"the points are in frame {frame!r}, the last ones were in {last_frame!r}; "
                    "the previous frames are forgotten",
                )
        self._last = stamp_ns, frame


def _build(
    calibration: Calibration, config: NodeConfig
) -> tuple[Camera, Localizer, Tracker | None]:
    camera = calibration.camera(config.readout_time, config.scan_direction)
    localizer = Localizer(camera, config)
    follows = (
        config.tracking and config.readout_time > 0.0 and find_solver(config.solver).rolling_shutter
    )
    return camera, localizer, Tracker(localizer, inertial_settings(config)) if follows else None
