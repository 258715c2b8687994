# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A live node on a robot: TF while nobody sees the map, in wrong maps, carried, and clicked at.

    python -m benchmarks.load.robot occlusions     # four minutes
    python -m benchmarks.load.robot trouble        # five: wrong maps, kidnapping, clicks, a rival

A robot drives in circles at 0.5 m/s through a simulated room, in real time: 30 images a second
(100 points, 0.7 px, 20 % wrong; they arrive 45 ms after their stamps), odometry at 50 Hz that
drifts. In occlusions images have five points. Fifty times a second somebody looks up ``map ->
base_link`` of 50 ms before, and compares its error with what ``~/map_to_odom`` claims.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import heapq
import importlib
import importlib.util
import itertools
import math
import os
import random
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo, PointCloud2

from benchmarks.load.measuring import running
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.messages import make_quaternion, make_vector, stamp_ns
from rs_localizer.io.recording import CAMERA_FRAME, make_camera_info, make_correspondences
from rs_localizer.io.topics import CAMERA_INFO, CORRESPONDENCES
from rs_localizer.io.transforms import Transform, from_numbers, make_transform, read_transform
from rs_localizer.ros.node.conversion import copy_message, make_message
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
WRONG = tuple((share, metres) for share in (0.2, 0.4, 0.6, 0.8) for metres in (0.1, 0.5, 3.0))
_WRONG, _RIGHT = 6.0, 3.0  # s in a wrong map, and in the right one again


@dataclass(frozen=True, slots=True)
class Trouble:
    """What goes on around a robot, by the time since its start."""

    seconds: float
    occluded: Callable[[float], bool] = lambda _: False
    moved: Callable[[float], tuple[float, float]] = lambda _: (0.0, 0.0)  # share of landmarks, m
    carried: Callable[[float], float] = lambda _: 0.0  # m to the side
    clicks: tuple[tuple[float, float], ...] = ()  # when, and how far (m) from the truth
    rival: tuple[float, float] = (math.inf, math.inf)  # from when until when AMCL runs beside it


class Drive:
    """Circles of a body at 0.5 m/s; the camera looks forward from 0.5 m above the floor."""

    radius, speed, height = 2.0, 0.5, 0.5

    def __init__(self, seconds: float, carried: Callable[[float], float] = lambda _: 0.0) -> None:
        self.start_ns, self.seconds, self.carried = 0, seconds, carried

    @property
    def intervals_ns(self) -> list[tuple[int, int]]:
        return [(self.start_ns, self.start_ns + round(1e9 * self.seconds))]

    def body(self, time: float) -> Transform:
        """map_from_body, so many s after the start."""
        angle = time * self.speed / self.radius
        place = self.radius * np.array([math.sin(angle), 1.0 - math.cos(angle), 0.0])
        place[1] -= self.carried(time)
        return Transform(so3.exp(np.array([0.0, 0.0, angle])), place)

    def state(self, stamp_ns: int, offsets: Array) -> TrueState:
        """The camera."""
        since = 1e-9 * (stamp_ns - self.start_ns) + np.asarray(offsets, float)
        bodies = [self.body(t) for t in since]
        camera = BODY_FROM_CAMERA
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
    claimed: float = math.nan  # m, standard deviation of ``off``

    @property
    def ratio(self) -> float:
        return self.off / self.claimed


@dataclass(slots=True)
class Heard:
    """What the node said."""

    looks: list[Looked] = field(default_factory=list)
    values: list[tuple[float, int, dict[str, str]]] = field(default_factory=list)  # level


@contextlib.contextmanager
def _tf2_ros() -> Iterator[Any]:
    """tf2_ros, or the tests' stand-in where it is not installed."""
    if importlib.util.find_spec("tf2_ros") is None:
        sys.path.insert(0, str(_STAND_IN))
        os.environ["PYTHONPATH"] = str(_STAND_IN)
    yield importlib.import_module("tf2_ros")


def driven(trouble: Trouble, drift: tuple[float, float]) -> Heard:
    """What is heard of a node on such a drive."""
    drive = Drive(trouble.seconds, trouble.carried)
    world = room(sampled_states(drive, 0.5).positions, np.random.default_rng(0), count=20_000)
    frames = list(simulate_frames(CAMERA, drive, world, FrameSettings(100, 0.7, 0.2), seed=1))
    own = {
        "readout_time": CAMERA.readout_time, "base_frame": "base_link",
        "publish_tf": "map_to_odom",
    }  # fmt: skip
    with _tf2_ros() as tf2, running(1, own) as (peer, [(namespace, _)]):
        around = _Around(peer, namespace, tf2, drive, drift, trouble)
        around.play(frames)
    return around.heard


class _Around:
    """What is around a live node: it sends, looks, and keeps what it hears."""

    def __init__(
        self, node: Node, space: str, tf2: Any, drive: Drive, drift: tuple[float, float],
        trouble: Trouble,
    ) -> None:  # fmt: skip
        self._drive, self._drift, self._trouble = drive, drift, trouble
        self._missing = tf2.TransformException
        self.heard = Heard()
        # Of ~/map_to_odom: stamp, turn, covariance.
        self._sure: deque[tuple[int, Array, Array]] = deque(maxlen=200)
        self._base_ns = 0
        self._executor, own = SingleThreadedExecutor(), f"{space}/rs_localizer"
        self._executor.add_node(node)
        self._infos = node.create_publisher(CameraInfo, f"{space}/{CAMERA_INFO}", 10)
        self._clouds = node.create_publisher(PointCloud2, f"{space}/{CORRESPONDENCES}", 10)
        self._moving = tf2.TransformBroadcaster(node)
        self._fixed = tf2.StaticTransformBroadcaster(node)
        self._buffer = tf2.Buffer()
        self.listener = tf2.TransformListener(self._buffer, node)
        kind = PoseWithCovarianceStamped
        node.create_subscription(DiagnosticArray, "/diagnostics", self._take_status, 10)
        node.create_subscription(kind, f"{own}/map_to_odom", self._take_sure, 100)
        self._clicked = node.create_publisher(kind, f"{space}/initialpose", 10)

    def play(self, frames: Sequence[SimulatedFrame]) -> None:
        """Drive."""
        camera = BODY_FROM_CAMERA, np.array([0.0, 0.0, self._drive.height])
        self._fixed.sendTransform(_stamped(0, "base_link", CAMERA_FRAME, Transform(*camera)))
        while not (self._infos.get_subscription_count() and self._clouds.get_subscription_count()):
            self._executor.spin_once(timeout_sec=0.1)
        self._base_ns = time.time_ns() + 1_000_000_000
        image = functools.partial(self._send_image, frames)
        rates: tuple[tuple[float, Callable[[float], None], float], ...] = (
            (_ODOMETRY, self._send_odometry, 0.0), (_IMAGES, image, _ARRIVAL),
            (_LOOKUPS, self._look, 0.011), (20.0, self._send_rival, 0.003),
        )  # fmt: skip
        events: list[tuple[float, int, Callable[[float], None]]] = []
        for order, (hertz, act, delay) in enumerate(rates):
            count = int((self._drive.seconds - 0.2) * hertz)
            events += [(k / hertz + delay, order, act) for k in range(count)]
        for when, metres in self._trouble.clicks:
            events.append((when, len(rates), functools.partial(self._click, metres)))
        heapq.heapify(events)
        while events:
            at, _, due = heapq.heappop(events)
            while (left := at - self._since()) > 0.0:
                self._executor.spin_once(timeout_sec=left)
            due(at)
        self.listener.unregister()

    def _since(self) -> float:
        return 1e-9 * (time.time_ns() - self._base_ns)

    def _stamp(self, at: float) -> int:
        return self._base_ns + round(1e9 * at)

    def _take_status(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {item.key: item.value for item in status.values} | {"": status.message}
            self.heard.values.append((self._since(), status.level[0], values))

    def _take_sure(self, message: PoseWithCovarianceStamped) -> None:
        q = message.pose.pose.orientation
        turn = from_numbers((0.0, 0.0, 0.0), (q.x, q.y, q.z, q.w)).rotation
        covariance = np.array(message.pose.covariance).reshape(6, 6)
        self._sure.append((stamp_ns(message) - self._base_ns, turn, covariance))

    def _claimed(self, when: float) -> float:
        """Standard deviation (m) of the body's place, as ``~/map_to_odom`` has it for this time.

        TF interpolates between two transforms; the less certain one counts.
        """
        place, found = self._drive.odometry(when, self._drift).translation, [math.nan]
        for (before, *first), (after, *second) in itertools.pairwise(self._sure):
            if not before <= 1e9 * when <= after:
                continue
            for turn, covariance in (first, second):
                jacobian = np.eye(6)
                jacobian[:3, 3:] = -so3.hat(turn @ place)
                moved = (jacobian @ covariance @ jacobian.T)[:3, :3]
                found.append(math.sqrt(moved.trace()))
        return float(np.nanmax(found)) if len(found) > 1 else math.nan

    def _send_odometry(self, at: float) -> None:
        odom = self._drive.odometry(at, self._drift)
        self._moving.sendTransform(_stamped(self._stamp(at), "odom", "base_link", odom))

    def _send_image(self, frames: Sequence[SimulatedFrame], at: float) -> None:
        frame = frames[round((at - _ARRIVAL) * _IMAGES)]
        stamp, when = self._base_ns + frame.stamp_ns, 1e-9 * frame.stamp_ns
        kept = slice(_FEW if self._trouble.occluded(when) else None)
        share, metres = self._trouble.moved(when)
        hit = frame.ids * 0.618034 % 1.0 < share  # always the same ones, all over the room
        points = frame.points + np.outer(hit, [metres, 0.0, 0.0])
        cloud = make_correspondences(stamp, points[kept], frame.pixels[kept], frame.ids[kept])
        info = make_camera_info(CAMERA, stamp)
        for publisher, message in ((self._infos, info), (self._clouds, cloud)):
            publisher.publish(copy_message(message, message.__msgtype__))

    def _look(self, at: float) -> None:
        when = at - _BEFORE
        stamp = Time(nanoseconds=self._stamp(when))
        try:
            self._buffer.lookup_transform("odom", "base_link", stamp)
        except self._missing:
            return  # odometry itself has not come yet
        try:
            item = self._buffer.lookup_transform("map", "base_link", stamp)
        except self._missing:
            self.heard.looks.append(Looked(when, None))
            return
        found, truth = read_transform(item.transform), self._drive.body(when)
        turn = so3.log(np.ascontiguousarray(found.rotation.T @ truth.rotation))
        off = float(np.linalg.norm(found.translation - truth.translation))
        turned = float(np.linalg.norm(turn))
        self.heard.looks.append(Looked(when, found, off, turned, self._claimed(when)))

    def _click(self, metres: float, at: float) -> None:
        here = self._drive.body(at)
        place = Transform(here.rotation, here.translation + np.array([metres, 0.0, 0.0]))
        message = PoseWithCovarianceStamped()
        message.header = _stamped(self._stamp(at), "map", "", place).header
        message.pose.pose.position = make_vector(make_message, place.translation, "Point")
        message.pose.pose.orientation = make_quaternion(make_message, place.rotation)
        message.pose.covariance[[0, 7, 35]] = 0.25, 0.25, 0.0685  # as RViz gives it
        self._clicked.publish(message)

    def _send_rival(self, at: float) -> None:
        if self._trouble.rival[0] <= at < self._trouble.rival[1]:
            wrong = Transform(np.eye(3), np.array([4.7, 0.0, 0.0]))
            self._moving.sendTransform(_stamped(self._stamp(at), "map", "odom", wrong))


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
        hidden = lambda t: any(a <= t < b for a, b in ends)  # noqa: E731
        heard = driven(Trouble(now, occluded=hidden), drift)
        first = next(look.time for look in heard.looks if look.found)
        looks = [look for look in heard.looks if look.time > first]
        covered = [any(a <= look.time < b + _AFTER for a, b in ends) for look in looks]
        clear += [look for look, hidden in zip(looks, covered, strict=True) if not hidden]
        for (begin, end), length in zip(ends, OCCLUSIONS, strict=True):
            inside = [look for look in looks if begin <= look.time < end + _AFTER]
            rows[length].append([
                len(inside), sum(look.found is not None for look in inside),
                100.0 * max(look.off for look in inside if look.found),
                math.degrees(max(look.turned for look in inside if look.found)),
                100.0 * _jump(inside, end, drift),
                max(look.ratio for look in inside if look.claimed > 0.0),
            ])  # fmt: skip
    answered = sum(look.found is not None for look in clear)
    farthest = max(look.off for look in clear if look.found)
    ratio = max(look.ratio for look in clear if look.claimed > 0.0)
    lines = [
        "| s without a view | lookups answered | largest error | jump | error over claimed |",
        "|---|---|---|---|---|",
        f"| 0 | {answered} of {len(clear)} | {100.0 * farthest:.1f} cm | | {ratio:.2f} |",
    ]
    for length, of in rows.items():
        asked, found, off, turned, jump, ratio = np.array(of).T
        lines.append(
            f"| {length:g} ({len(of)} times) | {found.sum():.0f} of {asked.sum():.0f} "
            f"| {off.max():.1f} cm, {turned.max():.1f} deg | {jump.max():.1f} cm "
            f"| {ratio.max():.2f} |"
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


def trouble() -> list[str]:
    """Lines of a table: wrong maps, kidnapping, a rival, clicks, a blind start."""
    lines = [
        "| trouble | lookups answered | largest error | error over claimed | then |",
        "|---|---|---|---|---|",
    ]

    def moved(time: float) -> tuple[float, float]:
        k, since = divmod(time - _START, _WRONG + _RIGHT)
        return WRONG[int(k)] if 0 <= k < len(WRONG) and since < _WRONG else (0.0, 0.0)

    heard = driven(Trouble(_START + len(WRONG) * (_WRONG + _RIGHT), moved=moved), DRIFTS[0])
    for k, (share, metres) in enumerate(WRONG):
        begin = _START + k * (_WRONG + _RIGHT)
        name = f"{share:.0%} of the landmarks off by {metres:g} m"
        lines.append(_line(name, heard, begin, begin + _WRONG, begin + _WRONG + _RIGHT))
    for metres, seconds, hidden in ((1.0, 1.0, False), (5.0, 4.0, False), (5.0, 4.0, True)):
        heard = driven(Trouble(
            _START + seconds + 5.0,
            carried=lambda t: metres * min(max((t - _START) / seconds, 0.0), 1.0),  # noqa: B023
            occluded=lambda t: hidden and _START <= t < _START + seconds,  # noqa: B023
        ), DRIFTS[0])  # fmt: skip
        name = f"carried {metres:g} m in {seconds:g} s, {'blind' if hidden else 'in view'}"
        seen = _START + seconds + 0.2 if hidden else _START
        lines.append(_line(name, heard, seen, _START + seconds + 2.0, _START + seconds + 4.5))
    heard = driven(Trouble(_START + 6.0, rival=(_START, _START + 3.0)), DRIFTS[0])
    lines.append(_line("AMCL beside it, 4.7 m off", heard, _START, _START + 3.0, _START + 5.5))
    blind = Trouble(
        24.0, occluded=lambda t: t < 18.0, clicks=((3.0, 0.3), (9.0, 4.0), (13.0, -0.3))
    )
    heard = driven(blind, DRIFTS[0])
    lines.append(_line("blind start, a click 0.3 m off", heard, 3.3, 9.0, 9.0))
    lines.append(_line("a click 4 m off", heard, 9.0, 13.0, 13.0))
    lines.append(_line("a click -0.3 m off", heard, 13.3, 18.0, 23.5))
    return lines


def _line(name: str, heard: Heard, begin: float, end: float, after: float) -> str:
    """One trouble: errors while it lasts, and how things are afterwards."""
    inside = [look for look in heard.looks if begin <= look.time < end]
    found = [look for look in inside if look.found]
    last = [look for look in heard.looks if look.found and look.time < after]
    levels = [(level, values) for time, level, values in heard.values if begin <= time < end + 1.0]
    worst, values = max(levels, key=lambda it: it[0], default=(0, {}))
    said = f"ERROR: {values[''][:70]}" if worst == 2 else ""
    given = values.get("Last given pose", "")
    then = f"{100.0 * last[-1].off:.1f} cm" if last else "nothing"
    off = max((look.off for look in found), default=math.nan)
    ratio = max((look.ratio for look in found if look.claimed > 0.0), default=math.nan)
    told = "; ".join(filter(None, [then, said, given]))
    return (
        f"| {name} | {len(found)} of {len(inside)} | {100.0 * off:.1f} cm | {ratio:.1f} | {told} |"
    )


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.load.robot", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("what", choices=("occlusions", "trouble"))
    args = parser.parse_args()
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(random.SystemRandom().randrange(1, 101))
    print("\n".join(occlusions() if args.what == "occlusions" else trouble()))


if __name__ == "__main__":
    main()
