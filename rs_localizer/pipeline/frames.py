"""A frame from message to pose: what the live node and the offline replay share.

Both feed their messages to a :class:`FrameLocalizer` and publish what
:func:`rs_localizer.io.outputs.messages` makes of the result, so that both say the same.
"""

from __future__ import annotations

from typing import Any

from rs_localizer.config import MatchBy, NodeConfig
from rs_localizer.core.reasons import Notice, Reason
from rs_localizer.estimation.prior import Prior
from rs_localizer.io.camera_info import Calibration
from rs_localizer.io.clouds import (
    Correspondences,
    EmptyCloudError,
    read_correspondences,
    thinned,
)
from rs_localizer.io.keypoints import Keypoints, read_keypoints
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.messages import MessageError
from rs_localizer.io.outputs import Localized
from rs_localizer.io.topics import CAMERA_INFO, MAP_POINTS
from rs_localizer.io.transforms import Transforms, TransformTree
from rs_localizer.pipeline.imu import ImuInput
from rs_localizer.pipeline.input_checks import StreamResets, lens_is_off, oddities
from rs_localizer.pipeline.landmarks import Landmarks, read_landmarks
from rs_localizer.pipeline.method import ANY_CALIBRATION, Method
from rs_localizer.pipeline.published import ReadoutKnown, of_body, of_camera
from rs_localizer.pipeline.readout_watch import ReadoutWatch
from rs_localizer.pipeline.refusal import Notify, Refusal, unheard


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
        self.imu = ImuInput(notice)
        self.readout_watch = ReadoutWatch(notice)
        self._landmarks = Landmarks(notice)
        self._resets = StreamResets()
        self._calibration: Calibration | None = None
        self._too_many = False  # whether clouds above max_points have been noticed
        self._given = config  # the readout time may be found on the way
        self._method = Method.of(ANY_CALIBRATION, config)

    @property
    def config(self) -> NodeConfig:
        return self._method.config

    @config.setter
    def config(self, config: NodeConfig) -> None:
        self._use(self._calibration or ANY_CALIBRATION, config)
        self._given = config

    def _use(self, calibration: Calibration, config: NodeConfig) -> None:
        # Nothing changes if this raises: camera, localizer and settings always belong together.
        self._method = Method.of(calibration, config)
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
        return (*camera, MAP_POINTS) if self._landmarks.lacking else camera

    @property
    def map(self) -> Map | None:
        """The map that keypoints are matched with."""
        return self._landmarks.map

    def reset(self) -> None:
        """Forget the previous frames."""
        self._resets.forget()
        self._forget_motion()

    def _forget_motion(self) -> None:
        self.readout_watch.reset()
        self._method.frames.reset()

    def warm_up(self) -> None:
        """Compile all that the present settings need, from points to messages."""
        self._method.warm_up()
        self.readout_watch.warm_up(self._method.camera)

    def calibrate(self, calibration: Calibration) -> None:
        """Use this calibration from the next frame on.

        Raises:
            MessageError: for one that no camera can have; the previous stays.
        """
        if calibration == self._calibration:  # drivers repeat it with every image
            return
        self._use(calibration, self._given)
        before, self._calibration = self._calibration, calibration
        if before is not None:
            self._notice(
                Notice.CAMERA_CHANGED,
                f"camera_info changed from {before.frame!r}, {before.width} x {before.height}, "
                f"to {calibration.frame!r}, {calibration.width} x {calibration.height}; the "
                "previous frames are forgotten (if it goes to and fro, two cameras publish it)",
            )

    def awaits_imu(self, stamp_ns: int, patience: float) -> bool:
        """Whether readings of the frame with this stamp are missing that may come within so many
        seconds.
        """
        time_ns = self._method.middle_row_ns(stamp_ns)
        return self.imu.awaits(self._method.frames, self.config, time_ns, patience)

    def load_map(self) -> None:
        """Use the map of the setting ``map_file``, if there is one.

        Raises:
            MapError: for a file that cannot be read or holds no map to match keypoints with.
        """
        if self.config.map_file:
            self.use_map(read_landmarks(self.config.map_file, self.config.map_frame))

    def use_map(self, landmarks: Map) -> None:
        """Match keypoints with this map from the next frame on."""
        self._landmarks.use(landmarks)

    def localize(self, message: Any) -> Localized | Refusal:
        """Localize one sensor_msgs/PointCloud2 of correspondences; never raises for bad ones."""
        try:
            cloud = read_correspondences(message)
        except EmptyCloudError as error:
            return Refusal(Reason.EMPTY_CLOUD, str(error))
        except MessageError as error:
            return Refusal(Reason.BAD_CLOUD, str(error))
        self._follow(cloud.stamp_ns, cloud.frame)
        result = self._localize(cloud)
        if result:
            self._landmarks.lacking = False  # who sends correspondences needs none
        return result

    def localize_keypoints(self, message: Any) -> Localized | Refusal:
        """Localize one sensor_msgs/PointCloud2 of keypoints; never raises for bad ones.

        Tracked, landmarks are first looked for where the motion predicts them only, then, if that
        gives no pose, all over the map.
        """
        try:
            keypoints = read_keypoints(message)
        except EmptyCloudError as error:
            return Refusal(Reason.EMPTY_CLOUD, str(error))
        except MessageError as error:
            return Refusal(Reason.BAD_KEYPOINTS, str(error))
        if self.map is not None:
            self._follow(keypoints.stamp_ns, self.map.frame)
        by = self._landmarks.how(keypoints, self.config.matching)
        if isinstance(by, Refusal):
            return by
        tracker = self._method.tracker
        if by == MatchBy.DESCRIPTOR and tracker is not None and self.config.matching.gate > 0.0:
            prior = tracker.prediction(self._method.middle_row_ns(keypoints.stamp_ns))
            result = None if prior is None else self._localize_by_map(keypoints, prior)
            # Without its mounting a pose is none the worse.
            if result or (result is not None and result.reason is Reason.NO_TRANSFORM):
                return result
        return self._localize_by_map(keypoints, None)

    def _localize_by_map(self, keypoints: Keypoints, prior: Prior | None) -> Localized | Refusal:
        method = self._method
        found = self._landmarks.match(keypoints, method.config.matching, method.camera, prior)
        return found if isinstance(found, Refusal) else self._localize(found)

    def _localize(self, cloud: Correspondences) -> Localized | Refusal:
        if self._calibration is None:
            return Refusal(Reason.NO_CAMERA_INFO, "no usable camera_info has come yet")
        method, frame = self._method, self._calibration.frame
        for name, text in oddities(cloud, method.camera, frame).items():
            self._notice(name, text)
        cloud = self._thinned(cloud)
        given = (cloud.points, cloud.pixels, cloud.scores)
        watch = self.readout_watch
        deviation = max(method.config.readout_time_deviation, watch.error)
        time_ns = method.middle_row_ns(cloud.stamp_ns)
        method.frames.of_rest = watch.of_rest
        if method.tracker is not None:
            method.tracker.trusts_readout_time = watch.trusted
            method.tracker.readout_time_deviation = deviation
        result = self.imu.track(
            method.frames, method.config, time_ns, frame, self.transforms, given
        )
        config = watch.add(method.config, method.camera, time_ns, result, cloud)
        wrong_axis = watch.wrong_axis
        if config is not method.config:
            self._use(method.calibration, config)
        if wrong_axis:
            return Refusal(Reason.SCAN_AXIS, wrong_axis)
        if not result:
            return Refusal(result.reason, result.detail)
        if result.lens is not None and not watch.axis_in_doubt:
            self._notice(Notice.LENS, lens_is_off(result.lens))
        known = ReadoutKnown(deviation, watch.may_be_reversed, watch.surely_global)
        return self.mounted(of_camera(cloud, result, method.config, method.camera, frame, known))

    def _thinned(self, cloud: Correspondences) -> Correspondences:
        """The cloud with no more points than ``max_points``, which is said once."""
        most = self.config.max_points
        if len(cloud.points) > most and not self._too_many:
            self._too_many = True
            self._notice(
                Notice.TOO_MANY_POINTS,
                f"{len(cloud.points)} points have come; max_points of them, {most}, are used",
            )
        return thinned(cloud, most, self._method.camera.size)

    def mounted(self, localized: Localized) -> Localized | Refusal:
        """The result of ``base_frame``, from that of the camera."""
        return of_body(localized, self.config, self.transforms)

    def _follow(self, stamp_ns: int, frame: str) -> None:
        """Start afresh where this frame cannot follow the last one."""
        for name, text in self._resets.breaks(stamp_ns, frame).items():
            self._forget_motion()
            self._notice(name, text)
