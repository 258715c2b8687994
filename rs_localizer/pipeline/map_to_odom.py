# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The correction of odometry, ``map -> odom`` (REP-105): held between frames, and without them.

A frame says where the body is in the map, odometry where it is in its own frame; the correction
is one by the other's inverse. While it is held, its error grows with what odometry drifts. How
fast that is, the corrections themselves show: what one a second old predicts of the body's pose,
against what the new frame finds, beside the noise of both. Errors of drift count as growing with
time, not with its root: scale and heading of wheels are off the same way all along.
"""

import math
from dataclasses import dataclass

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.io.outputs import BodyPose, Localized
from rs_localizer.io.transforms import Transform

# Of odometry that nobody has seen drift yet: m/s and rad/s, of wheels on carpet.
_DRIFT = (0.03, 0.015)
# Drift is judged by corrections so far apart (s); by closer ones, poses' noise is all there is.
_BASELINE = 1.0
# Weight of the newest: some ten seconds count.
_NEWEST = 0.2
# Jumps above so many deviations are told: one axis alone has them once in two million frames.
_JUMP = 5.0


def corrected(map_from_body: Transform, odom_from_body: Transform, *, two_d: bool) -> Transform:
    """``map_from_odom`` by which odometry has the body where it is in the map.

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


@dataclass(frozen=True, slots=True)
class Holding:
    """Age and deviations of the correction at a moment."""

    seconds: float  # since the frame that it is of
    position: float  # m, standard deviation of the body's place in the map
    angle: float  # rad, of its orientation
    ended: bool = False  # it is older than ``hold`` and no longer sent

    def __str__(self) -> str:
        off = f"{100.0 * self.position:.2g} cm, {math.degrees(self.angle):.2g} deg"
        if self.ended:
            return f"not sent since hold ended, {self.seconds:.1f} s after the last frame, {off}"
        return f"holding for {self.seconds:.1f} s, {off}"


@dataclass(frozen=True, slots=True, eq=False)
class _Correction:
    """The correction that one frame made."""

    stamp_ns: int
    map_from_odom: Transform
    odom_from_body: Transform
    variance: tuple[float, float]  # m^2, rad^2: traces of the pose's covariance


class MapToOdom:
    """The last correction, and what is known of the drift since then."""

    def __init__(self) -> None:
        self._last: _Correction | None = None
        self._way, self._at = 0.0, np.zeros(3)  # m since then by odometry, and where it was last
        self._base: _Correction | None = None  # that the drift is judged by
        self._drift = np.square(_DRIFT)  # per s, squared: m/s, rad/s

    def forget(self) -> None:
        """Hold nothing; the drift is the same odometry's as before."""
        self._last = self._base = None

    @property
    def stamp_ns(self) -> int | None:
        """Stamp of the frame that is held; None: nothing is."""
        return None if self._last is None else self._last.stamp_ns

    def take(self, frame: Localized, odom_from_body: Transform, *, two_d: bool) -> str:
        """Hold this frame's correction from now on.

        Returns:
            What to say of a jump that no deviation explains; empty: there is none.
        """
        place = Transform(frame.pose.rotation, frame.pose.position)
        newest = _Correction(
            frame.stamp_ns,
            corrected(place, odom_from_body, two_d=two_d),
            odom_from_body,
            _variances(frame.pose, two_d=two_d),
        )
        jump = self._jump(newest)
        base = self._base
        if base is None or newest.stamp_ns < base.stamp_ns:
            self._base = newest
        elif (seconds := 1e-9 * (newest.stamp_ns - base.stamp_ns)) >= _BASELINE:
            off = np.square(_offsets(base, newest))
            noise = np.add(base.variance, newest.variance)
            drift = np.maximum(off - noise, 0.0) / seconds**2
            self._drift += _NEWEST * (drift - self._drift)
            self._base = newest
        self._last, self._way, self._at = newest, 0.0, odom_from_body.translation
        return jump

    def held(self, time_ns: int, hold: float) -> Transform | None:
        """``map_from_odom`` at a time; None where nothing is held, or no longer.

        Args:
            hold: s for which it is; 0: for ever.
        """
        last = self._last
        return None if last is None or self._ended(time_ns, hold) else last.map_from_odom

    def _ended(self, time_ns: int, hold: float) -> bool:
        return self._last is not None and 0.0 < hold < 1e-9 * (time_ns - self._last.stamp_ns)

    def holding(self, time_ns: int, odom_from_body: Transform, hold: float) -> Holding | None:
        """Age and deviations at a time when odometry has the body there; None: there was no frame.

        To be asked often: the way since the last frame counts, not the distance.

        Args:
            hold: as of :meth:`held`.
        """
        if self._last is None:
            return None
        seconds = max(1e-9 * (time_ns - self._last.stamp_ns), 0.0)
        position, angle = self._grown(self._last, seconds, odom_from_body)
        ended = self._ended(time_ns, hold)
        return Holding(seconds, math.sqrt(position), math.sqrt(angle), ended)

    def _grown(
        self, since: _Correction, seconds: float, odom_from_body: Transform
    ) -> tuple[float, float]:
        """Variances (m^2, rad^2) of the body's pose by a correction, so much later."""
        self._way += float(np.linalg.norm(odom_from_body.translation - self._at))
        self._at = odom_from_body.translation
        place, turn = since.variance
        drift, drift_of_turn = self._drift * seconds**2
        # A heading that is off, and ever more so, sends all of the way astray.
        astray = self._way**2 * (turn + 0.25 * drift_of_turn)
        return place + drift + astray, turn + drift_of_turn

    def _jump(self, newest: _Correction) -> str:
        last = self._last
        if last is None or newest.stamp_ns < last.stamp_ns:
            return ""
        off = _offsets(last, newest)
        seconds = 1e-9 * (newest.stamp_ns - last.stamp_ns)
        grown = self._grown(last, seconds, newest.odom_from_body)
        ratio = float(np.max(off / np.sqrt(np.add(grown, newest.variance))))
        if ratio <= _JUMP:
            return ""
        return (
            f"map -> odom jumps by {100.0 * off[0]:.2g} cm and {math.degrees(off[1]):.2g} deg "
            f"after {seconds:.1f} s, {ratio:.0f} times the deviation of what was held: which of "
            "the two is right?"
        )


def _offsets(older: _Correction, newer: _Correction) -> Array:
    """Distances (m, rad) of the body by the older one from where the newer one has it."""
    expected = older.map_from_odom @ newer.odom_from_body
    found = newer.map_from_odom @ newer.odom_from_body
    turn = so3.log(np.ascontiguousarray(expected.rotation.T @ found.rotation))
    off: Array = found.translation - expected.translation
    return np.array([np.linalg.norm(off), np.linalg.norm(turn)])


def _variances(pose: BodyPose, *, two_d: bool) -> tuple[float, float]:
    """Traces of a covariance; of a correction in the plane, of what it has."""
    own = pose.covariance.diagonal()
    return (own[:2].sum(), own[5]) if two_d else (own[:3].sum(), own[3:].sum())
