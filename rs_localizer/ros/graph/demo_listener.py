"""Hears what a live localizer node publishes."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import PointCloud2

from rs_localizer.evaluation.comparison import Answer
from rs_localizer.io import topics
from rs_localizer.io.messages import stamp_ns

_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
# Of the diagnostics: frames that will never be answered.
_UNANSWERED = ("Frames refused", "Frames replaced", "Frames dropped")
# Frames that the latency is judged by.
_RECENT = 20


class Listener:
    """Collects what one node publishes, by the stamp of the frame.

    Args:
        delay_ns: from the stamp of a frame to that of its pose and twist.
    """

    def __init__(self, delay_ns: int) -> None:
        self._delay_ns = delay_ns
        self._status = ""
        self.unanswered: int | None = None  # frames, by the node's diagnostics; None: none came yet
        self.clear()

    def clear(self) -> None:
        self._sent: dict[int, float] = {}
        self._arrived: dict[int, float] = {}
        self._poses: dict[int, PoseStamped] = {}
        self._twists: dict[int, TwistStamped] = {}
        self._inliers: dict[int, PointCloud2] = {}

    def subscribe(self, node: Any, prefix: str) -> None:
        for message_type, name, callback in (
            (PoseStamped, topics.POSE, self._take_pose),
            (TwistStamped, topics.TWIST, self._take_twist),
            (PointCloud2, topics.INLIERS, self._take_inliers),
        ):
            node.create_subscription(message_type, f"{prefix}/{name}", callback, _QOS)
        self._status = f"{prefix.lstrip('/')}: localizer"
        node.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, self._take_status, _QOS)

    def expect(self, stamp: int) -> None:
        self._sent[stamp] = time.perf_counter()

    def has(self, stamp: int) -> bool:
        """Whether this frame has been answered; the inliers are published last."""
        return stamp in self._poses and stamp in self._inliers

    def latencies(self) -> list[float]:
        """Seconds from sending a frame to its pose, of the last frames that were answered."""
        recent = list(self._arrived.items())[-_RECENT:]
        return [arrived - self._sent[stamp] for stamp, arrived in recent if stamp in self._sent]

    def answers(self) -> dict[int, Answer]:
        return {stamp: self._answer(stamp) for stamp in self._sent if self.has(stamp)}

    def _answer(self, stamp: int) -> Answer:
        pose, twist = self._poses[stamp], self._twists.get(stamp)
        return Answer(
            input_stamp_ns=stamp,
            latency=self._arrived[stamp] - self._sent[stamp],
            stamp_ns=stamp_ns(pose),
            position=_xyz(pose.pose.position),
            quaternion=np.append(_xyz(pose.pose.orientation), pose.pose.orientation.w),
            angular=None if twist is None else _xyz(twist.twist.angular),
            linear=None if twist is None else _xyz(twist.twist.linear),
            residuals=_residuals(self._inliers[stamp]),
        )

    def _take_pose(self, message: PoseStamped) -> None:
        stamp = stamp_ns(message) - self._delay_ns
        self._arrived[stamp] = time.perf_counter()
        self._poses[stamp] = message

    def _take_twist(self, message: TwistStamped) -> None:
        self._twists[stamp_ns(message) - self._delay_ns] = message

    def _take_status(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == self._status:
                values = {item.key: item.value for item in status.values}
                self.unanswered = sum(int(values.get(name, 0)) for name in _UNANSWERED)

    def _take_inliers(self, message: PointCloud2) -> None:
        self._inliers[stamp_ns(message)] = message


def _xyz(vector: Any) -> np.ndarray:
    return np.array([vector.x, vector.y, vector.z])


def _residuals(cloud: PointCloud2) -> np.ndarray:
    (field,) = (field for field in cloud.fields if field.name == "residual")
    column = np.ndarray((cloud.width,), "<f4", cloud.data, field.offset, (cloud.point_step,))
    return column.astype(np.float64)
