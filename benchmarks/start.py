# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.start``: what a start of the node costs, beside a plain rclpy node.

Each row starts the node once, in turns with the plain one, and sends it the frames of a bundled
recording until it has a pose: with an empty cache of kernels, and with what that start has left.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

_PLAIN = """
import rclpy, sys
rclpy.init()
node = rclpy.create_node("plain")
print("active with", flush=True)
rclpy.spin(node)
"""
_SETTLED = 3.0  # s: then diagnostics and timers have run
_POLLED = 0.2  # s between two looks at the memory
_IMU_RATE, _AROUND_NS = 200, 200_000_000
_TICK = os.sysconf("SC_CLK_TCK")


class Start(NamedTuple):
    """What a start cost; NaN: there is no such thing."""

    active: float  # s until then
    work: float  # s of the processor until then, of all processes
    first: float  # s until the first pose
    first_work: float
    refused: int  # frames before it
    resident: float  # MB of the node when it has settled
    peak: float  # MB of all processes, what they share counted once
    children: bool  # whether there were any


def tree(pid: int) -> Iterator[tuple[int, float]]:
    """A process and those below it, and s of the processor of each and of its ended children."""
    parents: dict[int, list[int]] = {}
    work = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        one = int(path.parent.name)
        parents.setdefault(int(fields[1]), []).append(one)
        work[one] = sum(map(int, fields[11:15])) / _TICK
    waiting = [pid]
    while waiting:
        one = waiting.pop()
        if one in work:
            yield one, work[one]
            waiting += parents.get(one, [])


def memory(pid: int, name: str) -> float:
    """MB of a process by /proc: ``Pss`` or ``Rss``."""
    try:
        lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0.0
    return sum(float(line.split()[1]) / 1e3 for line in lines if line.startswith(f"{name}:"))


class Watch:
    """Looks at the processes of a node until it is closed."""

    def __init__(self, pid: int) -> None:
        self.pid, self.peak, self.children, self._ends = pid, 0.0, False, threading.Event()
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def work(self) -> float:
        """Seconds of the processor so far."""
        return sum(work for _, work in tree(self.pid))

    def _look(self) -> None:
        while not self._ends.wait(_POLLED):
            pids = [pid for pid, _ in tree(self.pid)]
            self.children |= len(pids) > 1
            self.peak = max(self.peak, sum(memory(pid, "Pss") for pid in pids))

    def close(self) -> None:
        """Look no more."""
        self._ends.set()
        self._thread.join()


def plain() -> Start:
    """Start a node that does nothing."""
    began = time.monotonic()
    process = subprocess.Popen([sys.executable, "-c", _PLAIN], stdout=subprocess.PIPE, text=True)
    watch = Watch(process.pid)
    try:
        assert process.stdout is not None
        process.stdout.readline()
        active, work = time.monotonic() - began, watch.work()
        time.sleep(_SETTLED)
        resident = memory(process.pid, "Rss")
    finally:
        watch.close()
        process.terminate()
        process.communicate()
    return Start(active, work, np.nan, np.nan, 0, resident, watch.peak, watch.children)


def measure(settings: Mapping[str, Any], imu: bool) -> Start:
    """Start the localizer and send it frames until it has a pose."""
    from rs_localizer import data
    from rs_localizer.cli.demo import read_frames
    from rs_localizer.ros.graph.live import LiveNode

    frames = read_frames(data.path(data.WEBCAM))
    with tempfile.TemporaryDirectory() as place:
        began = time.monotonic()
        log = Path(place) / "log"
        with LiveNode(settings, log, 0) as node:
            watch = Watch(node.pid)
            try:
                node.wait(lambda line: None)
                active, work = time.monotonic() - began, watch.work()
                refused, pose = 0, None
                while pose is None:
                    for stamp_ns, info, cloud in frames:
                        if imu:
                            _send_imu(node, stamp_ns)
                        pose = node.localize(info, cloud)
                        if pose is not None:
                            break
                        refused += 1
                first, first_work = time.monotonic() - began, watch.work()
                time.sleep(_SETTLED)
                resident = memory(node.pid, "Rss")
                while watch.children and len(list(tree(node.pid))) > 1:  # what compiles the rest
                    time.sleep(_POLLED)
            finally:
                watch.close()
    return Start(active, work, first, first_work, refused, resident, watch.peak, watch.children)


def _send_imu(node: Any, stamp_ns: int) -> None:
    from rs_localizer.ros.node.conversion import message_class

    kind = message_class("sensor_msgs/msg/Imu")
    publisher = node.publisher(kind, "imu")
    step = 1_000_000_000 // _IMU_RATE
    for time_ns in range(stamp_ns - _AROUND_NS, stamp_ns + _AROUND_NS, step):
        message = kind()
        message.header.frame_id = "camera"
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(time_ns, 1_000_000_000)
        publisher.publish(message)


def main() -> int:
    argparse.ArgumentParser(prog="python -m benchmarks.start", description=__doc__).parse_args()
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(os.getpid() % 100 + 1)
    head = ("active s", "CPU s", "pose s", "CPU s", "refused", "RSS MB", "peak MB", "children")
    print(f"{'':34}" + "".join(f"{name:>10}" for name in head))
    rows: tuple[tuple[str, dict[str, Any], bool], ...] = (
        ("no readout_time", {"solver": "r6p_vcwt"}, False),
        ("readout_time", {"readout_time": 0.03}, False),
        ("readout_time, IMU", {"readout_time": 0.03}, True),
    )
    for name, settings, imu in rows:
        with tempfile.TemporaryDirectory() as cache:
            os.environ["XDG_CACHE_HOME"] = cache
            os.environ.pop("NUMBA_CACHE_DIR", None)
            _print("plain rclpy node", plain())
            for kind in ("cold", "warm", "warm"):
                _print(f"{kind}, {name}", measure(settings, imu))
    return 0


def _print(name: str, it: Start) -> None:
    numbers = f"{it.active:10.1f}{it.work:10.1f}{it.first:10.1f}{it.first_work:10.1f}"
    numbers += f"{it.refused:10d}{it.resident:10.0f}{it.peak:10.0f}{it.children!s:>10}"
    print(f"{name:34}{numbers}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
