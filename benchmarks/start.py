# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.start``: memory and time of a start of the node.

Each row starts the node once and sends it the frames of a bundled recording until it has a pose:
with an empty cache of kernels, and with what that start has left.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from rs_localizer import data
from rs_localizer.cli.demo_command import read_frames
from rs_localizer.ros.graph.live import LiveNode
from rs_localizer.ros.node.conversion import message_class

_SETTLED = 3.0  # s: then diagnostics and timers have run
_POLLED = 0.2  # s between two looks at the memory
_IMU_RATE, _AROUND_NS = 200, 200_000_000
_TICK = os.sysconf("SC_CLK_TCK")


class Start(NamedTuple):
    """What a start cost; the processor's time and the peak are those of all its processes."""

    active: float  # s until then
    work: float  # s of the processor until then
    first: float  # s until the first pose
    first_work: float
    refused: int  # frames before it
    resident: float  # MB of the node when it has settled
    peak: float  # MB until active, what processes share counted once
    later_peak: float  # MB, while the rest is compiled


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
        if fields[0] == "Z":  # it has ended, and its parent has not asked
            continue
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
        self.pid, self.peak, self._ends = pid, 0.0, threading.Event()
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def work(self) -> float:
        """Seconds of the processor so far."""
        return sum(work for _, work in tree(self.pid))

    def _look(self) -> None:
        while not self._ends.wait(_POLLED):
            self.peak = max(self.peak, sum(memory(pid, "Pss") for pid, _ in tree(self.pid)))

    def close(self) -> None:
        """Look no more."""
        self._ends.set()
        self._thread.join()


def measure(settings: Mapping[str, Any], imu: bool) -> Start:
    """Start the localizer and send it frames until it has a pose."""
    frames = read_frames(data.path(data.WEBCAM))
    with tempfile.TemporaryDirectory() as place:
        began = time.monotonic()
        with LiveNode(settings, Path(place) / "log", 0) as node:
            watch = Watch(node.pid)
            try:
                node.wait(lambda line: None)
                active, work, peak = time.monotonic() - began, watch.work(), watch.peak
                refused, pose = 0, None
                while pose is None:
                    stamp_ns, info, cloud = frames[refused % len(frames)]
                    if imu:
                        _send_imu(node, stamp_ns)
                    pose = node.localize(info, cloud)
                    refused += pose is None
                first, first_work = time.monotonic() - began, watch.work()
                time.sleep(_SETTLED)
                resident = memory(node.pid, "Pss")
                while len(list(tree(node.pid))) > 1:  # what compiles the rest
                    time.sleep(_POLLED)
            finally:
                watch.close()
    return Start(active, work, first, first_work, refused, resident, peak, watch.peak)


def _send_imu(node: LiveNode, stamp_ns: int) -> None:
    kind = message_class("sensor_msgs/msg/Imu")
    publisher = node.publisher(kind, "imu")
    step = 1_000_000_000 // _IMU_RATE
    for time_ns in range(stamp_ns - _AROUND_NS, stamp_ns + _AROUND_NS, step):
        message = kind()
        message.header.frame_id = "camera"
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(time_ns, 1_000_000_000)
        publisher.publish(message)


def main() -> None:
    argparse.ArgumentParser(prog="python -m benchmarks.start", description=__doc__).parse_args()
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(os.getpid() % 100 + 1)
    os.environ.pop("NUMBA_CACHE_DIR", None)
    head = ("active s", "CPU s", "pose s", "CPU s", "refused", "node MB", "peak MB", "later MB")
    print(f"{'':34}" + "".join(f"{name:>10}" for name in head))
    rows: tuple[tuple[str, dict[str, Any], bool], ...] = (
        ("no readout_time", {"solver": "r6p_vcwt"}, False),
        ("readout_time", {"readout_time": 0.03}, False),
        ("readout_time, IMU", {"readout_time": 0.03}, True),
    )
    for name, settings, imu in rows:
        with tempfile.TemporaryDirectory() as cache:
            os.environ["XDG_CACHE_HOME"] = cache
            for kind in ("cold", "warm", "warm"):
                it = measure(settings, imu)
                cells = "".join(f"{value:10.1f}" for value in it)
                print(f"{f'{kind}, {name}':34}{cells}", flush=True)


if __name__ == "__main__":
    main()
