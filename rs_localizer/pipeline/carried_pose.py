# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A pose of the body in the map that odometry carries on, and what that adds to its error.

Errors of drift count as growing with time, not with its root: scale and heading of wheels are off
the same way all along. Offsets and covariances are of six numbers: x, y, z (m), then rotations
about the axes of the map (rad).
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.io.transforms import Transform

PLACE, TURN = slice(0, 3), slice(3, 6)
# Drift along and about each axis of the body, m/s and rad/s: of wheels on carpet until it has been
# seen, the least that is believed, and the most that counts as odometry.
_CARPET, _LEAST, _MOST = (np.repeat(np.square(pair), 3) for pair in (
    (0.03, 0.015), (0.005, 0.002), (0.2, 0.1)
))  # fmt: skip
# It is judged by poses so far apart (s): between closer ones, there is only their noise. The newest
# counts by a fifth, so that some twenty seconds do.
_BASELINE, _NEWEST = 2.0, 0.2

# s of agreement from which on a hypothesis is told as a contradiction; what a pose adds at most.
PERSISTS, _STEP = 0.2, 0.2
# What is hit slides to rest by friction: at most this far per squared second, half of 1 g (m), and
# as far for the edge of a body of 0.2 m (rad).
_SLIDE = 4.9, 25.0


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """A moment of odometry."""

    stamp_ns: int
    odom_from_body: Transform
    travelled: float = 0.0  # m since the start, as of :meth:`after`

    def after(self, newest: "Odometry | None") -> tuple["Odometry", "Odometry"]:
        """Return this moment with the distance travelled so far, and the newest moment of both."""
        if newest is None:
            return self, self
        step = self.odom_from_body.translation - newest.odom_from_body.translation
        way = float(np.linalg.norm(step))
        if self.stamp_ns <= newest.stamp_ns:
            return replace(self, travelled=newest.travelled - way), newest
        now = replace(self, travelled=newest.travelled + way)
        return now, now


@dataclass(frozen=True, slots=True, eq=False)
class FoundPose:
    """A pose of the body that a frame found."""

    at: Odometry
    map_from_body: Transform
    covariance: Array  # (6,6) x, y, z, then rotations about the axes of the map
    doubt: float = 0.0  # probability that it is wrong; NaN: nobody says


class Click(FoundPose):
    """A pose of the body that a user, or a file, gives."""


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """How fast the error of odometry grows, learnt from the poses of the camera."""

    squared: Array = field(default_factory=_CARPET.copy)  # (6,) per s, in the body's axes
    count: int = 1  # how often it was seen

    def judged(
        self, base: "CarriedPose", found: "CarriedPose", now: Odometry
    ) -> tuple["CarriedPose", "Drift"]:
        """Return the pose from which the drift is judged next, and the drift as judged now."""
        if (seconds := base.seconds(now)) < _BASELINE:
            return base, self
        off, body = base.offset(found, now), found.body(now).rotation
        noise = base.covariance + found.covariance
        newest = np.empty(6)  # below zero by chance
        for part in (PLACE, TURN):
            newest[part] = (body.T @ off[part]) ** 2 - np.diag(body.T @ noise[part, part] @ body)
        weight = max(_NEWEST, 1.0 / (1.0 + self.count))
        squared = self.squared + weight * (newest / seconds**2 - self.squared)
        return found, Drift(np.minimum(squared, _MOST), self.count + 1)

    def after(self, seconds: float) -> Array:
        """Return the variances (6,) that odometry adds in this many seconds."""
        variances: Array = seconds**2 * np.maximum(self.squared, _LEAST)
        return variances


@dataclass(frozen=True, slots=True, eq=False)
class CarriedPose:
    """Where the body was at a moment of odometry, and from which odometry carries it on."""

    since: Odometry
    map_from_odom: Transform
    covariance: Array  # (6,6) of the body's pose then; zero for what is zero in the plane

    def body(self, now: Odometry) -> Transform:
        """Return ``map_from_body`` at another moment."""
        return self.map_from_odom @ now.odom_from_body

    def staying(self, since: Odometry, now: Odometry) -> "CarriedPose":
        """Return the pose of a body that has stayed where it was, whatever odometry says."""
        return replace(self, map_from_odom=self.body(since) @ now.odom_from_body.inverse())

    def seconds(self, now: Odometry) -> float:
        return max(1e-9 * (now.stamp_ns - self.since.stamp_ns), 0.0)

    def offset(self, other: "CarriedPose", now: Odometry) -> Array:
        """Return the offset (6,) from this pose to ``other``, both carried to now."""
        here, there = self.body(now), other.body(now)
        turn = so3.log(np.ascontiguousarray(there.rotation @ here.rotation.T))
        return np.concatenate([there.translation - here.translation, turn])

    def grown(self, now: Odometry, drift: Drift, axes: list[int]) -> Array:
        """Return the covariance (6,6) at another moment, for these of the six numbers."""
        body = self.body(now)
        went = self.map_from_odom.rotation @ (
            now.odom_from_body.translation - self.since.odom_from_body.translation
        )
        added, more = np.zeros((6, 6)), drift.after(self.seconds(now))
        added[TURN, TURN] = turned = (body.rotation * more[TURN]) @ body.rotation.T
        added[PLACE, PLACE] = (body.rotation * more[PLACE]) @ body.rotation.T
        # A heading that is ever more off sends all of the way astray, to one side or the other.
        way = 0.5 * (now.travelled - self.since.travelled)
        added[PLACE, PLACE] += 0.5 * way**2 * (np.eye(3) * turned.trace() - turned)
        grown, own = _moved(self.covariance, went), np.ix_(axes, axes)
        grown[own] += added[own]
        return grown

    def fused(
        self, other: "CarriedPose", now: Odometry, drift: Drift, axes: list[int]
    ) -> "CarriedPose":
        """Return this pose corrected by an independent measurement ``other``."""
        grown, own, gain = self.grown(now, drift, axes), np.ix_(axes, axes), np.zeros((6, 6))
        gain[own] = grown[own] @ np.linalg.inv(grown[own] + other.covariance[own])
        step, body = gain @ self.offset(other, now), self.body(now)
        turned = so3.exp(np.ascontiguousarray(step[TURN])) @ body.rotation
        place, spread = Transform(turned, body.translation + step[PLACE]), grown - gain @ grown
        return carried_pose(now, place, 0.5 * (spread + spread.T), axes)

    def sharper(
        self, other: "CarriedPose", now: Odometry, drift: Drift, axes: list[int]
    ) -> "CarriedPose":
        """Return the more certain one of this pose and another."""
        own, ours = np.ix_(axes, axes), self.grown(now, drift, axes)
        volumes = (np.linalg.slogdet(spread[own])[1] for spread in (other.covariance, ours))
        return other if next(volumes) <= next(volumes) else self

    def of_transform(self, grown: Array, now: Odometry) -> Array:
        """Convert the covariance (6,6) of the body to that of the odometry's origin in the map."""
        return _moved(grown, self.map_from_odom.translation - self.body(now).translation)


def carried_pose(
    now: Odometry, map_from_body: Transform, covariance: Array, axes: list[int]
) -> CarriedPose:
    """Return the pose of a body, with the odometry of its moment."""
    two_d, own = len(axes) == 3, np.ix_(axes, axes)
    kept = np.zeros((6, 6))
    kept[own] = covariance[own]
    return CarriedPose(now, corrected(map_from_body, now.odom_from_body, two_d=two_d), kept)


def corrected(map_from_body: Transform, odom_from_body: Transform, *, two_d: bool) -> Transform:
    """Return the ``map_from_odom`` with which odometry has the body at its place in the map.

    Args:
        two_d: its z, roll and pitch are zero; then the body has its x and y, and the heading of
            odometry is turned about z only.
    """
    whole = map_from_body @ odom_from_body.inverse()
    if not two_d:
        return whole
    yaw = math.atan2(
        whole.rotation[1, 0] - whole.rotation[0, 1], whole.rotation[0, 0] + whole.rotation[1, 1]
    )
    rotation = so3.exp(np.array([0.0, 0.0, yaw]))
    translation = map_from_body.translation - rotation @ odom_from_body.translation
    return Transform(rotation, translation * np.array([1.0, 1.0, 0.0]))


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A pose that may be right.

    Poses of a track err together: many are no better than the sharpest of them. That one stays
    until drift makes it less certain than the newest, which tells how certain it is.
    """

    pose: CarriedPose
    newest: CarriedPose
    near_ns: int  # of the last pose there, be it as doubtful as it may
    seen_ns: float = -math.inf  # of the last pose of a frame that counted
    support: float = 0.0  # s for which poses agreed
    reachable: bool = True  # whether a body can have come there
    # The first pose there (of what is held: the last but one), and when poses left the held one
    earlier: CarriedPose | None = None
    left_ns: int = 0

    @property
    def told(self) -> bool:
        """Whether poses agreed for long enough to speak of it."""
        return self.support >= PERSISTS

    def renewed(
        self, found: "Hypothesis", drift: Drift, axes: list[int], most: float
    ) -> "Hypothesis":
        """Return this one with its newest pose, and a support of at most so many seconds."""
        now = found.pose.since
        since = max(1e-9 * (found.near_ns - self.near_ns), 0.0)
        return replace(
            self, pose=self.pose.sharper(found.pose, now, drift, axes), newest=found.newest,
            near_ns=found.near_ns, seen_ns=found.seen_ns,
            support=min(self.support + min(since, _STEP), most),
        )  # fmt: skip

    def stepped(self, held: "Hypothesis") -> bool:
        """Return whether poses came here in a step that no body makes, be odometry wrong or not.

        What is carried moves before or after its longest step; what is hit slides on.
        """
        left, first, end = held.newest, self.earlier or self.pose, self.pose
        before, at = held.earlier or left, first.since
        seconds = 1e-9 * max(at.stamp_ns - self.left_ns, 0)
        drove = left.body(left.since).translation - before.body(before.since).translation
        drove *= seconds / max(before.seconds(left.since), 1e-3)

        def from_rest(start: CarriedPose, more: float) -> bool:
            steps = start.offset(end, at)
            return any(
                _along(steps, part, start, end, at, 3.0) > most * seconds**2 + more
                and _along(steps, part, before, left, left.since, 2.0) <= 0.0
                and _along(steps, part, first, end, at, 2.0) <= 0.0
                for part, most in zip((PLACE, TURN), _SLIDE, strict=True)
            )

        stayed = left.staying(left.since, at)
        return from_rest(left, 0.0) and from_rest(stayed, float(np.linalg.norm(drove)))


def _along(
    steps: Array, part: slice, one: CarriedPose, other: CarriedPose, at: Odometry, slack: float
) -> float:
    """Return how far one pose lies from another along steps (6,), less deviations of noise."""
    along = steps[part] / max(float(np.linalg.norm(steps[part])), 1e-12)
    spread = float(along @ (one.covariance + other.covariance)[part, part] @ along)
    return float(one.offset(other, at)[part] @ along) - slack * math.sqrt(spread)


def _moved(covariance: Array, way: Array) -> Array:
    """Move a covariance (6,6) to a pose whose origin is displaced by (3,), in map axes."""
    jacobian = np.eye(6)
    jacobian[PLACE, TURN] = -so3.hat(way)
    moved: Array = jacobian @ covariance @ jacobian.T
    return moved


def far(offset: Array) -> str:
    """Describe an offset, or deviations (6,), in words."""
    place, turn = np.linalg.norm(offset[PLACE]), np.linalg.norm(offset[TURN])
    metres = f"{100.0 * place:.2g} cm" if place < 0.995 else f"{place:.2g} m"
    return f"{metres}, {math.degrees(float(turn)):.2g} deg"


def least_jump(spread: Array, axes: list[int], gate: float) -> tuple[float, float]:
    """Return the smallest jump, m and rad, whose squared distance in deviations is ``gate``."""
    least, cut = np.linalg.inv(spread[np.ix_(axes, axes)]), sum(axis < 3 for axis in axes)
    parts = least[:cut, :cut], least[cut:, cut:]
    place, turn = (math.sqrt(gate / np.linalg.eigvalsh(it)[-1]) for it in parts)
    return place, turn
