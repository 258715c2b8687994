# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Live nodes under load, in processes of their own, and what is heard of them."""

import contextlib
import os
import pickle
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile

from benchmarks.load.camera import READOUT_TIME, Camera, Frames
from rs_localizer.core.arrays import Array
from rs_localizer.io import topics
from rs_localizer.ros.node.managed import executor_of
from rs_localizer.settings import NODE_NAME

_SETTINGS = {"readout_time": READOUT_TIME}
_NODE = "import sys; from rs_localizer.ros.main import main; sys.exit(main())"

# s: only what hangs takes an hour, on whatever machine.
_START_TIMEOUT = 3600.0
# Frames that are still on their way when the last one has been sent, in s.
_REST_TIME = 1.5


@dataclass(frozen=True, slots=True)
class Result:
    """What came of the frames of one camera."""

    frames: int
    answered: int
    replaced: int  # as the node counts them
    refused: int
    latencies: Array  # s, of the answered frames, from publishing to the pose's arrival
    memory: Array  # MB, once a second: the node's resident set
    cpu: float  # of one core, on the average: the node's
    imu: str = ""  # share of the last frames that were localized with the IMU

    @property
    def lost(self) -> int:
        """Neither answered nor accounted for by the node."""
        return self.frames - self.answered - self.replaced - self.refused


class Ear:
    """Hears one node, and notes when the pose of each frame came."""

    def __init__(self, node: Node, namespace: str, frames: Frames, count: int) -> None:
        self.arrived = np.full(count, np.nan)
        self.answered = 0
        self.counts = {"Frames received": 0, "Frames replaced": 0, "Frames refused": 0}
        self.imu = ""
        self._frames = frames
        self._name = f"{namespace.lstrip('/')}/{NODE_NAME}: localizer"
        prefix = f"{namespace}/{NODE_NAME}"
        for kind, topic, callback, raw in (
            (PoseStamped, f"{prefix}/{topics.POSE}", self._take, True),
            # Somebody listens to the twist, too: it is what this node is for.
            (Odometry, f"{prefix}/{topics.ODOMETRY}", lambda _: None, True),
            (DiagnosticArray, topics.DIAGNOSTICS, self._take_status, False),
        ):
            node.create_subscription(kind, topic, callback, QoSProfile(depth=50), raw=raw)

    def _take(self, message: Any) -> None:
        now = time.monotonic()
        index = self._frames.index(bytes(message[:12]))
        if 0 <= index < len(self.arrived):
            self.arrived[index] = now
            self.answered += 1

    def _take_status(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == self._name:
                values = {item.key: item.value for item in status.values}
                self.counts = {key: int(values[key]) for key in self.counts}
                self.imu = values.get("IMU used (share of the last frames)", "")


@contextlib.contextmanager
def running(
    count: int, settings: Mapping[str, Any] = _SETTINGS
) -> Iterator[tuple[Node, list[tuple[str, int]]]]:
    """That many live nodes: our own node, and their namespaces and process ids.

    Raises:
        ChildProcessError: when a node ends at its start, with its log.
    """
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    rclpy.init()
    peer = rclpy.create_node("load", namespace=f"/load_{os.getpid()}")
    processes: list[subprocess.Popen[bytes]] = []
    with tempfile.TemporaryDirectory() as directory:
        try:
            nodes = []
            for index in range(count):
                namespace = f"/load_{os.getpid()}/camera{index}"
                log = Path(directory) / f"node{index}.log"
                processes.append(_started(namespace, log, settings))
                nodes.append((namespace, processes[-1].pid))
            yield peer, nodes
        finally:
            for process in processes:
                process.terminate()
            for process in processes:
                process.wait()
            rclpy.try_shutdown()


def _started(namespace: str, log: Path, settings: Mapping[str, Any]) -> subprocess.Popen[bytes]:
    words = ["--ros-args", "-r", f"__ns:={namespace}"]
    words += [word for name, value in settings.items() for word in ("-p", f"{name}:={value}")]
    with log.open("wb") as file:
        process = subprocess.Popen([sys.executable, "-c", _NODE, *words], stdout=file, stderr=file)
    deadline = time.monotonic() + _START_TIMEOUT
    while "active with solver" not in log.read_text():
        if process.poll() is not None or time.monotonic() > deadline:
            process.kill()
            raise ChildProcessError(f"the node did not start:\n{log.read_text()}")
        time.sleep(0.1)
    return process


def steady(frames: Frames, cameras: int, count: int) -> list[Result]:
    """Publish that many frames to each of some nodes at a steady rate, and see what comes of it."""
    with running(cameras) as (peer, nodes), tempfile.TemporaryDirectory() as directory:
        frames_file = Path(directory) / "frames"
        frames_file.write_bytes(pickle.dumps(frames))
        ears, sents, publishers = [], [], []
        for index, (namespace, _) in enumerate(nodes):
            ears.append(Ear(peer, namespace, frames, count))
            file = Path(directory) / f"sent{index}"
            sents.append(np.memmap(file, np.float64, mode="w+", shape=count))
            arguments = (namespace, str(frames_file), str(file))
            publishers.append(
                subprocess.Popen([sys.executable, "-m", Camera.__module__, *arguments])
            )
        memory: list[list[float]] = []
        used: list[list[float]] = []
        ended = threading.Event()
        listening = threading.Thread(target=_listen, args=(peer, ended))
        listening.start()
        while any(publisher.poll() is None for publisher in publishers):
            time.sleep(1.0)
            if sents[0][0] > 0.0:
                memory.append([_memory(pid) for _, pid in nodes])
                used.append([time.monotonic(), *(cpu_time(pid) for _, pid in nodes)])
        spent = np.subtract(used[-1], used[0])
        time.sleep(_REST_TIME)
        ended.set()
        listening.join()
        return [
            Result(
                frames=count,
                answered=ear.answered,
                replaced=ear.counts["Frames replaced"],
                refused=ear.counts["Frames refused"],
                latencies=(ear.arrived - sent)[np.isfinite(ear.arrived)],
                memory=of_node,
                cpu=float(used_by_it / spent[0]) if spent[0] > 0.0 else float("nan"),
                imu=ear.imu,
            )
            for ear, sent, of_node, used_by_it in zip(
                ears, sents, np.array(memory).T, spent[1:], strict=True
            )
        ]


def _listen(node: Node, ended: threading.Event) -> None:
    """Take what comes until the end, as the localizer does."""
    executor = executor_of(node.context)
    executor.add_node(node)
    while not ended.is_set():
        executor.spin_once(timeout_sec=0.1)
    executor.remove_node(node)


def _memory(pid: int) -> float:
    """Resident set of a process in MB."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1]) / 1024.0
    return float("nan")


def cpu_time(pid: int) -> float:
    """Seconds of all cores that a process has used."""
    values = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(values[11]) + int(values[12])) / os.sysconf("SC_CLK_TCK")
