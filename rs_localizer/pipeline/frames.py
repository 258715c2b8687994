# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A frame from message to pose: what the live node and the offline replay share.

Both feed their messages to a :class:`FrameLocalizer` and publish what
:func:`rs_localizer.io.outputs.messages` makes of the result, so that both say the same.
"""

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer import matching
from rs_localizer.config import MatchBy, Matching, NodeConfig
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.lens import LensError
from rs_localizer.core.reasons import Notice, Reason
from rs_localizer.core.simd.jit import NotCompiled
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.calibration import ErrorModes
from rs_localizer.estimation.prior import Prior
from rs_localizer.io.camera_info import Calibration
from rs_localizer.io.clouds import (
    Correspondences,
    Keypoints,
    read_correspondences,
    read_keypoints,
    thinned,
)
from rs_localizer.io.maps.files import read_map_file
from rs_localizer.io.maps.landmarks import Map, MapError
from rs_localizer.io.outputs import Localized
from rs_localizer.io.topics import CAMERA_INFO, MAP_POINTS
from rs_localizer.io.transforms import Transforms, TransformTree
from rs_localizer.localizer import Localizer
from rs_localizer.matching import Matcher, MatchError
from rs_localizer.pipeline.compiling import note_whole, plain_frames
from rs_localizer.pipeline.given_pose import GivenPose, PosePrior
from rs_localizer.pipeline.imu import ImuInput, inertial_settings
from rs_localizer.pipeline.pose_at_time import middle_row_ns, pose_at, twist_at
from rs_localizer.pipeline.published import ReadoutKnown, of_body, of_camera
from rs_localizer.pipeline.readout_watch import ReadoutWatch, Watched
from rs_localizer.pipeline.refusal import Notify, Refusal, read_or_refuse, unheard
from rs_localizer.pipeline.stream import Stream
from rs_localizer.pipeline.tags import Tags, read_tags
from rs_localizer.solvers.table import find_solver
from rs_localizer.tracking import Memory, Tracker
from rs_localizer.trajectory import online_readout


class Landmarks:
    """The map that keypoints are matched with, as soon as there is one.

    Args:
        notice: told what is odd.
    """

    def __init__(self, notice: Notify) -> None:
        self._notice = notice
        self._matcher: Matcher | None = None
        self.error_modes: ErrorModes | None = None
        self.lacking = False
        """Whether keypoints have come before a map, and no frame has been localized since."""

    @property
    def map(self) -> Map | None:
        """The present one."""
        return None if self._matcher is None else self._matcher.map

    def use(self, landmarks: Map) -> None:
        """Match with this map from now on."""
        previous = self.map
        if previous is not None and landmarks.equals(previous):
            return  # published again
        for name, text in oddities_of_map(landmarks, previous).items():
            self._notice(name, text)
        self._matcher = Matcher(landmarks)
        modes = landmarks.error_modes
        self.error_modes = None if modes is None else ErrorModes(landmarks.points, modes)
        self.lacking = False

    def how(self, keypoints: Keypoints, settings: Matching) -> MatchBy | Refusal:
        """By what they can be matched."""
        if self._matcher is None:
            self.lacking = True
            return Refusal(
                Reason.NO_MAP, "no usable map has come yet, on map_points or as map_file"
            )
        try:
            by = self._matcher.choose(keypoints, settings)
        except MatchError as error:
            return Refusal(Reason.BAD_KEYPOINTS, str(error))
        if by == MatchBy.DESCRIPTOR and len(keypoints) > settings.max_keypoints:
            self._notice(
                Notice.TOO_MANY_KEYPOINTS,
                f"{len(keypoints)} keypoints have come, matching.max_keypoints of them, "
                f"{settings.max_keypoints}, are matched",
            )
        return by

    def match(
        self, keypoints: Keypoints, settings: Matching, camera: Camera, prior: Prior | None
    ) -> Correspondences | Refusal:
        """Correspondences, all over the map or where a motion predicts them only."""
        assert self._matcher is not None
        matches = self._matcher.match(keypoints, settings, camera, prior)
        if len(matches) == 0:
            return Refusal(
                Reason.NO_MATCHES,
                f"none of {len(keypoints)} keypoints matches one of {len(self._matcher.map)} "
                f"landmarks by {matches.by}",
            )
        return matching.correspondences(matches, keypoints, self._matcher.map)


def read_landmarks(file: str, frame: str) -> Map:
    """The map of a file, to match keypoints with.

    Args:
        file: its path; ``~`` is the user's home.
        frame: of its points.

    Raises:
        MapError: for a file that cannot be read or holds no such map.
    """
    path = Path(file).expanduser()
    try:
        landmarks = read_map_file(path, frame)
    except MapError as error:
        raise MapError(f"map_file: {error}") from error
    except OSError as error:
        raise MapError(f"map_file: {path} cannot be read: {error.strerror or error}") from error
    if landmarks.ids is None and landmarks.descriptors is None:
        raise MapError(
            f"map_file: {path}: keypoints cannot be matched with a map that has neither ids "
            "nor descriptors"
        )
    return landmarks


def oddities_of_map(landmarks: Map, previous: Map | None) -> dict[Notice, str]:
    """What is worth telling of a map that takes the place of another, or of none."""
    notices: dict[Notice, str] = {}
    if landmarks.dropped:
        notices[Notice.MAP_INCOMPLETE] = (
            f"{landmarks.dropped} landmarks are left out: they hold NaN or infinity, or no "
            "descriptor"
        )
    if previous is not None:
        notices[Notice.MAP_REPLACED] = (
            f"a map of {len(landmarks)} landmarks in frame {landmarks.frame!r} replaces the "
            f"one of {len(previous)} in frame {previous.frame!r}"
        )
    return notices


# From this chance on of a wrong pose or map, it is more probable than not.
_DOUBTFUL = 0.5
# Coordinates in single precision shall tell millimetres, in m: they do as far as 8 km.
_FINE = 0.00097
# Trackers of features may find a point somewhat outside, in px.
_SLACK = 1.0


def oddities(cloud: Correspondences, camera: Camera, camera_frame: str) -> dict[Notice, str]:
    """What is odd, a sentence each.

    Args:
        cloud: of one image.
        camera: that ``camera_info`` describes.
        camera_frame: its optical frame.
    """
    notices: dict[Notice, str] = {}
    if cloud.frame == camera_frame:
        notices[Notice.MAP_IS_CAMERA] = (
            f"the points are given in {cloud.frame!r}, which is the camera's own frame: "
            "header.frame_id of the cloud (or map) must name the frame of x, y, z"
        )
    if len(cloud.points) > 0 and cloud.table.dtype["x"].itemsize <= 4:
        largest = np.abs(cloud.points).max()
        step = float(np.spacing(np.float32(largest)))
        if step >= _FINE:
            notices[Notice.COARSE_COORDINATES] = (
                f"coordinates of {largest:.0f} m in FLOAT32 are known to {1e3 * step:.0f} mm "
                "only: send them as FLOAT64, or from an origin nearby"
            )
    width, height = camera.size
    limit = np.array(camera.size) - 0.5 + _SLACK
    outside = np.any((cloud.pixels < -0.5 - _SLACK) | (cloud.pixels > limit), axis=1)
    if np.any(outside):
        u, v = cloud.pixels[outside][0]
        notices[Notice.PIXELS_OUTSIDE] = (
            f"{outside.sum()} of {len(outside)} pixels lie outside the {width} x {height} of "
            f"camera_info, as ({u:.0f}, {v:.0f}): are both of the same camera and resolution?"
        )
    return notices


def lens_is_off(lens: LensError) -> str:
    """What to say of a calibration that lacks distortion."""
    return (
        f"residuals vary smoothly over the image (up to {lens.pixels:.1f} px): recalibrate the "
        "lens; until then poses allow for it"
    )


ANY_CALIBRATION = Calibration(
    "camera", 640, 480, (500.0, 0.0, 319.5, 0.0, 500.0, 239.5, 0.0, 0.0, 1.0), (), "plumb_bob",
    (1, 1), None,
)  # fmt: skip
"""Stands in until the first camera_info: kernels are compiled and settings checked before it."""
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


# Settings that change what is made of an estimate, or which points come to it, and not how it is
# made. All others start the track afresh.
_BESIDE = frozenset({
    "readout_time_deviation", "estimate_readout_time", "pose_time", "max_points", "base_frame",
    "odom_frame", "publish_tf", "tf_rate", "hold", "two_d_mode", "orientation_covariance",
    "transform_tolerance", "map_file", "map_frame", "marker_map", "matching", "autostart",
})  # fmt: skip


def _of_estimates(config: NodeConfig) -> tuple[object, ...]:
    config = replace(config, imu=replace(config.imu, wait=0.0))
    return tuple(getattr(config, it.name) for it in fields(config) if it.name not in _BESIDE)


class FrameLocalizer:
    """Localizes correspondences, or keypoints by a map, with the latest camera and settings.

    With ``tracking``, a readout time and a rolling-shutter solver it remembers the previous frame;
    new settings, a new camera, points in another frame and a time before the last one start it
    afresh.

    Args:
        config: settings; assigning :attr:`config` changes them from the next frame on.
        notice: told of what is odd but no refusal.
        transforms: where the camera is on ``base_frame``; asked once a frame, so that a mounting
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
        self.readout_watch = ReadoutWatch(notice)
        self._landmarks = Landmarks(notice)
        self._tags: Tags | None = None
        self._stream = Stream(notice, self._forget_motion)
        self._pose_prior = PosePrior(notice)
        self._calibration: Calibration | None = None
        self._too_many = False  # whether clouds above max_points have been noticed
        self._settings = config  # a readout time that is estimated takes the place of theirs
        self._use(ANY_CALIBRATION, config)

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
        if _of_estimates(config) == _of_estimates(self._settings):
            # The readout that was adopted stays.
            now = self.config
            self._config = replace(
                config, readout_time=now.readout_time, scan_direction=now.scan_direction
            )
            self._settings = config
            return False
        self._use(self._calibration or ANY_CALIBRATION, config)
        self._settings = config
        return True

    def _use(self, calibration: Calibration, config: NodeConfig) -> None:
        # Nothing changes if this raises: camera, tracker and settings always belong together.
        camera = calibration.camera(config.readout_time, config.scan_direction)
        localizer = Localizer(camera, config)
        rolling = find_solver(config.solver).rolling_shutter
        timed = config.readout_time > 0.0 and rolling
        memory = Memory.NOTHING
        if config.tracking and rolling:
            # Without a readout time frames cannot predict each other; map and lens stay the same.
            memory = Memory.MOTION if timed else Memory.MAP_AND_LENS
        inertial = inertial_settings(config) if timed else None
        self._tracker = Tracker(localizer, inertial, memory)
        self._camera, self._config = camera, config
        self.readout_watch.reset()

    def _middle_row_ns(self, stamp_ns: int) -> int:
        """When the middle row of the image with this stamp was exposed."""
        return middle_row_ns(self._config, self._camera, stamp_ns)

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
        return (*camera, MAP_POINTS) if self._landmarks.lacking else camera

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
        if self._calibration is None:
            return None
        width, height = np.array(self._camera.size) - 1.0
        corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
        return self._camera.bearings(corners)

    def reset(self) -> None:
        """Forget the previous frames."""
        self._stream.reset()
        self._forget_motion()

    def _forget_motion(self) -> None:
        self.readout_watch.reset()
        self._tracker.reset()

    def warm_up(self) -> None:
        """Have compiled, or load, what a plain frame needs, from points to messages."""
        plain_frames(self._tracker.localizer)
        so3.quaternion(pose_at(_STILL, 0.5).rotation.copy())
        twist_at(_STILL, 0.5, 1.0)

    def warm_up_rest(self) -> None:
        """The same of what any frame may need but for an IMU's; notes that it is there.

        Raises:
            OSError: when it could not be kept.
        """
        self.warm_up()
        self._tracker.localizer.warm_up()
        so3.log(np.eye(3))
        so3.exp_many(np.zeros((1, 3)))  # of the watch over the readout time
        online_readout.warm_up(self._camera)
        matching.warm_up()
        note_whole(self._config.solver)

    def warm_up_imu(self) -> None:
        """The same of what plain frames beside an IMU need."""
        plain_frames(self._tracker.localizer, inertial_settings(self._config))

    def calibrate(self, calibration: Calibration) -> None:
        """Use this calibration from the next frame on.

        Raises:
            MessageError: for one that no camera can have; the previous stays.
        """
        if calibration == self._calibration:  # drivers repeat it with every image
            return
        self._use(calibration, self._settings)
        before, self._calibration = self._calibration, calibration
        if before is not None:
            self._notice(
                Notice.CAMERA_CHANGED,
                f"camera_info changed from {before.frame!r}, {before.width} x {before.height}, "
                f"to {calibration.frame!r}, {calibration.width} x {calibration.height}; the "
                "previous frames are forgotten (if it goes to and fro, two cameras publish it)",
            )

    def awaits_imu(self, stamp_ns: int, patience: float) -> bool:
        """Whether readings of the frame with this stamp may yet come within so many s."""
        time_ns = self._middle_row_ns(stamp_ns)
        return self.imu.awaits(self._tracker, self._config, time_ns, patience)

    def load_map(self) -> None:
        """Use the maps of the settings ``map_file`` and ``marker_map``, where there are any.

        Raises:
            ValueError: for a file that cannot be read or holds no such map.
        """
        if self.config.marker_map:
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
        if self._calibration is None or self._tracker.prediction(time_ns) is not None:
            return
        prior = self._pose_prior.prior(
            time_ns, map_frame, self._calibration.frame, self._config, self.transforms
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
        return result

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
        by = self._landmarks.how(keypoints, self.config.matching)
        if isinstance(by, Refusal):
            return by
        if by == MatchBy.DESCRIPTOR and self._config.matching.gate > 0.0:
            time_ns = self._middle_row_ns(keypoints.stamp_ns)
            if self.map is not None:
                self._expect(time_ns, self.map.frame)
            prior = self._tracker.prediction(time_ns)
            result = None if prior is None else self._localize_by_map(keypoints, prior)
            # Without its mounting a pose is none the worse.
            if result or (result is not None and result.reason is Reason.NO_TRANSFORM):
                return result
        return self._localize_by_map(keypoints, None)

    def localize_detections(self, message: Any) -> Localized | Refusal:
        """Localize one AprilTagDetectionArray by ``marker_map``; never raises for bad ones."""
        if self._tags is None:
            return Refusal(Reason.NO_MAP, "detections need the setting marker_map")
        cloud = self._tags.match(message)
        return cloud if isinstance(cloud, Refusal) else self.localize_cloud(cloud)

    def _localize_by_map(self, keypoints: Keypoints, prior: Prior | None) -> Localized | Refusal:
        cloud = self._landmarks.match(keypoints, self._config.matching, self._camera, prior)
        return cloud if isinstance(cloud, Refusal) else self._localize(cloud)

    def _localize(self, cloud: Correspondences) -> Localized | Refusal:
        if self._calibration is None:
            return Refusal(Reason.NO_CAMERA_INFO, "no usable camera_info has come yet")
        config, camera, frame = self._config, self._camera, self._calibration.frame
        for name, text in oddities(cloud, camera, frame).items():
            self._notice(name, text)
        cloud = self._thinned(cloud)
        watch, tracker = self.readout_watch, self._tracker
        deviation = max(config.readout_time_deviation, watch.error)
        time_ns = self._middle_row_ns(cloud.stamp_ns)
        tracker.of_rest = watch.of_rest
        tracker.trusts_readout_time = watch.trusted
        tracker.readout_time_deviation = deviation
        tracker.localizer.error_modes = self._landmarks.error_modes
        self._expect(time_ns, cloud.frame)
        matches = (cloud.points, cloud.pixels, cloud.scores)
        result = self.imu.track(tracker, config, time_ns, frame, self.transforms, matches)
        try:
            adopted = watch.add(Watched(time_ns, cloud, result, config, camera))
        except NotCompiled:  # what it takes comes, and the next frames tell it more
            watch.reset()
            adopted = config
        wrong_axis = watch.wrong_axis
        if adopted is not config:
            self._use(self._calibration, adopted)
        if wrong_axis:
            return Refusal(Reason.SCAN_AXIS, wrong_axis)
        if not result:
            return Refusal(result.reason, result.detail)
        self._stream.pace(time_ns, result, config)
        self._pose_prior.judge(result)
        if result.integrity > _DOUBTFUL:
            text = f"pose or map are wrong with a probability of {result.integrity:.0%}"
            self._notice(Notice.DOUBTFUL, text)
        if result.lens is not None and not watch.axis_in_doubt:
            self._notice(Notice.LENS, lens_is_off(result.lens))
        readout = ReadoutKnown(
            deviation, watch.may_be_reversed, watch.surely_global, watch.other_axis
        )
        return self.mounted(of_camera(cloud, result, config, camera, frame, readout))

    def _thinned(self, cloud: Correspondences) -> Correspondences:
        """The cloud with no more points than ``max_points``, which is said once."""
        most = self.config.max_points
        if len(cloud.points) > most and not self._too_many:
            self._too_many = True
            self._notice(
                Notice.TOO_MANY_POINTS,
                f"{len(cloud.points)} points have come; max_points of them, {most}, are used",
            )
        return thinned(cloud, most, self._camera.size)

    def mounted(self, localized: Localized) -> Localized | Refusal:
        """The result of ``base_frame``, from that of the camera."""
        return of_body(localized, self.config, self.transforms)
