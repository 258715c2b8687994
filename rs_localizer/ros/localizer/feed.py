"""What is fed to the worker of the localizer node: frames, and all that says how to localize them.

Messages come in the thread of the inputs, settings and requests in the executor's. What is no frame
becomes an update, which the worker's thread carries out between two frames.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.serialization import deserialize_message
from sensor_msgs.msg import CameraInfo, Imu, PointCloud2

from rs_localizer.config import ImuUse, NodeConfig
from rs_localizer.io.camera_info import Calibration, read_camera_info
from rs_localizer.io.imu import read_imu
from rs_localizer.io.keypoints import read_map
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.messages import MessageError, stamp_ns
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.ros.node.inputs import FAST_DATA, LATCHED, Topic
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.worker import Localize, Worker

FRAME_TOPICS = ("correspondences", "keypoints")
"""Inputs that are localized; the others say with what."""

# In a serialized message, which begins with four bytes of CDR and the stamp of its header.
_AFTER_STAMP = 12
# A change of settings that takes longer (s) has compiled kernels, and says so.
_LONG_CHANGE = 0.5


class Feed:
    """Reads messages where they come, so that a bad one never takes the place of a good one.

    Args:
        worker: gets frames and updates.
        frames: that of the worker, here only to be read.
        refusals: told of messages that cannot be used.
        say: takes a line for the log.
        needs_tf: called once when an IMU comes whose axes are not the camera's.
    """

    def __init__(
        self,
        worker: Worker,
        frames: FrameLocalizer,
        refusals: Refusals,
        say: Callable[[str], Any],
        needs_tf: Callable[[], None] = lambda: None,
    ) -> None:
        self._worker = worker
        self._frames = frames
        self._refusals = refusals
        self._say = say
        self._needs_tf: Callable[[], None] | None = needs_tf
        # The last that was handed on.
        self._camera_info = b""
        self._calibration: Calibration | None = None
        self.changing = False  # whether the worker compiles kernels for new settings

    def topics(self) -> dict[str, Topic]:
        """The inputs; what changes the state comes before the frames."""
        return {
            "camera_info": Topic(CameraInfo, self._take_camera_info, LATCHED, raw=True),
            "map_points": Topic(PointCloud2, self._take_map, LATCHED, lasting=True),
            "imu": Topic(Imu, self._take_imu, FAST_DATA, raw=True),
            "correspondences": self._localized_by(
                "correspondences", lambda frames, message: frames.localize(message)
            ),
            "keypoints": self._localized_by(
                "keypoints", lambda frames, message: frames.localize_keypoints(message)
            ),
        }

    def take_config(self, config: NodeConfig) -> None:
        """Use these settings from the next frame on."""
        self._worker.update("settings", lambda frames: self._change(frames, config))

    def reset(self) -> None:
        """Forget the previous frames."""
        self._worker.update("reset", FrameLocalizer.reset)

    # -- in the thread of the inputs ---------------------------------------------------------

    def _localized_by(self, topic: str, localize: Localize) -> Topic:
        """A topic whose messages are frames, which the worker localizes in this way."""

        def take(message: PointCloud2) -> None:
            wait = self._frames.config.imu.wait
            self._worker.localize(topic, message, localize, _awaits_imu, wait)

        return Topic(PointCloud2, take)

    def _take_imu(self, serialized: bytes) -> None:
        if self._frames.config.imu.use == ImuUse.NONE:
            return
        try:
            reading = read_imu(deserialize_message(serialized, Imu))
        except MessageError as error:
            self._refusals.add("bad_imu", str(error))
            return
        self._frames.imu.add(reading)
        self._worker.look()
        if self._needs_tf is not None and reading.frame != self._frames.camera_frame:
            self._needs_tf()
            self._needs_tf = None

    def _take_camera_info(self, serialized: bytes) -> None:
        # Drivers repeat it with every image, and only its stamp is new.
        content = serialized[_AFTER_STAMP:]
        if content == self._camera_info and self._calibration == self._frames.calibration:
            return
        try:
            calibration = read_camera_info(deserialize_message(serialized, CameraInfo))
        except MessageError as error:
            self._refusals.add("bad_camera_info", str(error))
            return
        self._camera_info, self._calibration = content, calibration
        self._worker.update("camera_info", lambda frames: self._calibrate(frames, calibration))

    def _take_map(self, message: PointCloud2) -> None:
        # Meanwhile frames are localized by the previous one.
        try:
            landmarks = read_map(message)
        except MessageError as error:
            self._refusals.add("bad_map", str(error))
            return
        self._worker.update("map", lambda frames: self._use_map(frames, landmarks))

    # -- in the worker's thread, between two frames ------------------------------------------

    def _calibrate(self, frames: FrameLocalizer, calibration: Calibration) -> None:
        try:
            frames.calibrate(calibration)
        except MessageError as error:
            self._refusals.add("bad_camera_info", str(error))

    def _use_map(self, frames: FrameLocalizer, landmarks: Map) -> None:
        if frames.map is None or not landmarks.equals(frames.map):
            frames.use_map(landmarks)
            self._say(described(landmarks))

    def _change(self, frames: FrameLocalizer, config: NodeConfig) -> None:
        self.changing = True
        try:
            frames.config = config
            seconds = warm_up(frames)
        finally:
            self.changing = False
        if seconds > _LONG_CHANGE:
            self._say(f"kernels for the new settings are ready after {seconds:.1f} s")


def _awaits_imu(frames: FrameLocalizer, message: PointCloud2) -> bool:
    return frames.awaits_imu(stamp_ns(message), frames.config.imu.wait)


def described(landmarks: Map) -> str:
    """A map in one line."""
    return f"the map has {len(landmarks)} landmarks in frame {landmarks.frame!r}"


def warm_up(frames: FrameLocalizer) -> float:
    """Compile all kernels that the settings need; how many seconds it took."""
    started = time.monotonic()
    frames.warm_up()
    return time.monotonic() - started
