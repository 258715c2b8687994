# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.start``: processor time and memory of a start, in an empty home.

Each row is a new process that gets frames of a bundled recording until it has a pose: the library,
and the node without and with an IMU, with wrong matches among the frame's. It fails where a process
has loaded what only a compiler or a tool needs.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rs_localizer import data
from rs_localizer.cli.demo_command import FrameMessages, read_frames
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.io.recording import make_correspondences
from rs_localizer.ros.graph.live import LiveNode
from rs_localizer.ros.node.conversion import message_class

FOREIGN = ("numba", "llvmlite", "scipy", "matplotlib")
"""What no localizer loads."""
_WRONG = 0.3  # share of the matches
_READOUT_TIME = 0.03
_SETTLED = 3.0  # s: then diagnostics and timers have run
_IMU_RATE, _AROUND_NS = 200, 200_000_000
_TICK = os.sysconf("SC_CLK_TCK")
_STARTS = 3

# Before NumPy is imported, as of any user.
_LIBRARY = f"""
import json, sys, time
import rs_localizer as rsl
rsl.Localizer
imported = time.process_time()
import numpy as np
points, pixels, K, size = (np.array(value) for value in json.loads(sys.stdin.readline()))
camera = rsl.Camera(width=int(size[0]), height=int(size[1]), K=K, readout_time={_READOUT_TIME})
before = time.process_time()
assert rsl.Localizer(camera).localize(points, pixels)
first = imported + time.process_time() - before
print(json.dumps([imported, first, [name for name in {FOREIGN} if name in sys.modules]]))
sys.stdout.flush()
sys.stdin.readline()
"""


class Start(NamedTuple):
    """Cost of a start."""

    begun: float  # s of the processor until it is imported, or active
    first: float  # s of the processor until the first pose
    refused: int  # frames before it
    memory: float  # MB of the process, its share of what several use
    foreign: tuple[str, ...]  # of :data:`FOREIGN`, what has been loaded


def work(pid: int) -> float:
    """Seconds of the processor that a process and its ended children have taken."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:15])) / _TICK


def memory(pid: int) -> float:
    """MB of a process, its share of what several use."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return sum(float(line.split()[1]) / 1e3 for line in lines if line.startswith("Pss:"))


def loaded(pid: int) -> tuple[str, ...]:
    """Packages of :data:`FOREIGN` whose libraries a process has loaded."""
    maps = Path(f"/proc/{pid}/maps").read_text()
    return tuple(name for name in FOREIGN if f"-packages/{name}" in maps)


def spoiled(frame: FrameMessages) -> FrameMessages:
    """A frame with wrong matches."""
    cloud, rng = read_correspondences(frame.cloud), np.random.default_rng(frame.stamp_ns)
    pixels = cloud.pixels.copy()
    wrong = rng.choice(len(pixels), round(_WRONG * len(pixels)), replace=False)
    pixels[wrong] = rng.uniform([0, 0], [frame.info.width, frame.info.height], (len(wrong), 2))
    ids = np.arange(len(pixels))
    return frame._replace(cloud=make_correspondences(frame.stamp_ns, cloud.points, pixels, ids))


def start_library(frame: FrameMessages) -> Start:
    """Localize a frame by the library, with as many threads as its user has."""
    cloud = read_correspondences(frame.cloud)
    K, size = np.reshape(frame.info.k, (3, 3)), [frame.info.width, frame.info.height]
    given = json.dumps([cloud.points.tolist(), cloud.pixels.tolist(), K.tolist(), size])
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    with subprocess.Popen(
        [sys.executable, "-c", _LIBRARY], env=environment, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    ) as process:  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(f"{given}\n")
        process.stdin.flush()
        begun, first, foreign = json.loads(process.stdout.readline())
        resident = memory(process.pid)
        process.stdin.write("\n")
    return Start(begun, first, 0, resident, tuple(foreign))


def start_node(frames: list[FrameMessages], settings: Mapping[str, Any], imu: bool) -> Start:
    """Start the localizer and send it frames until it has a pose."""
    with (
        tempfile.TemporaryDirectory() as place,
        LiveNode(settings, Path(place) / "log", 0) as node,
    ):
        node.wait(lambda line: None)
        begun, refused, pose = work(node.pid), 0, None
        while pose is None:
            stamp_ns, info, cloud = frames[refused % len(frames)]
            if imu:
                _send_imu(node, stamp_ns)
            pose = node.localize(info, cloud)
            refused += pose is None
        first = work(node.pid)
        time.sleep(_SETTLED)
        return Start(begun, first, refused, memory(node.pid), loaded(node.pid))


def _send_imu(node: LiveNode, stamp_ns: int) -> None:
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
    frames = [spoiled(frame) for frame in read_frames(data.path(data.WEBCAM))]
    head = ("begun CPU s", "pose CPU s", "refused", "MB")
    print(f"{'':26}" + "".join(f"{name:>13}" for name in head))
    foreign = set[str]()
    known = {"readout_time": _READOUT_TIME}
    for name, start in (
        ("library", lambda: start_library(frames[0])),
        ("node, no readout_time", lambda: start_node(frames, {}, False)),
        ("node, readout_time", lambda: start_node(frames, known, False)),
        ("node, readout_time, IMU", lambda: start_node(frames, known, True)),
    ):
        for _ in range(_STARTS):
            with tempfile.TemporaryDirectory() as home:
                os.environ |= {"HOME": home, "XDG_CACHE_HOME": f"{home}/cache"}
                it = start()
            cells = (f"{it.begun:13.2f}", f"{it.first:13.2f}", f"{it.refused:13}")
            print(f"{name:26}" + "".join(cells) + f"{it.memory:13.0f}", flush=True)
            foreign.update(it.foreign)
    if foreign:
        print(f"loaded, and not needed: {', '.join(sorted(foreign))}", file=sys.stderr)
    return 1 if foreign else 0


if __name__ == "__main__":
    sys.exit(main())
