# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A live node on a robot: TF while nobody sees the map, and odometry at a rate of its own.

    python -m benchmarks.load.robot occlusions     # four minutes
    python -m benchmarks.load.robot rate --rate 200

A robot drives in circles at 0.5 m/s through a simulated room, in real time: 30 images a second
(100 points, 0.7 px, 20 % wrong; they arrive 45 ms after their stamps), odometry at 50 Hz that
drifts. In occlusions images have five points. Fifty times a second somebody looks up ``map ->
base_link`` of 50 ms before.
"""

from __future__ import annotations

import argparse
import contextlib
import heapq
import importlib
import importlib.util
import math
import os
import random
import re
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.time import Time

from benchmarks.load.measuring import cpu_time
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.recording import CAMERA_FRAME, make_camera_info, make_correspondences
from rs_localizer.io.transforms import Transform, make_transform, read_transform
from rs_localizer.ros.graph.live import LiveNode
from rs_localizer.ros.node.conversion import make_message
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import SimulatedFrame, simulate_frames
from rs_localizer.tools.simulation.simulated_settings import BODY_FROM_CAMERA, FrameSettings
from rs_localizer.tools.simulation.true_motion import TrueState, sampled_states

_STAND_IN = Path(__file__).parents[2] / "test" / "ros" / "stand_in"
_K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(640, 480, _K, readout_time=0.03)
_IMAGES, _ODOMETRY, _LOOKUPS = 30.0, 50.0, 50.0  # Hz
_ARRIVAL, _BEFORE = 0.045, 0.05  # s
_AFTER = 1.0  # s after an occlusion, by when the map is seen again for sure
_FEW = 5  # points of an image while somebody is in the way
_START, _CLEAR = 12.0, 5.0  # s with a view: at first, and after each occlusion
OCCLUSIONS = (0.3, 0.3, 0.3, 2.0, 2.0, 30.0)
# Of odometry: error of the way, as a part of it, and of the heading, rad/s.
DRIFTS = ((0.03, 0.005), (0.0, 0.02), (-0.1, 0.0))
_HOLDING = re.compile(r"holding for (\S+) s, (\S+) cm, (\S+) deg")


class Drive:
    """Circles of a body at 0.5 m/s; the camera looks forward from 0.5 m above the floor."""

    radius, speed, height = 2.0, 0.5, 0.5

    def __init__(self, seconds: float) -> None:
        self.start_ns, self.seconds = 0, seconds

    @property
    def intervals_ns(self) -> list[tuple[int, int]]:
        return [(self.start_ns, self.start_ns + round(1e9 * self.seconds))]

    def body(self, time: float) -> Transform:
        """map_from_body, so many s after the start."""
        angle = time * self.speed / self.radius
        place = self.radius * np.array([math.sin(angle), 1.0 - math.cos(angle), 0.0])
        return Transform(so3.exp(np.array([0.0, 0.0, angle])), place)

    def state(self, stamp_ns: int, offsets: Array) -> TrueState:
        """The camera."""
        since = 1e-9 * (stamp_ns - self.start_ns) + np.asarray(offsets, float)
        bodies = [self.body(t) for t in since]
        camera = BODY_FROM_CAMERA["forward_left_up"]
        rate = camera.T @ np.array([0.0, 0.0, self.speed / self.radius])
        return TrueState(
            np.array([each.rotation @ camera for each in bodies]),
            np.array([each.translation for each in bodies]) + np.array([0.0, 0.0, self.height]),
            np.broadcast_to(rate, (len(bodies), 3)),
            np.broadcast_to(camera.T @ np.array([self.speed, 0.0, 0.0]), (len(bodies), 3)),
        )

    def odometry(self, time: float, drift: tuple[float, float]) -> Transform:
        """odom_from_body by wheels that are off like this: a circle, too."""
        scale, turn = drift
        rate, speed = self.speed / self.radius + turn, self.speed * (1.0 + scale)
        angle = rate * time
        place = speed / rate * np.array([math.sin(angle), 1.0 - math.cos(angle), 0.0])
        return Transform(so3.exp(np.array([0.0, 0.0, angle])), place)


@dataclass(frozen=True, slots=True)
class Looked:
    """One look at ``map -> base_link``."""

    time: float  # s after the start
    found: Transform | None
    off: float = math.nan  # m
    turned: float = math.nan  # rad


@dataclass(slots=True)
class Heard:
    """What the node said."""

    looks: list[Looked] = field(default_factory=list)
    claims: list[tuple[float, float, float, float]] = field(default_factory=list)
    odometry: list[tuple[int, float, Array]] = field(default_factory=list)  # stamp, heard, place
    cpu: float = math.nan


@contextlib.contextmanager
def _tf2_ros() -> Iterator[Any]:
    """tf2_ros, or the tests' stand-in where it is not installed."""
    if importlib.util.find_spec("tf2_ros") is None:
        sys.path.insert(0, str(_STAND_IN))
        os.environ["PYTHONPATH"] = str(_STAND_IN)
    yield importlib.import_module("tf2_ros")


def driven(
    seconds: float, drift: tuple[float, float], occluded: Callable[[float], bool], **settings: Any
) -> Heard:
    """What is heard of a node on such a drive."""
    drive, heard = Drive(seconds), Heard()
    world = room(sampled_states(drive, 0.5).positions, np.random.default_rng(0), count=20_000)
    frames = list(simulate_frames(CAMERA, drive, world, FrameSettings(100, 0.7, 0.2), seed=1))
    with _tf2_ros() as tf2, tempfile.TemporaryDirectory() as place:
        log = Path(place) / "log"
        own = {
            "readout_time": CAMERA.readout_time, "base_frame": "base_link",
            "publish_tf": "map_to_odom",
        }  # fmt: skip
        with LiveNode({**own, **settings}, log, 0) as live:
            live.wait(lambda _: None)
            _drive(live, tf2, _Run(drive, drift, occluded, frames, heard))
    return heard


@dataclass(frozen=True, slots=True)
class _Run:
    drive: Drive
    drift: tuple[float, float]
    occluded: Callable[[float], bool]
    frames: Sequence[SimulatedFrame]
    heard: Heard


def _drive(live: LiveNode, tf2: Any, run: _Run) -> None:
    node, heard, drive = live._node, run.heard, run.drive
    moving, fixed = tf2.TransformBroadcaster(node), tf2.StaticTransformBroadcaster(node)
    buffer = tf2.Buffer()
    listener = tf2.TransformListener(buffer, node)
    camera = Transform(BODY_FROM_CAMERA["forward_left_up"], np.array([0.0, 0.0, drive.height]))
    fixed.sendTransform(_stamped(0, "base_link", CAMERA_FRAME, camera))
    base_ns = time.time_ns() + 1_000_000_000

    def take_odometry(message: Odometry) -> None:
        p = message.pose.pose.position
        heard.odometry.append((stamp_ns(message) - base_ns, _since(), np.array([p.x, p.y, p.z])))

    def take_status(message: DiagnosticArray) -> None:
        for status in message.status:
            values = {item.key: item.value for item in status.values}
            said = _HOLDING.search(values.get("Correction of odometry", ""))
            last = next((look for look in reversed(heard.looks) if look.found), None)
            if said and last:
                seconds, claimed = float(said[1]), 0.01 * float(said[2])
                heard.claims.append((_since(), seconds, claimed, last.off))

    def _since() -> float:
        return 1e-9 * (time.time_ns() - base_ns)

    def send_odometry(at: float) -> None:
        stamp = base_ns + round(1e9 * at)
        odom = drive.odometry(at, run.drift)
        moving.sendTransform(_stamped(stamp, "odom", "base_link", odom))

    def send_image(at: float) -> None:
        frame = run.frames[round((at - _ARRIVAL) * _IMAGES)]
        stamp = base_ns + frame.stamp_ns
        kept = slice(_FEW if run.occluded(1e-9 * frame.stamp_ns) else None)
        live.send(make_camera_info(CAMERA, stamp), make_correspondences(
            stamp, frame.points[kept], frame.pixels[kept], frame.ids[kept]
        ))  # fmt: skip

    def look(at: float) -> None:
        when = at - _BEFORE
        stamp = Time(nanoseconds=base_ns + round(1e9 * when))
        try:
            buffer.lookup_transform("odom", "base_link", stamp)
        except tf2.TransformException:
            return  # odometry itself has not come yet
        try:
            item = buffer.lookup_transform("map", "base_link", stamp)
        except tf2.TransformException:
            heard.looks.append(Looked(when, None))
            return
        found, truth = read_transform(item.transform), drive.body(when)
        turn = so3.log(np.ascontiguousarray(found.rotation.T @ truth.rotation))
        off = float(np.linalg.norm(found.translation - truth.translation))
        heard.looks.append(Looked(when, found, off, float(np.linalg.norm(turn))))

    node.create_subscription(
        Odometry, f"{live.namespace}/rs_localizer/odometry", take_odometry, 100
    )
    node.create_subscription(DiagnosticArray, "/diagnostics", take_status, 10)
    events: list[tuple[float, int, Callable[[float], None]]] = []
    for kind, (hertz, act, delay) in enumerate((
        (_ODOMETRY, send_odometry, 0.0), (_IMAGES, send_image, _ARRIVAL), (_LOOKUPS, look, 0.011),
    )):  # fmt: skip
        count = int((drive.seconds - 0.2) * hertz)
        events += [(k / hertz + delay, kind, act) for k in range(count)]
    heapq.heapify(events)
    used, begun = cpu_time(live.pid), time.monotonic()
    while events:
        at, _, due = heapq.heappop(events)
        while (left := at - _since()) > 0.0:
            live._executor.spin_once(timeout_sec=left)
        due(at)
    heard.cpu = (cpu_time(live.pid) - used) / (time.monotonic() - begun)
    listener.unregister()


def _stamped(stamp: int, parent: str, child: str, transform: Transform) -> TransformStamped:
    return make_transform(make_message, stamp, parent, child, transform)


def occlusions() -> list[str]:
    """Lines of a table."""
    ends, now = [], _START
    for length in OCCLUSIONS:
        ends.append((now, now + length))
        now += length + _CLEAR
    rows: dict[float, list[list[float]]] = {length: [] for length in OCCLUSIONS}
    clear: list[Looked] = []
    for drift in DRIFTS:
        heard = driven(now, drift, lambda t: any(a <= t < b for a, b in ends))
        first = next(look.time for look in heard.looks if look.found)
        looks = [look for look in heard.looks if look.time > first]
        covered = [any(a <= look.time < b + _AFTER for a, b in ends) for look in looks]
        clear += [look for look, hidden in zip(looks, covered, strict=True) if not hidden]
        for (begin, end), length in zip(ends, OCCLUSIONS, strict=True):
            inside = [look for look in looks if begin <= look.time < end + _AFTER]
            claims = [c for c in heard.claims if begin + 0.2 < c[0] < end and c[1] > 0.2]
            rows[length].append([
                len(inside), sum(look.found is not None for look in inside),
                100.0 * max(look.off for look in inside if look.found),
                math.degrees(max(look.turned for look in inside if look.found)),
                100.0 * _jump(inside, end, drift),
                100.0 * claims[-1][2] if claims else math.nan,
                max((c[3] / c[2] for c in claims), default=math.nan),
            ])  # fmt: skip
    answered = sum(look.found is not None for look in clear)
    farthest = max(look.off for look in clear if look.found)
    lines = [
        "| s without a view | lookups answered | largest error | jump | error over claimed |",
        "|---|---|---|---|---|",
        f"| 0 | {answered} of {len(clear)} | {100.0 * farthest:.1f} cm | | |",
    ]
    for length, of in rows.items():
        asked, found, off, turned, jump, _, ratio = np.array(of).T
        over = f"{np.nanmax(ratio):.2f} at most" if np.isfinite(ratio).any() else ""
        lines.append(
            f"| {length:g} ({len(of)} times) | {found.sum():.0f} of {asked.sum():.0f} "
            f"| {off.max():.1f} cm, {turned.max():.1f} deg | {jump.max():.1f} cm | {over} |"
        )
    return lines


def _jump(looks: Sequence[Looked], end: float, drift: tuple[float, float]) -> float:
    """How far (m) the body is moved when the map is seen again, beside what it drove."""
    before = [look for look in looks if look.found and look.time < end][-1]
    after = [look for look in looks if look.found][-1]
    assert before.found is not None
    assert after.found is not None
    odom = [Drive(0.0).odometry(each.time, drift) for each in (before, after)]
    expected = before.found @ odom[0].inverse() @ odom[1]
    return float(np.linalg.norm(expected.translation - after.found.translation))


def rate(hertz: float, seconds: float) -> list[str]:
    """Lines on odometry between images."""
    heard = driven(seconds, DRIFTS[0], lambda _: False, output_rate=hertz)
    settled = heard.odometry[round(2.0 * hertz) :]
    stamps, times = (np.array([each[k] for each in settled]) for k in (0, 1))
    stamps, places = 1e-9 * stamps, np.array([each[2] for each in settled])
    drive = Drive(0.0)
    truth = np.array([drive.body(t).translation for t in stamps])
    off = 1e3 * np.linalg.norm(places - truth, axis=1)
    intervals, late = 1e3 * np.diff(times), 1e3 * (times - stamps)

    def spread(values: Array, unit: str) -> str:
        low, middle, high, most = np.percentile(values, (1, 50, 99, 100))
        return f"{low:.1f} / {middle:.1f} / {high:.1f} / {most:.1f} {unit}"

    heard_rate = len(times) / (times[-1] - times[0])
    return [
        f"output_rate {hertz:g} Hz, {heard_rate:.1f} Hz heard; CPU {heard.cpu:.0%} of a core",
        "1 % / median / 99 % / largest",
        f"intervals between messages  {spread(intervals, 'ms')}",
        f"from stamp to arrival       {spread(late, 'ms')}",
        f"error of the position       {spread(off, 'mm')}",
    ]  # fmt: skip


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.load.robot", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("what", choices=("occlusions", "rate"))
    parser.add_argument("--rate", type=float, default=200.0, help="Hz")
    parser.add_argument("--seconds", type=float, default=60.0, help="of the rate")
    args = parser.parse_args()
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(random.SystemRandom().randrange(1, 101))
    lines = occlusions() if args.what == "occlusions" else rate(args.rate, args.seconds)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
