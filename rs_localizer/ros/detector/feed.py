"""What is fed to the worker of the marker detector: images, and what the debug pictures need."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from rs_localizer.config import DetectorConfig
from rs_localizer.core.reasons import Reason
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.messages import MessageError
from rs_localizer.io.topics import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, ODOMETRY, POSE
from rs_localizer.pipeline.images import Detected, FrameDetector
from rs_localizer.ros.detector.debug import DebugPictures
from rs_localizer.ros.node.inputs import LATCHED, Topic
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.worker import Worker
from rs_localizer.settings import NODE_NAME

IMAGES = {IMAGE: Image, COMPRESSED_IMAGE: CompressedImage}
"""Types of the topics whose messages are looked at."""

_POSE, _ODOMETRY = f"{NODE_NAME}/{POSE}", f"{NODE_NAME}/{ODOMETRY}"
FOR_PICTURES = (CAMERA_INFO, _POSE, _ODOMETRY)
"""Topics that are needed for debug pictures only."""


@dataclass(slots=True)
class Work:
    """What the worker alone touches."""

    detector: FrameDetector
    config: DetectorConfig
    debug: DebugPictures


class Feed:
    """Hands messages to the worker; called in the thread of the inputs.

    Args:
        worker: gets images and updates.
        refusals: told of messages that cannot be used.
    """

    def __init__(self, worker: Worker[Work, Detected], refusals: Refusals) -> None:
        self._worker = worker
        self._refusals = refusals

    def topics(self) -> dict[str, Topic]:
        """All that may be listened to."""
        images = {name: Topic(kind, self._images(name)) for name, kind in IMAGES.items()}
        return images | {
            CAMERA_INFO: Topic(CameraInfo, self._take_camera_info, LATCHED),
            _POSE: Topic(PoseStamped, self._take_pose),
            _ODOMETRY: Topic(Odometry, self._take_odometry),
        }

    def _images(self, topic: str) -> Callable[[Any], None]:
        def take(message: Any) -> None:
            self._worker.process(topic, message, lambda work, image: work.detector.take(image))

        return take

    def _take_camera_info(self, message: CameraInfo) -> None:
        try:
            calibration = read_camera_info(message)
        except MessageError as error:
            self._refusals.notice(Reason.BAD_CAMERA_INFO, str(error))
            return
        self._worker.update(CAMERA_INFO, lambda work: work.debug.take_camera_info(calibration))

    def _take_pose(self, message: PoseStamped) -> None:
        self._worker.update(POSE, lambda work: work.debug.take_pose(message))

    def _take_odometry(self, message: Odometry) -> None:
        self._worker.update(ODOMETRY, lambda work: work.debug.take_odometry(message, work.config))
