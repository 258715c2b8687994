# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A frame from message to pose: what the live node and the offline replay share.

Both feed their messages to a :class:`FrameLocalizer` and publish what
:func:`rs_localizer.io.outputs.messages` makes of the result, so that both say the same. A camera is
a rig of one. A rig of several has the axes of its first camera whose ``camera_info`` has come;
where the others are, TF says, at the time of the frame. Poses are those of ``base_frame``.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import copy
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from rs_localizer import matching
from rs_localizer.config import (
    CameraSettings,
    Imu,
    ImuUse,
    NodeConfig,
    PoseTime,
    PublishTf,
    RefinementKind,
)
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Notice, Reason
from rs_localizer.core.rig import Rig, RigEstimate
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.prior import Prior
from rs_localizer.io.camera_info import Calibration
from rs_localizer.io.clouds import (
    Correspondences,
    Keypoints,
    read_correspondences,
    read_keypoints,
    thinned,
)
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.outputs import Localized
from rs_localizer.io.topics import CAMERA_INFO, CORRESPONDENCES, MAP_POINTS
from rs_localizer.io.transforms import Transform, TransformError, Transforms, TransformTree
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline import what_fits
from rs_localizer.pipeline.cloud_checks import oddities, stale_landmarks
from rs_localizer.pipeline.given_pose import GivenPose, PosePrior
from rs_localizer.pipeline.imu_readings import ImuInput, inertial_settings
from rs_localizer.pipeline.inputs import INPUTS
from rs_localizer.pipeline.keypoint_map import Landmarks, read_landmarks
from rs_localizer.pipeline.pose_at_time import middle_row_ns, published_moment
from rs_localizer.pipeline.published import ReadoutKnown, of_body, of_camera
from rs_localizer.pipeline.refusal import Notify, Refusal, read_or_refuse, unheard
from rs_localizer.pipeline.rig_frames import (
    CameraImage,
    FrameAssembler,
    joined,
    matches_of,
    share_of,
)
from rs_localizer.pipeline.stream import Stream
from rs_localizer.shutter_watch import ShutterWatch
from rs_localizer.solvers.table import find_solver
from rs_localizer.tracking import FrameContext, Tracker

if TYPE_CHECKING:
    from rs_localizer.inertial.samples import ImuSamples
    from rs_localizer.pipeline.tags import Tags

# From this chance on of a wrong pose or map, it is more probable than not.
DOUBTFUL = 0.5
# Smooth errors (px, root mean square; median of so many frames) that nobody has who calibrated
# well: surveyed tags before a calibrated lens have 0.2.
_MUCH, _FRAMES = 0.3, 30

ANY_CALIBRATION = Calibration(
    "camera", 640, 480, (500.0, 0.0, 319.5, 0.0, 500.0, 239.5, 0.0, 0.0, 1.0), (), "plumb_bob",
    (1, 1), None,
)  # fmt: skip
"""Stands in until the first camera_info: kernels are compiled and settings checked before it."""


# Settings that change what is made of an estimate, or which points come to it, and not how it is
# made. All others start the track afresh.
_BESIDE = frozenset({
    "readout_time_deviation", "pose_time", "max_points", "base_frame",
    "odom_frame", "publish_tf", "tf_rate", "hold", "two_d_mode",
    "transform_tolerance", "saved_pose_file", "map_file", "map_frame", "marker_map", "matching",
    "autostart", "output_rate", "camera_file",
})  # fmt: skip


def _of_estimates(config: NodeConfig) -> tuple[object, ...]:
    rig = config.rig if config.of_cameras else type(config.rig)()
    imu = replace(config.imu, wait=0.0)
    if config.of_cameras or imu.use == ImuUse.NONE:  # nothing else of it is read
        imu = Imu(use=ImuUse.NONE)
    config = replace(config, imu=imu, rig=rig)
    return tuple(getattr(config, it.name) for it in fields(config) if it.name not in _BESIDE)


class FrameLocalizer:
    """Localizes correspondences, or keypoints by a map, with the latest cameras and settings.

    With ``tracking``, readout times and a rolling-shutter solver it remembers the previous frame;
    new settings, a new camera, points in another frame and a time before the last one start it
    afresh.

    Args:
        config: settings; assigning :attr:`config` changes them from the next frame on.
        notice: told of what is odd but no refusal.
        transforms: where the cameras are on ``base_frame``; asked once a frame, so that a mounting
            may change and move. Without it there is none.

    Raises:
        ValueError: for settings that the localizer refuses.
    """

    def __init__(
        self,
        config: NodeConfig,
        notice: Notify = unheard,
        transforms: Transforms | None = None,
    ) -> None:
        self._notice = notice
        self.transforms: Transforms = TransformTree() if transforms is None else transforms
        self.imu: ImuInput = ImuInput(notice)
        self._faults: set[str] = set()  # of the shutter, which have been noticed
        self.calibrations: dict[str, Calibration] = {}
        """What the last usable camera_info of each camera said; of one without a name: ``""``."""
        self._mounts: dict[str, Transform] = {}  # of several cameras, on the first one
        self._assembler = FrameAssembler(config.cameras, config.rig.window, notice)
        self._landmarks = Landmarks(notice)
        self._tags: Tags | None = None
        self._lenses: dict[str, Camera] = {}  # of camera_file
        self._stream = Stream(notice, self._forget_motion)
        self._pose_prior = PosePrior(notice)
        # Of the last frames, by time of the middle row: with what their results are published.
        self._waiting: dict[int, Correspondences] = {}
        # The newest of them that has a pose, without its rows.
        self._newest: Correspondences | None = None
        self._smooth_errors: deque[float] = deque(maxlen=_FRAMES)
        self._too_many = False  # whether clouds above max_points have been noticed
        self._config = _in_effect(config)
        self._use(self._config)

    @property
    def config(self) -> NodeConfig:
        return self._config

    @config.setter
    def config(self, config: NodeConfig) -> None:
        self.change(config)

    def change(self, config: NodeConfig) -> bool:
        """Use these settings from the next frame on; whether they start the track afresh.

        What no frame's estimate depends on, as of outputs and transforms, leaves track, IMU and
        readout watch as they are.
        """
        config = _in_effect(config)
        if _of_estimates(config) == _of_estimates(self._config):
            self._config = config
            return False
        self._use(config)
        return True

    @property
    def _alone(self) -> bool:
        """True for one camera, without a name."""
        return not self._config.of_cameras

    def _use(self, config: NodeConfig) -> None:
        # Nothing changes if this raises: cameras, tracker and settings always belong together.
        seen = {
            name: self.calibrations.get(name, ANY_CALIBRATION).camera(
                own.readout_time, own.scan_direction
            )
            for name, own in _shutters(config).items()
        }
        alone = not config.of_cameras
        device = next(iter(seen.values())) if alone else self._rig(seen)
        rolling = find_solver(config.solver).rolling_shutter
        timed = rolling and all(camera.readout_time > 0.0 for camera in seen.values())
        tracks = config.tracking and timed  # without a readout time frames predict nothing
        inertial = inertial_settings(config) if timed and alone else None
        lag = config.output_lag if tracks and alone else 0
        self._tracker = Tracker(
            Localizer(device, config), inertial, tracks, lag, config.max_prediction
        )
        self._newest = None
        self._waiting.clear()
        self._smooth_errors.clear()
        if config.rig != self._config.rig:
            self._assembler = FrameAssembler(config.cameras, config.rig.window, self._notice)
        self._cameras, self._config = seen, config
        self._mistakes = what_fits.Mistakes()
        self._faults.clear()

    def _rig(self, cameras: Mapping[str, Camera]) -> Rig:
        """The rig of the cameras whose mounting is known; before there is one, of any."""
        mounts = self._mounts or dict.fromkeys(cameras, Transform(np.eye(3), np.zeros(3)))
        return Rig(
            {name: cameras[name] for name in mounts},
            {name: (it.rotation, it.translation) for name, it in mounts.items()},
        )

    @property
    def rig(self) -> Rig:
        """The rig of several cameras, as far as they are known."""
        return self._rig(self._cameras)

    @property
    def _camera(self) -> Camera:
        """The only one."""
        (camera,) = self._cameras.values()
        return camera

    def _middle_row_ns(self, stamp_ns: int) -> int:
        """Time at which the middle row of the image with this stamp was exposed."""
        return middle_row_ns(self._config, self._camera, stamp_ns)

    @property
    def calibration(self) -> Calibration | None:
        """The last usable calibration of the first camera."""
        return self.calibrations.get(self._config.cameras[0])

    @property
    def camera_frame(self) -> str:
        """The optical frame of the first camera that is known; empty as long as none is."""
        known = (self.calibrations.get(name) for name in self._config.cameras)
        return next((calibration.frame for calibration in known if calibration), "")

    @property
    def missing(self) -> tuple[str, ...]:
        """The inputs that have to come before a frame can be localized."""
        infos = tuple(f"{name}/{CAMERA_INFO}".lstrip("/") for name in self._config.cameras)
        infos = () if self.calibrations else infos
        return (*infos, MAP_POINTS) if self._landmarks.lacking else infos

    @property
    def map(self) -> Map | None:
        """The map that keypoints are matched with."""
        return self._landmarks.map

    @property
    def map_points(self) -> Array | None:
        """Landmarks (n,3), or corners (n,4,3) of markers; None: correspondences bring their own."""
        if self.map is not None:
            return self.map.points
        return None if self._tags is None else self._tags.corners

    @property
    def view_corners(self) -> Array | None:
        """Bearings (4,3) of the image's corners, in camera axes; None: no camera is known."""
        if not (self._alone and self.calibrations):
            return None
        width, height = np.array(self._camera.size) - 1.0
        corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
        return self._camera.bearings(corners)

    def take_zero_for_time(self, recorded_ns: int) -> None:
        """Take a stamp of 0 for a time where a recording has its message at 0, too."""
        self._stream.zero_is_time = recorded_ns == 0

    def reset(self) -> None:
        """Forget the previous frames."""
        self._stream.reset()
        self._assembler.reset()
        self._forget_motion()

    def _forget_motion(self) -> None:
        self._newest = None
        self._waiting.clear()
        self._smooth_errors.clear()
        self._faults.clear()
        self._tracker.reset()

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
        own, frame = _shutters(self._config)[name], self.camera_frame
        self._cameras[name] = calibration.camera(own.readout_time, own.scan_direction)
        self.calibrations[name] = calibration
        self._mounts.pop(name, None)
        if before is None and self.camera_frame == frame:
            return  # one more of a rig
        self._mounts = {}  # relative to other axes
        self._use(self._config)
        if before is not None:
            of = f" of {name}" if name else ""
            self._notice(
                Notice.CAMERA_CHANGED,
                f"camera_info{of} changed from {before.frame!r}, {before.width} x {before.height}, "
                f"to {calibration.frame!r}, {calibration.width} x {calibration.height}; the "
                "previous frames are forgotten (if it goes to and fro, two cameras publish it)",
            )

    def awaits_imu(self, stamp_ns: int, patience: float) -> bool:
        """True if readings of the frame with this stamp may yet come within so many s."""
        if not self._alone:
            return False  # a rig has none
        time_ns = self._middle_row_ns(stamp_ns)
        return self.imu.awaits(self._tracker, self._config, time_ns, patience)

    def load_files(self) -> None:
        """Use ``camera_file`` and the maps ``map_file`` and ``marker_map`` of the settings, if any.

        Raises:
            ValueError: for a file that cannot be read or holds no such map.
        """
        if file := self.config.camera_file:
            from rs_localizer.io.camera_files import read_calibration

            for name in self.config.cameras:
                self._lenses[name] = read_calibration(f"{file}#{name}" if name else file)
        if self.config.marker_map:  # others need no detector
            from rs_localizer.pipeline.tags import read_tags

            self._tags = read_tags(self.config.marker_map, self._notice)
        if self.config.map_file:
            self.use_map(read_landmarks(self.config.map_file, self.config.map_frame))

    def use_map(self, landmarks: Map) -> None:
        """Match keypoints with this map from the next frame on."""
        self._landmarks.use(landmarks)

    def give_pose(self, given: GivenPose) -> None:
        """Find the next frame near this pose; one that a user gives ends the track."""
        self._pose_prior.take(given)
        if not given.lasts:
            self._forget_motion()

    def _expect(self, time_ns: int, map_frame: str) -> None:
        """Tell the tracker what others know of the pose at a time, if it knows nothing itself."""
        if not (self.calibrations and self._pose_prior.given):
            return
        if self._tracker.prediction(time_ns) is not None:
            return
        prior = self._pose_prior.prior(
            time_ns, map_frame, self.camera_frame, self._config, self.transforms
        )
        if prior is not None:
            self._tracker.expect(time_ns, prior)

    def localize(self, message: Any) -> Localized | Refusal:
        """Localize one sensor_msgs/PointCloud2 of correspondences; never raises for bad ones."""
        cloud = read_or_refuse(read_correspondences, message, Reason.BAD_CLOUD)
        return cloud if isinstance(cloud, Refusal) else self.localize_cloud(cloud)

    def localize_cloud(self, cloud: Correspondences) -> Localized | Refusal:
        """Localize correspondences, however they came."""
        refusal = self._stream.follow(cloud.stamp_ns, cloud.frame)
        if refusal is not None:
            return refusal
        result = self._localize(cloud)
        if result:
            self._landmarks.lacking = False  # who sends correspondences needs none
        return self._delayed(result, cloud.stamp_ns)

    def _delayed(self, newest: Localized | Refusal, stamp_ns: int) -> Localized | Refusal:
        """The result that ``output_lag`` asks for once the frame of this stamp has come."""
        tracker = self._tracker
        if tracker.output_lag == 0 or tracker.newest_ns != self._middle_row_ns(stamp_ns):
            return newest
        return self._late(tracker.delayed)

    def _late(self, found: Estimate | Failure) -> Localized | Refusal:
        """The result of a frame that has waited."""
        if not found:
            return Refusal(found.reason, found.detail)
        return self._published(self._waiting[found.time_ns], found)

    def localize_keypoints(self, message: Any) -> Localized | Refusal:
        """Localize one sensor_msgs/PointCloud2 of keypoints; never raises for bad ones.

        Tracked, landmarks are first looked for where the motion predicts them only, then, if that
        gives no pose, all over the map.
        """
        keypoints = read_or_refuse(read_keypoints, message, Reason.BAD_KEYPOINTS)
        if isinstance(keypoints, Refusal):
            return keypoints
        if self.map is not None:
            refusal = self._stream.follow(keypoints.stamp_ns, self.map.frame)
            if refusal is not None:
                return refusal
        by = self._landmarks.how(keypoints)
        if isinstance(by, Refusal):
            return by
        if (cloud := self._landmarks.repeated(keypoints)) is not None:
            return self._delayed(self._localize(cloud), keypoints.stamp_ns)
        if by == matching.MatchBy.DESCRIPTOR:
            time_ns = self._middle_row_ns(keypoints.stamp_ns)
            if self.map is not None:
                self._expect(time_ns, self.map.frame)
            prior = self._tracker.prediction(time_ns, context=self._context)
            result = None if prior is None else self._localize_by_map(keypoints, prior)
            # Without its mounting a pose is none the worse.
            if result or (result is not None and result.reason is Reason.NO_TRANSFORM):
                return self._delayed(result, keypoints.stamp_ns)
        return self._delayed(self._localize_by_map(keypoints, None), keypoints.stamp_ns)

    def localize_detections(self, message: Any) -> Localized | Refusal:
        """Localize one AprilTagDetectionArray by ``marker_map``; never raises for bad ones."""
        if self._tags is None:
            return Refusal(Reason.NO_MAP, "detections need the setting marker_map")
        cloud = self._tags.match(message)
        return cloud if isinstance(cloud, Refusal) else self.localize_cloud(cloud)

    def add(self, name: str, kind: str, message: Any) -> Iterator[Localized | Refusal]:
        """Take an image of a camera by its name; the results of frames that it completes."""
        if name not in self.calibrations:
            text = f"no usable camera_info of {name} has come yet"
            self._notice(Notice.NO_IMAGES, f"{name} is left out: {text}")
            yield Refusal(Reason.NO_CAMERA_INFO, text)
            return
        own, camera = self._config.of_cameras[name], self._cameras[name]
        cloud = self._read(name, kind, message, camera)
        if not isinstance(cloud, Refusal):
            cloud = self._stream.unset(cloud.stamp_ns) or cloud
        if isinstance(cloud, Refusal):
            yield cloud
            return
        cloud = self._checked(cloud, name)
        start_ns = cloud.stamp_ns + round(own.stamp_offset * 1e9)
        middle_ns = start_ns - round(camera.first_row_time * own.readout_time * 1e9)
        image = CameraImage(name, start_ns, middle_ns, cloud)
        for images in self._assembler.add(image):
            yield self._localize_frame(images)

    def flush(self) -> list[Localized | Refusal]:
        """The results of what still waits for other images: none will come."""
        frames = [self._localize_frame(frame) for frame in self._assembler.flush()]
        return [*frames, *map(self._late, self._tracker.flush())]

    def _read(
        self, name: str, kind: str, message: Any, camera: Camera
    ) -> Correspondences | Refusal:
        """Correspondences of one camera's message."""
        read: Callable[[Any], Any]
        read = read_correspondences if kind == CORRESPONDENCES else read_keypoints
        found: Correspondences | Keypoints | Refusal
        found = read_or_refuse(read, message, INPUTS[kind].refused)
        if isinstance(found, Refusal):
            return replace(found, detail=f"{name}: {found.detail}")
        if isinstance(found, Correspondences):
            return found
        by = self._landmarks.how(found)
        if isinstance(by, Refusal):
            return by
        return self._landmarks.match(found, self._config.matching, camera, None)

    def _localize_by_map(self, keypoints: Keypoints, prior: Prior | None) -> Localized | Refusal:
        cloud = self._landmarks.match(keypoints, self._config.matching, self._camera, prior)
        return cloud if isinstance(cloud, Refusal) else self._localize(cloud)

    def _localize(self, cloud: Correspondences) -> Localized | Refusal:
        if not self.calibrations:
            return Refusal(Reason.NO_CAMERA_INFO, "no usable camera_info has come yet")
        config, frame = self._config, self.camera_frame
        cloud = self._checked(cloud)
        time_ns, context = self._middle_row_ns(cloud.stamp_ns), self._context
        self._expect(time_ns, cloud.frame)

        def localized(samples: ImuSamples | None) -> Estimate | Failure:
            matches = cloud.points, cloud.pixels, cloud.scores
            return self._tracker.localize(time_ns, *matches, imu=samples, context=context)

        self.imu.track(self._tracker, config, time_ns, frame, self.transforms, localized)
        result = self._tracker.newest
        assert result is not None
        shutter = self._tracker.shutter
        if shutter.fault and shutter.kind not in self._faults:
            self._faults.add(shutter.kind)
            self._notice(Notice.READOUT_TIME, shutter.fault)
        if result:
            ahead = (cloud.points[result.inliers] - result.position) @ result.rotation[2]
            self._stream.pace(time_ns, result, float(np.median(ahead)), config)
            self._pose_prior.judge(result)
            if self.predicts:
                without = replace(cloud, table=cloud.table[:0], dropped=0)
                self._newest = without
        if self._tracker.output_lag > 0:
            self._waiting[time_ns] = cloud
            while len(self._waiting) > self._tracker.output_lag + 1:
                del self._waiting[next(iter(self._waiting))]
        published = self._published(cloud, result)
        if self._tracker.repeats and result:
            self._notice(
                Notice.STILL_IMAGE,
                "the pixels are those of the last image, bit for bit, and nothing says that the "
                "camera moves: it counts once",
            )
        if not published:
            matches = cloud.points, cloud.pixels, what_fits.ids_of(cloud)
            localizer = self._tracker.localizer
            published = self._explained(published, lambda: what_fits.what_fits(localizer, *matches))
        return published

    def _explained(
        self, refusal: Refusal, tried: Callable[[], str], notice: Notice = Notice.WOULD_FIT
    ) -> Refusal:
        """The refusal of a frame, with what would fit where somebody found that."""
        if refusal.reason not in what_fits.REASONS:
            return refusal
        said = self._mistakes.look(tried)
        if not said:
            return refusal
        self._notice(notice, said)
        return replace(refusal, detail=f"{refusal.detail}; {said}")

    @property
    def _context(self) -> FrameContext:
        """Knowledge of the next frame."""
        return FrameContext(self._config.readout_time_deviation, self._landmarks.error_modes)

    @property
    def shutter(self) -> ShutterWatch:
        """Who says that scan direction or readout time are contradicted."""
        return self._tracker.shutter

    @property
    def predicts(self) -> bool:
        """True if frames are tracked, so that :meth:`at` knows the motion between them."""
        return self._alone and self._tracker.remembers_motion

    def snapshot(self) -> FrameLocalizer:
        """What :meth:`at` knows now, for another thread while frames are localized here."""
        there = copy(self)
        there._tracker = self._tracker.snapshot()
        return there

    def at(self, stamp_ns: int) -> Localized | Refusal | None:
        """Pose and twist at a time of the images' clock, without inliers.

        None before the last frames, more than ``max_prediction`` after them, and where frames do
        not know how the camera moves (:attr:`predicts`).
        """
        if not self.predicts or self._newest is None:
            return None
        newest_ns, samples = self._tracker.newest_ns, None
        if newest_ns is not None and stamp_ns > newest_ns:
            known = self._tracker, self._config, stamp_ns, self.camera_frame, self.transforms
            samples = self.imu.ahead(*known)
        found = self._tracker.at(stamp_ns, samples)
        if found is None:
            return None
        cloud = replace(self._newest, stamp_ns=stamp_ns)
        return self.mounted(self._made(cloud, found, (stamp_ns, 0.0)))

    def _published(self, cloud: Correspondences, result: Estimate | Failure) -> Localized | Refusal:
        """A result of the body at the published moment."""
        if not result:
            return Refusal(result.reason, result.detail)
        if result.integrity > DOUBTFUL:
            text = f"pose or map are wrong with a probability of {result.integrity:.0%}"
            self._notice(Notice.DOUBTFUL, text)
        elif said := stale_landmarks(cloud, self._tracker.stale(cloud.points)):
            self._notice(Notice.STALE_LANDMARKS, said)
        if result.left_out:
            self._notice(Notice.DOUBTFUL, result.left_out)
        if not len(result.shake):  # vibration moves points smoothly, too
            self._smooth_errors.append(result.model_error)
        off = float(np.median(self._smooth_errors)) if self._smooth_errors else 0.0
        known = len(self._smooth_errors) == _FRAMES
        if known and off > _MUCH:
            self._notice(
                Notice.LENS,
                f"residuals vary smoothly over the image ({off:.1f} px rms): recalibrate the lens, "
                "or survey the map again; until then poses allow for it",
            )
        moment = published_moment(self._config, self._camera, cloud.stamp_ns)
        return self.mounted(self._made(cloud, result, moment))

    def _made(
        self,
        cloud: Correspondences,
        estimate: Estimate,
        moment: tuple[int, float],
    ) -> Localized:
        """Pose and twist of an estimate at a moment, as of :func:`.of_camera`."""
        deviation, first = 0.0, next(iter(self._cameras.values())).first_row_time
        if self._alone:
            deviation = self._tracker.readout_time_deviation(self._context)
        readout = ReadoutKnown(deviation, first, self.shutter.is_global)
        return of_camera(cloud, estimate, self._config, self.camera_frame, moment, readout)

    def _checked(self, cloud: Correspondences, name: str = "") -> Correspondences:
        """With no more points than a camera's part of ``max_points``; what is odd is said."""
        camera, of = self._cameras[name], f"{name}: " if name else ""
        for notice, text in oddities(cloud, camera, self.calibrations[name].frame).items():
            self._notice(notice, of + text)
        most = self.config.max_points // len(self._cameras)
        if len(cloud.points) > most and not self._too_many:
            self._too_many = True
            self._notice(
                Notice.TOO_MANY_POINTS,
                f"{of}{len(cloud.points)} points have come; max_points of them, {most}, are used",
            )
        return thinned(cloud, most, camera.size)

    def _localize_frame(self, images: Sequence[CameraImage]) -> Localized | Refusal:
        reference = images[0].cloud
        others = {image.cloud.frame for image in images} - {reference.frame}
        if others:
            return Refusal(
                Reason.BAD_CLOUD,
                f"the points of {images[0].camera} are in frame {reference.frame!r}, others in "
                f"{', '.join(map(repr, sorted(others)))}: cameras of a rig see one map",
            )
        refusal = self._stream.follow(images[0].start_ns, reference.frame)
        if refusal is not None:
            return refusal
        refusal = self._mount(images)
        images = [image for image in images if image.camera in self._mounts]
        if not images:
            assert refusal is not None
            return refusal
        # Seconds since the first image: nothing is lost of stamps since 1970.
        origin_ns = images[0].start_ns
        starts = {image.camera: 1e-9 * (image.start_ns - origin_ns) for image in images}
        matches = {image.camera: matches_of(image.cloud, images) for image in images}
        context = FrameContext(error_modes=self._landmarks.error_modes)
        result = self._tracker.localize(origin_ns, matches, stamps=starts, context=context)
        if not result:
            refusal = Refusal(result.reason, result.detail)
            localizer = self._tracker.localizer
            return self._explained(
                refusal,
                lambda: what_fits.cameras_apart(localizer, matches, starts),
                Notice.EXTRINSICS,
            )
        assert isinstance(result, RigEstimate)
        self._landmarks.lacking = False  # who sends correspondences needs none
        return self.mounted(self._localized(images, result, origin_ns))

    def _mount(self, images: Sequence[CameraImage]) -> Refusal | None:
        """Look up where cameras are that move; why one of this frame is not known."""
        frame, stamp_ns = self.camera_frame, images[0].cloud.stamp_ns or None
        mounts, refusal = dict(self._mounts), None
        for image in images:
            name = image.camera
            own = self.calibrations[name].frame
            try:
                if name in mounts and not self.transforms.moves(own, frame):
                    continue
                mounts[name] = self.transforms.lookup(own, frame, stamp_ns)
            except TransformError as error:
                mounts.pop(name, None)
                text = f"from {frame!r} to {own!r} of camera {name}: {error}"
                refusal = Refusal(Reason.NO_TRANSFORM, text)
                self._notice(Notice.NO_IMAGES, f"{name} is left out: no transform {text}")
        if any(mounts.get(name) is not self._mounts.get(name) for name in {*mounts, *self._mounts}):
            self._mounts = {name: mounts[name] for name in self._config.cameras if name in mounts}
            if self._mounts:
                self._tracker.mount(self.rig)
        return refusal

    def _localized(
        self, images: Sequence[CameraImage], result: RigEstimate, origin_ns: int
    ) -> Localized:
        """Pose and twist of the rig's axes at the published moment."""
        config, first = self._config, images[0].cloud
        time_ns = origin_ns + round(1e9 * result.time)
        stamp_ns = time_ns if config.pose_time == PoseTime.MID_FRAME else first.stamp_ns
        moment = stamp_ns, (stamp_ns - time_ns) / (1e9 * result.span)  # exact for a camera alone
        made = self._made(joined(config.cameras, images), result, moment)
        return replace(made, cameras=tuple(share_of(image, result) for image in images))

    def mounted(self, localized: Localized) -> Localized | Refusal:
        """The result of ``base_frame``, from that of the camera."""
        return of_body(localized, self.config, self.transforms)


def _in_effect(config: NodeConfig) -> NodeConfig:
    """The settings without what ``refinement`` turns off.

    That is what knows more than a frame's points, and TF where no covariance says how good a pose
    is.
    """
    if config.refinement == RefinementKind.FULL:
        return config
    config = replace(config, tracking=False, imu=replace(config.imu, use=ImuUse.NONE))
    if config.refinement == RefinementKind.NONE:
        config = replace(config, publish_tf=PublishTf.NONE)
    return config


def _shutters(config: NodeConfig) -> Mapping[str, CameraSettings]:
    """Readout time, direction and stamp offset of each camera."""
    own = CameraSettings(config.readout_time, config.scan_direction, config.stamp_offset)
    return config.of_cameras or {"": own}
