# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Plays recordings through live localizer nodes, one per method, and hears their answers."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Collection, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import median
from typing import Any, Self

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, PointCloud2

from rs_localizer.config import PoseTime
from rs_localizer.evaluation.comparison import Answer, Recording
from rs_localizer.io import topics
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.topics import CAMERA_INFO, CORRESPONDENCES
from rs_localizer.process.stopping import StopSignals
from rs_localizer.ros.node.conversion import copy_message, xyz
from rs_localizer.settings import NODE_NAME

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
            position=xyz(pose.pose.position),
            quaternion=np.append(xyz(pose.pose.orientation), pose.pose.orientation.w),
            angular=None if twist is None else xyz(twist.twist.angular),
            linear=None if twist is None else xyz(twist.twist.linear),
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


def _residuals(cloud: PointCloud2) -> np.ndarray:
    (field,) = (field for field in cloud.fields if field.name == "residual")
    column = np.ndarray((cloud.width,), "<f4", cloud.data, field.offset, (cloud.point_step,))
    return column.astype(np.float64)


# The installed executable may not be on the path; this starts the same node.
_NODE = "import sys; from rs_localizer.ros.main import main; sys.exit(main())"
_QOS = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE)
# The first start on a machine compiles all kernels.
_START_TIMEOUT = 300.0
_FIRST_ANSWER_TIMEOUT = 20.0
# A frame that is refused has no answer. How long to wait for one (s), in terms of the median so
# far; an answer that is later still counts when it comes.
_PATIENCE = 10.0
_ANSWER_TIMEOUT = (0.1, 1.0)
# How long a node that may lose no frame has (s) to say, once a second, that it has refused one.
_ACCOUNT_TIMEOUT = 30.0
_REST_TIME = 0.3
_STOP_TIMEOUT = 10.0


class SessionError(ValueError):
    """A node that did not start or did not answer."""


class Session:
    """A ROS context for live nodes; a context manager that leaves no process behind."""

    def __init__(self, log_directory: Path) -> None:
        self._log_directory = log_directory
        self._signals = StopSignals()
        # No one else's nodes shall hear these frames, or be heard.
        self.namespace = f"/demo_{os.getpid()}"

    def __enter__(self) -> Self:
        os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        self._signals.__enter__()
        rclpy.init()
        return self

    def __exit__(self, _: object, error: BaseException | None, __: object) -> None:
        rclpy.try_shutdown()
        self._signals.__exit__()
        if error is not None and self._signals.requested:
            # A signal also ends the context, and with it whatever call is under way.
            raise KeyboardInterrupt from error

    def play(
        self,
        recording: Recording,
        readout_time: float,
        methods: Mapping[str, Mapping[str, Any]],
        progress: Callable[[], None],
        lossless: Collection[str] = (),
        topic: str = CORRESPONDENCES,
    ) -> dict[str, dict[int, Answer]]:
        """Every frame to every node, as fast as the slowest of them answers.

        A node keeps only the newest of the frames that wait. On a busy machine, one that has not
        answered in time may still have the last frame before it, and the next one replaces it.

        Args:
            recording: what to publish.
            readout_time: s; the nodes answer for the middle row.
            methods: parameters of the node of each method, by a name that is a ROS namespace.
            progress: called after each frame.
            lossless: methods whose nodes get the next frame only after they have answered the last
                one, or said in their diagnostics that they will not.
            topic: of the nodes, on which they take the recording's clouds.

        Returns:
            for each method its answers by the stamp of the frame.

        Raises:
            SessionError: when a node does not start or answer; with the last lines of its log.
        """
        listeners = {name: Listener(round(0.5e9 * readout_time)) for name in methods}
        shutter = {"readout_time": readout_time, "pose_time": PoseTime.MID_FRAME}
        node = rclpy.create_node("demo", namespace=self.namespace)
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        processes: dict[str, subprocess.Popen[bytes]] = {}
        try:
            # Ctrl-C interrupts the main thread alone: what another one starts gets into the list.
            with ThreadPoolExecutor(1) as starter:
                for name, parameters in methods.items():
                    listeners[name].subscribe(node, f"{self.namespace}/{name}/{NODE_NAME}")
                    settings = {**shutter, **parameters}
                    starter.submit(self._start, name, settings, topic, processes).result()
            player = _Player(node, executor, listeners, lossless, topic)
            player.wait_for_nodes(recording, lambda: self._check(processes))
            for index in range(len(recording.clouds)):
                if not player.play(recording, index):
                    self._check(processes)
                progress()
            player.hear_the_rest()
            self._check(processes)
        finally:
            _stop(processes.values())
            executor.shutdown()
            node.destroy_node()
        return {name: listener.answers() for name, listener in listeners.items()}

    def _start(
        self,
        name: str,
        parameters: Mapping[str, Any],
        topic: str,
        processes: dict[str, subprocess.Popen[bytes]],
    ) -> None:
        remappings = [f"__ns:={self.namespace}/{name}"]
        remappings += [f"{taken}:={self.namespace}/{taken}" for taken in (topic, CAMERA_INFO)]
        words = [word for remapping in remappings for word in ("-r", remapping)]
        for key, value in parameters.items():
            words += ["-p", f"{key}:={value}"]
        with self._log(name).open("wb") as log:
            processes[name] = subprocess.Popen(
                [sys.executable, "-c", _NODE, "--ros-args", *words],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def _log(self, name: str) -> Path:
        return self._log_directory / f"{name}.log"

    def _check(self, processes: Mapping[str, subprocess.Popen[bytes]]) -> None:
        for name, process in processes.items():
            code = process.poll()
            if code is not None:
                lines = self._log(name).read_text(errors="replace").strip().splitlines()
                last = lines[-1] if lines else "it said nothing"
                raise SessionError(f"the node {name} ended with exit code {code}: {last}")


class _Player:
    """Publishes frames and waits for their answers."""

    def __init__(
        self,
        node: Any,
        executor: SingleThreadedExecutor,
        listeners: Mapping[str, Listener],
        lossless: Collection[str],
        topic: str,
    ) -> None:
        self._executor = executor
        self._listeners = listeners
        self._lossless = [listeners[name] for name in lossless]
        self._camera_info = node.create_publisher(CameraInfo, CAMERA_INFO, _QOS)
        self._clouds = node.create_publisher(PointCloud2, topic, _QOS)

    def wait_for_nodes(self, recording: Recording, check: Callable[[], None]) -> None:
        """Until all nodes listen, and their answers to a first frame arrive."""
        deadline = time.monotonic() + _START_TIMEOUT
        publishers = (self._camera_info, self._clouds)
        while min(p.get_subscription_count() for p in publishers) < len(self._listeners):
            check()
            if time.monotonic() > deadline:
                raise SessionError(f"the nodes did not start within {_START_TIMEOUT:.0f} s")
            self._executor.spin_once(timeout_sec=0.05)
        # A node may hear before it is heard. What it says is not counted.
        deadline = time.monotonic() + _FIRST_ANSWER_TIMEOUT
        index = 0
        while not self._ask(recording, index % len(recording.clouds)):
            check()
            if time.monotonic() > deadline:
                raise SessionError(f"no answer within {_FIRST_ANSWER_TIMEOUT:.0f} s")
            index += 1
        for listener in self._lossless:
            listener.unanswered = None
        self._spin_until(
            lambda: all(item.unanswered is not None for item in self._lossless), _ACCOUNT_TIMEOUT
        )
        for listener in self._listeners.values():
            listener.clear()

    def play(self, recording: Recording, index: int) -> bool:
        """Publish one frame; whether all nodes have answered it in time.

        If not, those that may lose none have accounted for it.
        """
        before = [item.unanswered for item in self._lossless]
        if self._ask(recording, index):
            return True
        stamp = recording.stamps_ns[index]
        self._spin_until(
            lambda: all(
                item.has(stamp) or item.unanswered != count
                for item, count in zip(self._lossless, before, strict=True)
            ),
            _ACCOUNT_TIMEOUT,
        )
        return False

    def _ask(self, recording: Recording, index: int) -> bool:
        stamp = recording.stamps_ns[index]
        info = copy_message(recording.camera_infos[index], "sensor_msgs/msg/CameraInfo")
        cloud = copy_message(recording.clouds[index], "sensor_msgs/msg/PointCloud2")
        self._camera_info.publish(info)
        for listener in self._listeners.values():
            listener.expect(stamp)
        self._clouds.publish(cloud)
        everybody = self._listeners.values()
        return self._spin_until(lambda: all(item.has(stamp) for item in everybody), self._timeout())

    def _spin_until(self, condition: Callable[[], bool], seconds: float) -> bool:
        """Hear what comes until this holds; whether it did in time."""
        deadline = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > deadline:
                return False
            self._executor.spin_once(timeout_sec=0.05)
        return True

    def _timeout(self) -> float:
        latencies = [x for listener in self._listeners.values() for x in listener.latencies()]
        least, most = _ANSWER_TIMEOUT
        return min(max(least, _PATIENCE * median(latencies)), most) if latencies else most

    def hear_the_rest(self) -> None:
        """What is still under way, of the last frame or of one that took too long."""
        self._spin_until(lambda: False, _REST_TIME)


def _stop(processes: Iterable[subprocess.Popen[bytes]]) -> None:
    """End the nodes: orderly if they will and Ctrl-C does not come meanwhile."""
    started = list(processes)
    deadline = time.monotonic() + _STOP_TIMEOUT
    try:
        for process in started:
            process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            for process in started:
                process.wait(max(0.0, deadline - time.monotonic()))
    finally:
        for process in started:
            if process.poll() is None:
                process.kill()
                process.wait()
