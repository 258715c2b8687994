# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A watch that compares readout time, scan direction and axis with the camera's motion.

The poses before and after a frame give the camera's velocity ``v``; the image shows how far it goes
while rows, or columns, are read. Let the rows take the time ``T_r``, negative if they run against
the direction that is set. Let the columns take ``T_c``: drivers that rotate images turn the scan
sideways. The points of a frame are then off by

    e = J d + (tau_r T_r + tau_c T_c) J v + J (tau_r m_r + tau_c m_c) + noise

``J`` is the derivative by the pose, ``d`` the error of the pose, and ``m`` the effect of errors of
map and lens, which is alike in neighbouring frames. A Kalman filter estimates ``T_r, T_c``, whose
evidence fades, and both ``m``, which wander. The right shutter is ``(T, 0)``, a global one ``(0,
0)``, a reversed one ``(-T, 0)``; off the first axis the shutter runs along the other one.

A fault that is no shutter's shows in the rotation ``r`` within the rows beside that between images.
If the film is stabilized, each image was turned as a whole: ``r`` changes smoothly about zero, and
its sum is the angle that poses are off by.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.rig import Rig
from rs_localizer.core.scanning import ACROSS, REVERSED, ScanDirection
from rs_localizer.core.shutter import Motion
from rs_localizer.core.state import MOTION_PARAMETERS, POSE, TURN, VELOCITIES
from rs_localizer.core.types import Estimate, Failure, roughness
from rs_localizer.estimation.points import find_usable, packed
from rs_localizer.estimation.prior import state_in
from rs_localizer.estimation.projection import linearized

# If the readout time is off by more than this share, single frames are better than tracked ones.
# The errors of a hand's angular velocity, tracked over single, are 0.95, 1.3 and 1.5 if it is off
# by a factor of 1.3, 1.5 and 1.7 (150 points, 0.3 px). A time known to a half is off by a third in
# the median.
FAR_OFF = 0.5
_MOST_POINTS = 200  # of a frame: more points take longer than they are worth
# Points count within this many inlier thresholds, because the axis may be the wrong one.
_GATE = 3.0
# The prior of the velocities in one image, whose points hardly determine them: usual cameras move
# by some 0.1 rad, or shares of the depth, per readout, at a noise of 0.3 px.
_OF_USUAL_SPEEDS = 0.3 / 0.1
_LEAST_NOISE, _ROUNDS = 0.1, 3  # px, no real error is smaller; rounds of robust weights
# Neighbours that are farther away (s), or whose intervals differ by more, tell little.
_LONGEST_INTERVAL, _MOST_UNLIKE = 0.15, 2.5
# Least squared velocity, over its variance: the noise of a slower one shortens T by a tenth.
_LEAST_MOTION = 60.0
# Standard deviation of T before anything is known, in readout times, and the share of the evidence
# that is left one frame later: a third after five seconds at 30 Hz.
_ANY, _MEMORY = 3.0, math.exp(-1.0 / 150.0)
# Errors of map and lens look like a motion by this many rad, or shares of the depth, per readout,
# and stay alike for a second. With this, tags before a real global shutter show 0.1 to 0.3 ms of
# 20.
_LIKE_MOTION, _ALIKE = 0.002, math.exp(-1.0 / 30.0)
# Stronger wandering is learnt from a tenth of each innovation, of at most four times the expected
# one. A camera that vibrates between its frames moves otherwise within them, or shows a readout
# that is longer than the interval: 0.1 deg at 11 to 47 Hz make 2 to 600 times, or 60 ms; hands 1.3.
_LEARNING, _MOST_UNLIKELY, _SHAKEN = 0.1, 4.0, 1.5
# Rates that are known vibrate if this share of the angular velocity is no parabola of the rows.
_ROUGH = 0.1
# A shutter is contradicted beyond this many deviations, if it is also off by more than this share.
_SURELY, _LEAST_DIFFERENCE = 4.0, 0.06
# If the setting is known to this share, this many of this many frames are enough.
_WELL_KNOWN, _ON, _CYCLE = 0.05, 3, 9
# Below this share of the setting nothing tells the shutter from a global one.
_GLOBAL = 0.2
# A film is stabilized if what images turn within their rows beside the motion between them varies
# by more than errors of map and lens do (rad per readout, rms), and smoothly: of the last frames,
# of so many at least, neighbours correlate by more than this. Vibration changes its sign from frame
# to frame, unless it has the images' rate.
_TAKEN_OUT, _LAST, _LEAST, _SMOOTHLY = 3.5 * _LIKE_MOTION, 30, 12, 0.6
# Orientations widen by what such rates turn in this time (s): a hand sways at 0.8 Hz. Before it is
# named, they do so if rows also show a readout time that is longer by so many deviations.
_SWAY, _LONGER = 0.2, 3.0
# Logarithms of the odds of another shutter at which it is doubted, no longer doubted (a robot that
# drives slowly shows neither) and certain, and of rest before a global shutter.
_SUSPICIOUS, _SHOWN, _CERTAIN, _AT_REST = 4.0, -2.0, 8.0, 20.7
# So many frames must show another axis: in one, a focal length that is off by 2 % looks like it.
_SOME = 2


@dataclass(frozen=True, slots=True)
class MeasuredReadout:
    """A readout time that the frames of the last seconds show."""

    readout_time: float  # s; negative: against the scan direction that was assumed
    deviation: float  # s
    short_ways: float = 0.0  # s, by which ways that are shorter than the motion may change it

    def contradicts(self, readout_time: float) -> bool:
        """Return True if this readout time (s, of the assumed direction) must be wrong."""
        least = _LEAST_DIFFERENCE * max(abs(self.readout_time), readout_time)
        off = abs(self.readout_time - readout_time) - self.short_ways
        return off > max(_SURELY * self.deviation, least)

    def odds(self, one: float, other: float) -> float:
        """Return the logarithm of the odds for one readout time (s) against another."""
        far = [((value - self.readout_time) / self.deviation) ** 2 for value in (one, other)]
        return 0.5 * (far[1] - far[0])

    def __str__(self) -> str:
        return f"{1e3 * abs(self.readout_time):.1f} +- {1e3 * self.deviation:.1f} ms"


class _Look(NamedTuple):
    """A frame whose points are linearized about its estimate."""

    time_ns: int
    found: Estimate
    units: Array  # (6,) rad and m, of a velocity
    rows: Array  # (2 n,18) px, derivatives by pose, and by the way over the rows, and over columns
    off: Array  # (2 n,) px, of the points if the camera did not move

    def over_columns(self) -> Array:
        """Return the pose's step and velocity (12,) that fit the points if rows are columns."""
        rows = np.r_[np.delete(self.rows, slice(6, 12), axis=1), _OF_USUAL_SPEEDS * np.eye(12)[6:]]
        motion = np.linalg.lstsq(rows, np.r_[self.off, np.zeros(6)], rcond=None)[0]
        return np.asarray(motion * np.tile(self.units, 2), np.float64)


class ShutterWatch:
    """Compares the configured shutter with the frames; see the module.

    Args:
        camera: as it is set; None: there is nothing to compare.
        threshold: px, of inliers.
    """

    def __init__(self, camera: Camera | None, threshold: float) -> None:
        self._gate, self._camera = _GATE * threshold, camera
        if camera is not None:
            self._exposure = Rig.of(camera).exposure().ahead()
            self._direction = ScanDirection(camera.scan_direction)
            self._sideways = replace(camera, scan_direction=ACROSS[self._direction])
            spread = np.repeat([_ANY * camera.readout_time, _LIKE_MOTION], [2, 12])
            self._any = np.diag(spread**2)
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.measured: MeasuredReadout | None = None
        """Readout time that the last seconds of motion show along the set axis; None: none yet."""
        self.fault = self.kind = ""
        """How that contradicts the setting, in one sentence, and in one word."""
        self.refusal = ""
        """Why no pose can be told: the shutter moves along the other axis."""
        self.error = 0.0
        """Error (s) of the set readout time, if the motion contradicts it; else 0."""
        self.trusted = True
        """Whether the way from frame to frame tells that within them: not in doubt, nor after one
        before frames show it. To and fro between both, poses jump."""
        self.is_global = False
        """Whether all rows are exposed at once."""
        self._reversed = False  # they may run the other way
        self._across = False  # or along the other axis
        self._looks: deque[_Look] = deque(maxlen=4)
        # Squared speed of the ways between neighbours, and of what a sharper curve has beside it
        self._of_ways = np.zeros(2)
        # What images turn within their rows beside the motion between them, rad per readout
        self._beside: deque[Array] = deque(maxlen=_LAST)
        self._taken_out = 0.0  # rad, deviation of the angles that a stabilizer takes out
        self._frames = 0
        if self._camera is not None:
            self._mean, self._covariance = np.zeros(14), self._any
            self._unlike = 1.0  # by how much the square of what wanders is more than usual

    @property
    def watches(self) -> bool:
        """Whether there is a shutter to compare."""
        return self._camera is not None

    @property
    def of_rest(self) -> float:
        """Logarithm of the odds that what looks like motion within an image is none."""
        return _AT_REST if self.is_global else 0.0

    def widened(self, found: Estimate) -> Estimate:
        """Return the last frame with a covariance that allows for what the watch has found."""
        if self._taken_out:
            calibration = found.calibration_covariance.copy()
            calibration[TURN, TURN] += self._taken_out**2 * np.eye(3)
            found = replace(found, calibration_covariance=calibration)
        if not (self._reversed or self._across):
            return found
        own = np.r_[found.angular_velocity, found.linear_velocity]
        steps = [np.r_[np.zeros(6), -2.0 * own]]
        if self._across:
            sideways = self._looks[-1].over_columns()
            steps = [sideways * np.repeat([1.0, sign], 6) for sign in (1.0, -1.0)]
            for step in steps:
                step[VELOCITIES] -= own
        joint = found.joint_covariance.copy()
        for step in steps:
            joint[:MOTION_PARAMETERS, :MOTION_PARAMETERS] += np.outer(step, step)
        return replace(found, joint_covariance=joint)

    def add(
        self, time_ns: int, found: Estimate | Failure, points: Array, pixels: Array,
        *, jumped: bool = False,
    ) -> None:  # fmt: skip
        """Take a frame whose middle row was exposed at ``time_ns``, as it was localized.

        ``jumped``: no camera goes there from the last frame. No motion within an image tells of
        such a way.
        """
        if not found or self._camera is None or self._may_rest(self._camera.readout_time):
            self._looks.clear()
            return
        if jumped or (self._looks and time_ns <= self._looks[-1].time_ns):
            self._looks.clear()
        some = slice(None, None, 1 + len(points) // _MOST_POINTS)
        points, pixels = map(np.ascontiguousarray, (points[some], pixels[some]))
        self._looks.append(self._look(time_ns, found, points, pixels))
        # One that vibrates within its images goes elsewhere there than between them.
        if len(self._looks) >= 3 and _vibrates(self._looks[-2].found):
            self._beside.clear()
        elif len(self._looks) >= 3:
            before, now, after = list(self._looks)[-3:]
            first, second = (now.time_ns - before.time_ns) * 1e-9, (time_ns - now.time_ns) * 1e-9
            alike = 1.0 / _MOST_UNLIKE < first / second < _MOST_UNLIKE
            if alike and max(first, second) <= _LONGEST_INTERVAL:
                self._compare_ways()
                self._measure(before, now, after, first + second)

    def _may_rest(self, usual: float) -> bool:
        self._frames += 1
        known = self.measured is not None and self.measured.deviation < _WELL_KNOWN * usual
        known &= self.trusted and not self.kind and len(self._beside) >= _LEAST
        return known and self._frames % _CYCLE >= _ON

    def _look(self, time_ns: int, found: Estimate, points: Array, pixels: Array) -> _Look:
        usable = find_usable(self._exposure, points, pixels, [len(pixels)], None)
        seen, own = packed(self._exposure, points, usable), usable.indices
        steady = Motion(
            found.rotation, found.translation, found.angular_velocity, found.linear_velocity
        )
        state = state_in(steady, usable.centre)
        lines = linearized(seen.packed, len(seen), state, np.zeros((len(seen), 6)))
        near = np.linalg.norm(lines.errors, axis=1) < self._gate  # NaN is not
        ahead = points[own][near] @ found.rotation[2] + found.translation[2]
        units = np.repeat([1.0, float(np.median(ahead)) if near.any() else 1.0], 3)
        by_pose = lines.by_motion[near, :, POSE] * units
        over_rows = lines.by_motion[near, :, VELOCITIES] * units
        over_columns = self._sideways.row_time(pixels[own][near])[:, None, None] * by_pose
        rows = np.concatenate([by_pose, over_rows, over_columns], axis=2).reshape(-1, 18)
        speed = np.r_[found.angular_velocity, found.linear_velocity] / units
        off = rows[:, 6:12] @ speed - lines.errors[near].ravel()
        return _Look(time_ns, found, units, rows, off)

    def _compare_ways(self) -> None:
        """Learn how much slower than the camera the way between two neighbours of a frame is.

        For a hand's 1.5 Hz at ten images per second it is 8 %, and a readout time is so much too
        long. The cubic through one frame more cuts no corner that a parabola cuts.
        """
        if len(self._looks) < 4:
            return
        now = self._looks[-2]
        others = [look for look in self._looks if look is not now]
        times = 1e-9 * np.array([look.time_ns - now.time_ns for look in others])
        if times[0] < -2.0 * _LONGEST_INTERVAL:
            return
        back = now.found.rotation
        ways = np.array([
            np.r_[so3.log(np.ascontiguousarray(back @ look.found.rotation.T)),
                  back @ (look.found.position - now.found.position)]
            for look in others
        ]) / now.units  # fmt: skip
        cubic = np.linalg.solve(times ** np.arange(1, 4)[:, None], [1.0, 0.0, 0.0]) @ ways
        straight = (ways[2] - ways[1]) / (times[2] - times[1])
        self._of_ways = _MEMORY * self._of_ways + straight @ np.c_[straight, cubic - straight]

    def _measure(self, before: _Look, now: _Look, after: _Look, seconds: float) -> None:
        """Add the evidence of a frame whose neighbours are this many s apart."""
        assert self._camera is not None
        back = now.found.rotation
        turn = so3.log(np.ascontiguousarray(before.found.rotation @ back.T))
        turn += so3.log(np.ascontiguousarray(back @ after.found.rotation.T))
        way = np.r_[turn, back @ (after.found.position - before.found.position)]
        noise = sum(look.found.joint_covariance[POSE, POSE] for look in (before, after))
        try:
            moves = way @ np.linalg.solve(noise, way) > _LEAST_MOTION
        except np.linalg.LinAlgError:  # rounding errors are all that is left of a covariance
            return
        if not moves or len(now.off) < 2 * now.rows.shape[1]:
            return
        speed, rows = way / (seconds * now.units), now.rows
        design = np.c_[rows[:, :6], rows[:, 6:12] @ speed, rows[:, 12:] @ speed, rows[:, 6:]]
        spread, most = self._covariance[:2, :2].diagonal().max(), self._any[0, 0]
        memory = math.sqrt(min(1.0 / _MEMORY, most / spread))
        lasting = np.repeat([memory, _ALIKE], [2, 12])
        known = self._covariance * np.outer(lasting, lasting)
        wanders = (1.0 - _ALIKE**2) * self._any[2:, 2:]
        known[2:, 2:] += self._unlike * wanders
        prior = np.r_[np.zeros(6), self._mean]
        prior[8:] *= _ALIKE
        information = np.zeros((20, 20))
        information[6:, 6:] = np.linalg.inv(known)
        expected, step = now.off - design @ prior, np.zeros(20)
        variance = float(np.median(expected**2)) / 0.455  # of a normal distribution
        for _ in range(_ROUNDS):
            left, variance = expected - design @ step, max(variance, _LEAST_NOISE**2)
            weights = 1.0 / (1.0 + left**2 / (9.0 * variance))
            weighed = (design * (weights / variance)[:, None]).T
            covariance = np.linalg.inv(weighed @ design + information)
            step = covariance @ (weighed @ expected)
            variance = float(weights @ (expected - design @ step) ** 2 / np.sum(weights))
        self._mean, self._covariance = (prior + step)[6:], covariance[6:, 6:]
        own = np.r_[0:6, 8:11]  # the pose's error, and the rotation over the rows
        left = weighed[own] @ (now.off - self._camera.readout_time * design[:, 6])
        self._beside.append(np.linalg.solve(weighed[own] @ design[:, own], left)[6:])
        changed = float(np.mean(step[8:] ** 2 / wanders.diagonal()))
        changed = min(changed, _MOST_UNLIKELY * self._unlike)
        self._unlike = max(self._unlike + _LEARNING * (changed - self._unlike), 1.0)
        usual = self._camera.readout_time
        rate = self._turned_beside()
        if self._unlike < _SHAKEN and np.all(np.abs(self._mean[:2]) < 0.55 * seconds):
            self._judge(usual)
        elif self.kind in ("", "stabilized"):
            self.trusted, self._reversed, self._across = True, False, False
            self._name_stabilizer(rate)
        longer = self._mean[0] - usual > _LONGER * math.sqrt(self._covariance[0, 0])
        widens = self.kind == "stabilized" or (not self.kind and longer)
        self._taken_out = _SWAY * rate if widens else 0.0

    def _turned_beside(self) -> float:
        """Return the rate (rad/s, rms) at which images are turned as wholes; 0: they are not."""
        assert self._camera is not None
        beside = np.array(self._beside)
        if len(beside) < 2:
            return 0.0
        if len(beside) >= _LEAST:
            beside -= beside.mean(axis=0)
        turned = math.sqrt(float(np.mean(np.sum(beside**2, axis=1))))  # rad per readout
        smoothly = np.mean(np.sum(beside[1:] * beside[:-1], axis=1)) > _SMOOTHLY * turned**2
        return turned / self._camera.readout_time if smoothly and turned > _TAKEN_OUT else 0.0

    def _name_stabilizer(self, rate: float) -> None:
        """Name images that are turned as wholes: no shutter turns them as they are."""
        self.kind, self.fault = "", ""
        if rate == 0.0 or len(self._beside) < _LEAST:
            return
        self.kind = "stabilized"
        self.fault = (
            f"rows show rotations that differ by {math.degrees(rate):.0f} deg/s (rms) from those "
            "between images, which no shutter does: is the film stabilized? Poses are those of the "
            "picture that it shows; switch stabilization off (a camera that vibrates at the image "
            "rate looks the same)"
        )

    def _along(self, axis: int) -> MeasuredReadout:
        """Return the readout time along an axis, if the shutter moves along it."""
        other, spread = 1 - axis, self._covariance[:2, :2]
        gain = spread[axis, other] / spread[other, other]
        value = float(self._mean[axis] - gain * self._mean[other])
        deviation = math.sqrt(spread[axis, axis] - gain * spread[axis, other])
        ways, beside = self._of_ways
        short = abs(beside / ways * value) if ways else 0.0
        return MeasuredReadout(value, deviation, short)

    def _far(self, over_rows: float, over_columns: float) -> float:
        """Return half the squared distance of a shutter from the prior."""
        off = self._mean[:2] - (over_rows, over_columns)
        return 0.5 * float(off @ np.linalg.solve(self._covariance[:2, :2], off))

    def _judge(self, usual: float) -> None:
        """Judge whether readout time, direction or axis are contradicted."""
        measured, across = self._along(0), self._along(1)
        far = self._mean[:2] ** 2 / np.diag(self._covariance)[:2]
        odds = 0.5 * float(far[1] - far[0])  # of the other axis; a global shutter has both
        sideways = self._far(0.0, math.copysign(usual, across.readout_time))
        doubtful = self._far(usual, 0.0) - sideways > _SUSPICIOUS
        doubtful &= self._far(0.0, 0.0) - sideways > -_SUSPICIOUS
        self.refusal, self._across = "", doubtful or odds > _SUSPICIOUS
        is_certain = odds > _CERTAIN and len(self._beside) >= _SOME
        if is_certain or (self.kind == "axis" and odds > 0.0):
            direction = ACROSS[self._direction]
            direction = direction if across.readout_time > 0.0 else REVERSED[direction]
            self.kind = "axis"
            self.fault = self.refusal = (
                f"the image shows a shutter that moves {direction} in {across}, not "
                f"{self._direction}; no poses are published until scan_direction is {direction}"
            )
        if self.refusal or self._across:
            self.trusted = False
            return
        self.measured = measured if measured.deviation < usual else None
        self.kind = self._name(measured, usual)
        wrong, found = bool(self.kind), measured.readout_time
        of_global, of_reversed = (measured.odds(value, usual) for value in (0.0, -usual))
        shorter = usual / max(abs(found), _GLOBAL * usual, measured.deviation)
        off = math.hypot(found - usual, measured.deviation)
        self.error = off * max(shorter, 1.0) if wrong else 0.0
        self.is_global = self.kind == "global"
        self._reversed = self.kind == "reversed" or of_reversed > _SUSPICIOUS
        doubt = max(of_global, of_reversed)
        if (wrong and found < FAR_OFF * usual) or doubt > _SUSPICIOUS:
            self.trusted = False
        elif doubt < _SHOWN:
            self.trusted = True

    def _name(self, measured: MeasuredReadout, usual: float) -> str:
        """Describe the fault of the set readout time and return its kind, if it has one."""
        self.fault, found, direction = "", measured.readout_time, self._direction
        if not measured.contradicts(usual):
            return ""
        if found < -_SURELY * measured.deviation:
            self.fault = f"the shutter moves against scan_direction {direction}, in {measured}: is "
            self.fault += f"it {REVERSED[direction]}?"
            return "reversed"
        if found < -_GLOBAL * usual:  # one of both
            return ""
        kind, named = (
            ("global", " (a global shutter)") if found < _GLOBAL * usual else ("duration", "")
        )
        self.fault = f"estimated readout time {measured}{named} differs from readout_time = "
        self.fault += f"{1e3 * usual:g} ms"
        return kind


def _vibrates(found: Estimate) -> bool:
    """Return whether a vibration within an image shows."""
    if not found.aided:
        return len(found.shake) > 0
    return bool(roughness(found) > _ROUGH * np.linalg.norm(found.angular_velocity))
