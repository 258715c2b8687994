# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The debug pictures of the marker detector: drawn when the localizer's answer has come."""

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import CameraInfo

from rs_localizer.config import DetectorConfig
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Notice, Reason
from rs_localizer.io.camera_info import Calibration, read_camera_info
from rs_localizer.io.images import Image
from rs_localizer.io.messages import MessageError, stamp_ns
from rs_localizer.io.topics import CAMERA_INFO, ODOMETRY, POSE
from rs_localizer.markers.overlay import CameraPath, Picture, draw_detections, draw_world
from rs_localizer.markers.poses import rotation_of_quaternion
from rs_localizer.pipeline.images import Detected
from rs_localizer.ros.node.conversion import xyz
from rs_localizer.ros.node.inputs import LATCHED, Topic
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.worker import Worker
from rs_localizer.settings import NODE_NAME

# Images that wait for a pose; those without one are shown without cubes.
_WAITING = 3
# After so many images without an answer nobody localizes, and none waits.
_PATIENCE = 10
# Poses that wait for an image.
_MOST_POSES = 100

_POSE, _ODOMETRY = f"{NODE_NAME}/{POSE}", f"{NODE_NAME}/{ODOMETRY}"

Show = Callable[[Image, Picture], None]


class DebugPictures:
    """Holds images until their poses come; lives in the worker's thread.

    Args:
        show: takes the finished picture of an image.
        notice: told why no cubes are drawn, by a name and one sentence.
    """

    def __init__(self, show: Show, notice: Callable[[str, str], None]) -> None:
        self._show = show
        self._notice = notice
        self._calibration: Calibration | None = None
        self._waiting: deque[Detected] = deque()
        self._poses: dict[int, CameraPath] = {}  # without a twist, by stamp
        self._unanswered = _PATIENCE

    def add(self, detected: Detected, config: DetectorConfig) -> None:
        """Take an image; the oldest that still waits is shown as it is."""
        self._waiting.append(detected)
        self._unanswered += 1
        while len(self._waiting) > (_WAITING if self._unanswered <= _PATIENCE else 0):
            oldest = self._waiting.popleft()
            self._finish(oldest, self._pose_of(oldest, config), config)
        for stamp in [s for s in self._poses if s < detected.image.stamp_ns - 10**9]:
            del self._poses[stamp]

    def take_camera_info(self, calibration: Calibration) -> None:
        self._calibration = calibration

    def take_pose(self, message: Any) -> None:
        """A geometry_msgs/PoseStamped; of use where no odometry comes, without a twist."""
        self._unanswered = 0
        still = np.zeros(3)
        self._poses[stamp_ns(message)] = _path(message, message.pose, still, still)
        while len(self._poses) > _MOST_POSES:
            del self._poses[next(iter(self._poses))]

    def take_odometry(self, message: Any, config: DetectorConfig) -> None:
        """A nav_msgs/Odometry, of the camera in the map: show the image that it belongs to."""
        if self._calibration is not None and message.child_frame_id != self._calibration.frame:
            self._notice(
                Notice.OTHER_BODY,
                f"the odometry is of {message.child_frame_id}, not of the camera "
                f"({self._calibration.frame}): no cubes are drawn",
            )
            return
        self._unanswered = 0
        twist = message.twist.twist
        path = _path(message, message.pose.pose, xyz(twist.linear), xyz(twist.angular))
        for item in self._waiting:
            if self._belongs(path, item, config):
                while self._waiting[0] is not item:
                    self._finish(self._waiting.popleft(), None, config)
                self._finish(self._waiting.popleft(), path, config)
                return

    def _belongs(self, path: CameraPath, detected: Detected, config: DetectorConfig) -> bool:
        """With ``pose_time: mid_frame``, the pose's stamp is up to a readout later."""
        after = (path.stamp_ns - detected.image.stamp_ns) * 1e-9 - config.stamp_offset
        offset = abs(config.stamp_offset)
        return -offset - 1e-6 <= after <= config.readout_time + offset + 1e-6

    def _pose_of(self, detected: Detected, config: DetectorConfig) -> CameraPath | None:
        paths = (path for path in self._poses.values() if self._belongs(path, detected, config))
        return next(paths, None)

    def _finish(self, detected: Detected, path: CameraPath | None, config: DetectorConfig) -> None:
        picture = draw_detections(detected.image.pixels, detected.detections)
        camera = self._camera(config)
        if path is not None and camera is not None:
            first_row_ns = detected.image.stamp_ns + round(1e9 * config.stamp_offset)
            draw_world(picture, detected.detections, detected.map, camera, path, first_row_ns)
        self._show(detected.image, picture)

    def _camera(self, config: DetectorConfig) -> Camera | None:
        if self._calibration is None:
            return None
        try:
            return self._calibration.camera(config.readout_time, config.scan_direction)
        except MessageError as error:
            self._notice(Reason.BAD_CAMERA_INFO, str(error))
            return None


def _path(message: Any, pose: Any, linear: Any, angular: Any) -> CameraPath:
    q = pose.orientation
    rotation = rotation_of_quaternion([q.x, q.y, q.z, q.w])
    return CameraPath(stamp_ns(message), xyz(pose.position), rotation, linear, angular)


def picture_topics(
    worker: Worker[Any, Any], pictures: DebugPictures, refusals: Refusals
) -> dict[str, Topic]:
    """What the pictures need besides the images: the calibration, and the localizer's answers.

    Args:
        worker: gets the updates, called in the thread of the inputs.
        pictures: of the worker.
        refusals: told of messages that cannot be used.
    """

    def take_camera_info(message: CameraInfo) -> None:
        try:
            calibration = read_camera_info(message)
        except MessageError as error:
            refusals.notice(Reason.BAD_CAMERA_INFO, str(error))
            return
        worker.update(CAMERA_INFO, lambda _: pictures.take_camera_info(calibration))

    def take_pose(message: PoseStamped) -> None:
        worker.update(POSE, lambda _: pictures.take_pose(message))

    def take_odometry(message: Odometry) -> None:
        worker.update(ODOMETRY, lambda work: pictures.take_odometry(message, work.config))

    return {
        CAMERA_INFO: Topic(CameraInfo, take_camera_info, LATCHED),
        _POSE: Topic(PoseStamped, take_pose),
        _ODOMETRY: Topic(Odometry, take_odometry),
    }
