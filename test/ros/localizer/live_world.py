# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A live node, a peer that talks to it over DDS, and the frames that it sends."""

import array
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import CameraInfo, PointCloud2, PointField

from rs_localizer.ros.localizer.node import LocalizerNode
from rs_localizer.ros.node.managed import spin
from rs_localizer.simulation.scene import random_descriptors

from .robot import READOUT_TIME, inputs, record

PATIENCE = 20.0  # s, of a machine that is busy
CLOSE = 0.05  # m: the poses are right
SECOND = 1_000_000_000
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
DESCRIPTORS = random_descriptors(5000, np.random.default_rng(9))  # of the landmarks, by number


class World:
    """A live node in a thread, a peer that talks to it over DDS, and what the node has said.

    Args:
        bag: to be written: a flight without noise.
    """

    def __init__(self, bag: Path) -> None:
        self.truth = record(bag, noise=0.0, outliers=0.0)  # positions, of the frames
        infos, self.clouds = zip(*inputs(bag), strict=True)
        self.camera_info = infos[0]
        self.context = Context()
        rclpy.init(context=self.context)
        self.node = LocalizerNode(
            context=self.context, cli_args=["--ros-args", "-p", f"readout_time:={READOUT_TIME}"]
        )
        # Every single one, where the log leaves out repetitions.
        self.said: list[str] = []
        notice = self.node.refusals.notice
        self.node.refusals.notice = lambda *texts: (
            self.said.append(": ".join(texts)),
            notice(*texts),
        )
        assert self.node.trigger_configure().name == self.node.trigger_activate().name == "SUCCESS"
        self._stopped = threading.Event()
        self._threads = [threading.Thread(target=spin, args=(self.node, self._stopped.is_set))]
        self.peer = Peer(self.context)
        self._threads.append(threading.Thread(target=self._spin_peer))
        for thread in self._threads:
            thread.start()
        self.stamp = SECOND
        self.wait(self.peer.connected)

    # -- what faults need --------------------------------------------------------------------

    def cloud(self, index: int = 0, **changes: Any) -> PointCloud2:
        """A good frame, later than the last, with fields changed."""
        message = changed(self.clouds[index], changes)
        if "header" not in changes:
            self.stamp += SECOND // 30
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(self.stamp, SECOND)
        return message

    def info(self, **changes: Any) -> CameraInfo:
        """A good camera_info with fields changed."""
        return changed(self.camera_info, changes)

    def table(self) -> np.ndarray:
        """The rows of a good frame."""
        return self.table_of(self.clouds[0])

    def table_of(self, cloud: PointCloud2) -> np.ndarray:
        kinds = {PointField.FLOAT32: "<f4", PointField.UINT32: "<u4"}
        columns = [(item.name, kinds[item.datatype]) for item in cloud.fields]
        return np.frombuffer(bytes(cloud.data), columns).copy()

    def cloud_of(self, table: np.ndarray) -> PointCloud2:
        """A frame with these rows."""
        return self.cloud(
            width=len(table), row_step=table.nbytes, data=array.array("B", table.tobytes())
        )

    def send(self, *messages: Any) -> None:
        for message in messages:
            self.peer.send(message)

    def poses(self, *messages: Any, count: int = 1, within: float = PATIENCE) -> bool:
        """Send; whether so many poses come."""
        before = len(self.peer.poses)
        self.send(*messages)
        return self.until(lambda: len(self.peer.poses) >= before + count, within)

    def call(self, kind: Any, name: str, request: Any) -> Any:
        client = self.peer.node.create_client(kind, f"rs_localizer/{name}")
        assert client.wait_for_service(PATIENCE)
        future = client.call_async(request)
        assert self.until(future.done)
        self.peer.node.destroy_client(client)
        return future.result()

    def set(self, **values: object) -> str:
        """Set parameters at once: the reason of a refusal, else nothing."""
        parameters = [
            Parameter(name, value=value).to_parameter_msg() for name, value in values.items()
        ]
        request = SetParametersAtomically.Request(parameters=parameters)
        return str(
            self.call(SetParametersAtomically, "set_parameters_atomically", request).result.reason
        )

    def change_state(self, transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        return bool(self.call(ChangeState, "change_state", request).success)

    def diagnosis(self, text: str) -> bool:
        """Whether this comes up in the diagnostics."""
        del self.peer.diagnoses[:-1]
        return self.until(lambda: any(re.search(text, item) for item in self.peer.diagnoses))

    def until(self, condition: Callable[[], Any], within: float = PATIENCE) -> bool:
        deadline = time.monotonic() + within
        while not condition():
            if time.monotonic() > deadline:
                return False
            time.sleep(0.002)
        return True

    def wait(self, condition: Callable[[], Any]) -> None:
        assert self.until(condition)

    # ----------------------------------------------------------------------------------------

    def localizes(self) -> bool:
        """Whether a good frame is answered, and with the true position."""
        for _ in range(20):  # any of them may be lost while the node follows a publisher's quality
            if self.poses(self.camera_info, self.cloud(), within=1.0):
                found = self.peer.poses[-1].pose.position
                error = np.array([found.x, found.y, found.z]) - self.truth[0]
                return bool(np.linalg.norm(error) < CLOSE)
        return False

    def _spin_peer(self) -> None:
        executor = rclpy.executors.SingleThreadedExecutor(context=self.context)
        executor.add_node(self.peer.node)
        while not self._stopped.is_set():
            executor.spin_once(timeout_sec=0.05)

    def close(self) -> None:
        self._stopped.set()
        for thread in self._threads:
            thread.join()
        self.node.destroy_node()
        self.peer.node.destroy_node()
        rclpy.shutdown(context=self.context)


def changed(message: Any, changes: dict[str, Any]) -> Any:
    """A copy with other fields."""
    fields = {name: getattr(message, name) for name in message.get_fields_and_field_types()}
    return type(message)(**(fields | changes))


class Peer:
    """Publishes as a camera does, and listens."""

    def __init__(self, context: Context) -> None:
        self.node = Node("peer", context=context)
        self.poses: list[PoseStamped] = []
        self.diagnoses: list[str] = []
        create = self.node.create_publisher
        self._publishers = {
            CameraInfo: create(CameraInfo, "camera_info", 10),
            PointCloud2: create(PointCloud2, "correspondences", 10),
        }
        self._others = {
            "keypoints": create(PointCloud2, "keypoints", 10),
            "map_points": create(PointCloud2, "map_points", LATCHED),
        }
        self.node.create_subscription(PoseStamped, "rs_localizer/pose", self.poses.append, 100)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._take, 10)

    def connected(self) -> bool:
        publishers = [*self._publishers.values(), *self._others.values()]
        counts = [publisher.get_subscription_count() for publisher in publishers]
        return min(counts) > 0 and self.node.count_publishers("rs_localizer/pose") > 0

    def send(self, message: Any) -> None:
        """A camera_info or correspondences, or a pair of another topic and its message."""
        if isinstance(message, tuple):
            topic, message = message
            self._others[topic].publish(message)
        else:
            self._publishers[type(message)].publish(message)

    def _take(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = [f"{item.key} = {item.value}" for item in status.values]
            level = ["OK", "WARN", "ERROR", "STALE"][status.level[0]]
            self.diagnoses.append("\n".join([f"{level}: {status.message}", *values]))
