# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A watch that compares readout time, scan direction and axis with the camera's motion.

A parabola through the poses of three neighbours gives the velocity ``v`` of the middle frame; the
image shows how far the camera goes while rows, or columns, are read. Let the rows take the time
``T_r``, negative if they run against the direction that is set. Let the columns take ``T_c``:
drivers that rotate images turn the scan sideways. The points of a frame are then off by

    e = J d + J (tau_r w_r + tau_c w_c) + noise,    w_r = T_r (v + G s) + m_r,    w_c likewise

``J`` is the derivative by the pose, ``d`` the error of the pose, and ``m`` the effect of errors of
map and lens, which is alike in neighbouring frames. Drivers stamp images when they arrive: ``s``
are errors of the three stamps, and ``G`` is how these change the velocity. A Kalman filter
estimates ``T_r, T_c``, whose evidence fades, ``m``, which wander, and ``s``, which neighbours
share. As ``v`` contains ``s``, the filter is linearized about what it estimates: otherwise it
would find ``T`` too short. The right shutter is ``(T, 0)``, a global one ``(0, 0)``, a reversed one
``(-T, 0)``; off the first axis the shutter runs along the other one. A fault that is no shutter's
is a :mod:`.estimation.stabilizer`'s.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ACROSS, REVERSED, ScanDirection
from rs_localizer.core.state import (
    ANGULAR_ACCELERATION,
    MOTION_PARAMETERS,
    POSE,
    STATE_ANGULAR_ACCELERATION,
    TURN,
    VELOCITIES,
)
from rs_localizer.core.types import Estimate, Failure, altered, roughness
from rs_localizer.estimation.points import FrameSights
from rs_localizer.estimation.prior import state_in
from rs_localizer.estimation.projection import linearized
from rs_localizer.estimation.stabilizer import RowRotation, RowRotations
from rs_localizer.estimation.window import step_from
from rs_localizer.native import entry

# If the readout time is off by more than this share, single frames are better than tracked ones.
# The errors of a hand's angular velocity, tracked over single, are 0.95, 1.3 and 1.5 if it is off
# by a factor of 1.3, 1.5 and 1.7 (150 points, 0.3 px).
FAR_OFF = 0.5
_MOST_POINTS = 200  # of a frame: more points take longer than they are worth
# Points count within this many inlier thresholds, because the axis may be the wrong one.
_GATE = 3.0
# Deviations (rad, or shares of the depth) of the ways of usual cameras in one readout, which the
# points of one image hardly determine, and of those beside the estimate's, by which points are
# weighed: with 0.1 errors of a lens (a real board) count as another axis.
_USUAL_WAY, _BESIDE = 0.1, 0.01
_LEAST_NOISE, _ROUNDS = 0.1, 4  # px, no real error is smaller; rounds of robust weights
_OF_NORMAL = 0.455  # median of the squares of a normal distribution
# Neighbours that are farther away (s) tell little. Between closer ones, unsure stamps hide the way:
# at 100 Hz nothing was told within 4 s; by every second image, 20 ms are measured as 19.6 +- 1.2.
# The second is so small that of 30 Hz whose stamps jitter by 5 ms, one image in fifty is lost.
_LONGEST_INTERVAL, _CLOSEST = 0.15, 0.018
# Least squared velocity, over its variance: the noise of a slower one shortens T by a tenth.
_LEAST_MOTION = 60.0
# Standard deviation of T before anything is known, in readout times, and the share of the evidence
# that is left one frame later: a third after five seconds at 30 Hz.
_ANY, _MEMORY = 3.0, math.exp(-1.0 / 150.0)
# Errors of map and lens look like a motion by this many rad, or shares of the depth, per readout,
# and stay alike for a second. With this, tags before a real global shutter show 0.1 to 0.3 ms of
# 20.
_LIKE_MOTION, _ALIKE = 0.002, math.exp(-1.0 / 30.0)
# Deviation of a stamp (s), as of a real webcam, and the part of what the ways between neighbours
# are shorter by than the motion that is not known.
_OF_STAMP, _UNSURE = 0.005, 0.5
# Stronger wandering is learnt from a tenth of each innovation, of at most four times the expected
# one. A camera that vibrates between its frames moves otherwise within them, or shows a readout
# that is longer than the interval: 0.1 deg at 11 to 47 Hz make 2 to 600 times, or 60 ms; hands 1.3.
_LEARNING, _MOST_UNLIKELY, _SHAKEN = 0.1, 4.0, 1.5
# Rates that are known vibrate if this share of the angular velocity is no parabola of the rows.
_ROUGH = 0.1
# A shutter is contradicted beyond this many deviations, if it is also off by more than this share.
_SURELY, _LEAST_DIFFERENCE = 4.0, 0.06
# If the setting is known to this share, this many of this many frames are enough.
_WELL_KNOWN, _ON, _CYCLE = 0.05, 12, 36
# Below this share of the setting nothing tells the shutter from a global one.
_GLOBAL = 0.2
# Orientations widen by what a stabilizer turns in this time (s): a hand sways at 0.8 Hz.
# Before one is told from a longer readout time, they do so if rows show that by so many deviations.
_SWAY, _LONGER = 0.2, 3.0
# In the first frames by no more than this (rad): a stabilizer that crops a tenth of an image turns
# it by some 2 deg.
_CROPPED = 0.035
# Logarithms of the odds of another shutter at which it is doubted, no longer doubted (a robot that
# drives slowly shows neither) and certain, and of rest before a global shutter.
_SUSPICIOUS, _SHOWN, _CERTAIN, _AT_REST = 4.0, -2.0, 10.0, 20.7
# So many frames must show another axis: in one, a focal length that is off by 2 % looks like it.
_SOME = 2
# What the filter estimates: T over rows and over columns, their m, and the errors of three stamps.
_TIMES, _OTHERWISE, _STAMPS, _SIZES = slice(0, 2), slice(2, 14), slice(14, 17), (2, 12, 3)
_NEWER = np.r_[:14, 15, 16, 14]  # where those of the next stamps are
_BY_KNOWN = np.eye(12, sum(_SIZES), 2)  # derivatives of ways by m, and places for the others
# What the points of one frame tell: error of the pose, ways over rows and over columns, and how the
# rotation changes while rows are read.
_WAYS, _TOLD = slice(6, 18), 21
_OVER_COLUMNS, _ROTATIONS = np.r_[:6, 12:18], np.r_[:9, 18:21]
_OF_USUAL_WAYS, _OF_WAYS_BESIDE = (
    np.diag(np.repeat([0.0, deviation**-2], [6, 15])) for deviation in (_USUAL_WAY, _BESIDE)
)


@dataclass(frozen=True, slots=True)
class MeasuredReadout:
    """A readout time that the frames of the last seconds show."""

    readout_time: float  # s; negative: against the scan direction that was assumed
    deviation: float  # s

    def contradicts(self, readout_time: float) -> bool:
        """Return True if this readout time (s, of the assumed direction) must be wrong."""
        least = _LEAST_DIFFERENCE * max(abs(self.readout_time), readout_time)
        return abs(self.readout_time - readout_time) > max(_SURELY * self.deviation, least)

    def odds(self, one: float, other: float) -> float:
        """Return the logarithm of the odds for one readout time (s) against another."""
        far = [((value - self.readout_time) / self.deviation) ** 2 for value in (one, other)]
        return 0.5 * (far[1] - far[0])

    def __str__(self) -> str:
        return f"{1e3 * abs(self.readout_time):.1f} +- {1e3 * self.deviation:.1f} ms"


class _Look(NamedTuple):
    """The normal equations that the points of a frame give, linearized about its estimate."""

    time_ns: int
    found: Estimate
    units: Array  # (6,) rad and m, of a way
    information: Array  # (21,21)
    told: Array  # (21,)

    def fit(self, unknown: Array, known: Array, usual: bool = False) -> tuple[Array, Array]:
        """Return some unknowns (k,n), beyond what is ``known`` (k,21), and their covariance.

        ``usual``: ways are those of usual cameras.
        """
        information = self.information + usual * _OF_USUAL_WAYS
        covariance = np.linalg.inv(information[unknown[:, None], unknown])
        return (self.told - known @ self.information)[:, unknown] @ covariance, covariance

    def of_ways(self) -> tuple[Array, Array]:
        """Return the information (12,12) of the ways, and that times the ways (12,)."""
        across = np.linalg.solve(self.information[POSE, POSE], self.information[POSE, _WAYS]).T
        information = self.information[_WAYS, _WAYS] - across @ self.information[POSE, _WAYS]
        return information, self.told[_WAYS] - across @ self.told[POSE]


class _Way(NamedTuple):
    """The motion at a frame, by a parabola through it and its neighbours."""

    seconds: float  # from neighbour to neighbour
    speed: Array  # (6,) rad and units, per s
    change: Array  # (6,) and per s^2
    by_stamps: Array  # (3,6) the speed's, by errors of the three stamps
    noise: float  # of the speed, squared

    def jump(self, before: Array) -> Array:
        """Return the deviation (6,) of the speed of a motion that starts or stops somewhere here.

        The moment is unknown. Only the part of the change counts that ``before``, the change at the
        last frame, does not foresee.
        """
        return 0.5 * self.seconds / math.sqrt(12.0) * (self.change - before)

    @classmethod
    def through(cls, before: _Look, now: _Look, after: _Look) -> _Way | None:
        """Return the motion; None: noise may be all that there is."""
        others = before, after
        times = 1e-9 * np.array([look.time_ns - now.time_ns for look in others])
        ways = np.array([step_from(now.found, look.found)[POSE] for look in others])
        noise = before.found.joint_covariance[POSE, POSE] + after.found.joint_covariance[POSE, POSE]
        way = ways[1] - ways[0]
        try:
            moves = way @ np.linalg.solve(noise, way) > _LEAST_MOTION
        except np.linalg.LinAlgError:  # rounding errors are all that is left of a covariance
            return None
        if not moves:
            return None
        slopes = np.linalg.inv(np.column_stack([times, 0.5 * times**2]))
        speed, change = slopes @ (ways / now.units)
        # To the first order a pose with a stamp that is too late lies back on the parabola.
        by_stamps = np.array([
            slopes[0, 0] * (speed + times[0] * change),
            -slopes[0].sum() * speed - change,
            slopes[0, 1] * (speed + times[1] * change),
        ])  # fmt: skip
        seconds = float(times[1] - times[0])
        unsure = float(np.sum(noise.diagonal() / now.units**2)) / seconds**2
        return cls(seconds, speed, change, by_stamps, unsure)


class ShutterWatch:
    """Compares the configured shutter with the frames; see the module.

    Args:
        camera: as it is set; None: there is nothing to compare.
        threshold: px, of inliers.
    """

    def __init__(self, camera: Camera | None, threshold: float) -> None:
        self._gate, self._camera, self._usual = _GATE * threshold, camera, 0.0
        if camera is not None:
            self._usual = camera.readout_time  # s
            self._direction = ScanDirection(camera.scan_direction)
            self._sideways = replace(camera, scan_direction=ACROSS[self._direction])
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.measured: MeasuredReadout | None = None
        """Readout time that the last seconds of motion show along the set axis; None: none yet."""
        self.fault = self.kind = ""
        """How that contradicts the setting, in one sentence, and in one word."""
        self.error = 0.0
        """Error (s) of the set readout time, if the motion contradicts it; else 0."""
        self.trusted = True
        """Whether the way from frame to frame tells that within them: not in doubt, nor after one
        before frames show it. To and fro between both, poses jump."""
        self._doubted = ""  # which of both may be the other one, "axis" or "reversed"
        self._looks: deque[_Look] = deque(maxlen=3)
        self._seen: _Look | None = None  # the newest, also if it is too close to be compared
        self._rotations, self._frames = RowRotations(), 0
        # Squared speeds, and squared differences of speeds half an interval before and after
        self._speeds = np.zeros(2)
        self._any = np.repeat([_ANY * self._usual, _LIKE_MOTION, _OF_STAMP], _SIZES) ** 2
        self._mean, self._covariance = np.zeros(sum(_SIZES)), np.diag(self._any)
        self._unlike = 1.0  # by how much the square of what wanders is more than usual
        self._change = self._jump = np.zeros(6)  # of the last way

    @property
    def refusal(self) -> str:
        """Why no pose can be told: the shutter moves along the other axis."""
        return self.fault if self.kind == "axis" else ""

    @property
    def is_global(self) -> bool:
        """Whether all rows are exposed at once."""
        return self.kind == "global"

    @property
    def rows_turn(self) -> bool:
        """Whether rows rotate otherwise than images: of a stabilized film, or near their rate."""
        return self._rotations.are_smooth

    @property
    def of_rest(self) -> float:
        """Logarithm of the odds that what looks like motion within an image is none."""
        return _AT_REST if self.is_global else 0.0

    def widened(self, found: Estimate) -> Estimate:
        """Return the last frame with a covariance that allows for what the watch has found."""
        if self._camera is None:
            return found
        own = np.concatenate([found.angular_velocity, found.linear_velocity])
        sway = _SWAY * self._turned(float(np.linalg.norm(found.angular_velocity)))
        if self.error or sway:
            calibration = found.calibration_covariance.copy()
            calibration[TURN, TURN] += sway**2 * np.eye(3)
            longer = self.error / self._usual * own
            calibration[VELOCITIES, VELOCITIES] += np.outer(longer, longer)
            found = altered(found, calibration_covariance=calibration)
        if not self._doubted:
            return found
        steps, velocities = [np.r_[np.zeros(6), -2.0 * own]], np.r_[np.zeros(6), own]
        if self._doubted == "axis" and self._seen and self._seen.found.rotation is found.rotation:
            (sideways,), _ = self._seen.fit(_OVER_COLUMNS, np.zeros((1, _TOLD)), True)
            sideways *= np.tile(self._seen.units, 2)
            steps = [sideways * np.repeat([1.0, sign], 6) - velocities for sign in (1.0, -1.0)]
        joint = found.joint_covariance.copy()
        for step in steps:
            joint[:MOTION_PARAMETERS, :MOTION_PARAMETERS] += np.outer(step, step)
        return replace(found, joint_covariance=joint)

    def add(
        self, time_ns: int, found: Estimate | Failure, sights: FrameSights, *, jumped: bool = False
    ) -> None:
        """Take a frame whose middle row was exposed at ``time_ns``, as it was localized.

        ``jumped``: no camera goes there from the last frame. No motion within an image tells of
        such a way.
        """
        seen, usual = self.measured, self._usual
        known = seen is not None and seen.deviation < _WELL_KNOWN * usual
        if known and seen is not None:  # else it may be another
            known = seen.odds(usual, seen.readout_time) > _SHOWN
        known &= self.trusted and not self.kind and not self._rotations.is_likely
        self._frames += bool(found)
        may_rest = known and self._frames % _CYCLE >= _ON
        if not found or self._camera is None or may_rest:
            self._looks.clear()
            return
        if jumped or (self._looks and time_ns <= self._looks[-1].time_ns):
            self._looks.clear()
        is_close = bool(self._looks) and time_ns - self._looks[-1].time_ns < 1e9 * _CLOSEST
        if is_close and self._doubted != "axis":
            return
        self._seen = self._look(time_ns, found, sights)
        if is_close or self._seen is None:
            return
        self._looks.append(self._seen)
        # The first of the stamps goes, and the next is as uncertain as any.
        self._mean, self._covariance = self._mean[_NEWER], self._covariance[_NEWER[:, None], _NEWER]
        self._mean[-1], self._covariance[-1], self._covariance[:, -1] = 0.0, 0.0, 0.0
        self._covariance[-1, -1] = _OF_STAMP**2
        times = [look.time_ns for look in self._looks]
        if len(times) < 3 or max(np.diff(times)) > 1e9 * _LONGEST_INTERVAL:
            return
        if _vibrates(self._looks[1].found):  # and goes elsewhere there than between its images
            self._rotations = RowRotations()
            return
        way = _Way.through(*self._looks)
        if way is None:
            self._change = self._jump = np.zeros(6)
        else:
            jump = way.jump(self._change)
            # Between two images it is in the ways about both.
            widest = max(jump, self._jump, key=np.linalg.norm)
            self._change, self._jump = way.change, jump
            self._measure(self._looks[1], way, widest)
            self._judge(way.seconds)

    def _look(self, time_ns: int, found: Estimate, sights: FrameSights) -> _Look | None:
        """Return what the points of a frame tell; None if they are too few."""
        seen, own = sights.observations, sights.usable.indices
        if len(own) > _MOST_POINTS:
            some = np.arange(0, len(own), 1 + len(own) // _MOST_POINTS)
            seen, own = seen.only(some), own[some]
        state = state_in(found, sights.usable.centre)
        state[STATE_ANGULAR_ACCELERATION.start :] = 0.0
        lines = linearized(seen.packed, len(seen), state, np.zeros((len(seen), 6)))
        near = np.linalg.norm(lines.errors, axis=1) < self._gate  # NaN is not
        if np.count_nonzero(near) < 18:
            return None
        away = np.linalg.norm(sights.points[own[near]] - found.position, axis=1)
        # Of distances of two sizes a median is now one, now the other: what wanders would jump.
        units = np.repeat([1.0, 1.0 / float(np.mean(1.0 / away))], 3)
        by_pose = lines.by_motion[near, :, POSE] * units
        over_rows = lines.by_motion[near, :, VELOCITIES] * units
        over_columns = self._sideways.row_time(sights.pixels[own[near]])[:, None, None] * by_pose
        bent = lines.by_motion[near, :, ANGULAR_ACCELERATION]
        rows = np.concatenate([by_pose, over_rows, over_columns, bent], axis=2).reshape(-1, _TOLD)
        errors = lines.errors[near].ravel()
        speed = np.concatenate([found.angular_velocity, found.linear_velocity]) / units
        off = rows[:, 6:12] @ speed - errors
        return _Look(time_ns, found, units, *_robust(rows, off, errors))

    def _measure(self, now: _Look, way: _Way, jump: Array) -> None:
        """Add the evidence of a frame; ``jump`` (6,) is the deviation of its speed."""
        # The noise of poses looks like shaking, and is taken off. In the squared speed it is two
        # variances of a pose over the squared time, in the squared change, as it counts here, 24.
        changes = 0.25 * way.seconds**2 * way.change @ way.change - 12.0 * way.noise
        speeds = way.speed @ way.speed - way.noise
        self._speeds = _MEMORY * self._speeds + [speeds, changes]
        # What was known fades.
        spread = float(self._covariance[_TIMES, _TIMES].diagonal().max())
        fading = math.sqrt(min(1.0 / _MEMORY, self._any[0] / spread))
        lasting = np.repeat([fading, _ALIKE, 1.0], _SIZES)
        known, prior = self._covariance * np.outer(lasting, lasting), self._mean.copy()
        wanders = (1.0 - _ALIKE**2) * self._any[_OTHERWISE]
        known[_OTHERWISE, _OTHERWISE] += self._unlike * np.diag(wanders)
        prior[_OTHERWISE] *= _ALIKE
        (information, told), mean, by_known = now.of_ways(), prior, _BY_KNOWN.copy()
        for _ in range(2):
            speed, jumps = way.speed + mean[_STAMPS] @ way.by_stamps, np.zeros((12, 12))
            for axis, time in enumerate(mean[_TIMES]):
                ways = slice(6 * axis, 6 * axis + 6)
                by_known[ways, axis], by_known[ways, _STAMPS] = speed, time * way.by_stamps.T
                jumps[ways, ways] = (time**2 + known[axis, axis]) * np.outer(jump, jump)
            # To the first order about the mean.
            foreseen = by_known @ prior - by_known[:, _STAMPS] @ mean[_STAMPS]
            expected = by_known @ known @ by_known.T + jumps
            gain = known @ by_known.T @ np.linalg.inv(np.eye(12) + information @ expected)
            mean = prior + gain @ (told - information @ foreseen)
        left = known - gain @ (information @ (by_known @ known))
        self._mean, self._covariance = mean, 0.5 * (left + left.T)
        changed = (self._mean - prior)[_OTHERWISE] ** 2 / wanders
        more = min(float(np.mean(changed)), _MOST_UNLIKELY * self._unlike) - self._unlike
        self._unlike = max(self._unlike + _LEARNING * more, 1.0)
        self._compare_rotations(now, way, speed, jump[:3])

    def _compare_rotations(self, now: _Look, way: _Way, speed: Array, jump: Array) -> None:
        """Compare the rotation over the rows of a frame with that between frames."""
        moved = np.zeros((3, _TOLD))  # by nothing, over rows, and over columns
        moved[1, 6:12] = moved[2, 12:18] = self._usual * speed
        found, covariance = now.fit(_ROTATIONS, moved)
        still, rows, columns = found[:, 6:].reshape(3, 2, 3)
        wandering = self._unlike * (1.0 - _ALIKE**2) * _LIKE_MOTION**2
        wandering += (self._usual * self._shorter) ** 2 * float(speed[:3] @ speed[:3])
        by_stamps = self._usual * way.by_stamps[:, :3]
        jumps = self._usual**2 * np.outer(jump, jump)
        covariances = np.array([covariance[6:9, 6:9] + jumps, covariance[9:, 9:] + 12.0 * jumps])
        covariances[0] += by_stamps.T @ self._covariance[_STAMPS, _STAMPS] @ by_stamps
        covariances[0] += wandering * np.eye(3)
        by_shutter = np.stack([still - rows, still - columns], axis=2)
        turned = rows - [np.zeros(3), self._usual**2 * way.change[:3]]
        one = RowRotation(turned, covariances, by_shutter)
        self._rotations.add(one, 2.0 * self._usual / way.seconds)

    @property
    def _shorter(self) -> float:
        """By what part of itself the motion within frames is faster than the way between others.

        A hand's 1.5 Hz at ten images per second has 14 %.
        """
        speeds, changes = np.maximum(self._speeds, 0.0)
        return float(changes / (6.0 * speeds)) if speeds else 0.0

    def _turned(self, rate: float = 0.0) -> float:
        """Return the rate (rad/s, rms) at which images may be turned as wholes.

        ``rate``: rad per readout, of the camera. In the first frames, what looks like a longer
        readout time, or like rotations beside those between images, may be a stabilizer.
        """
        if self._doubted == "axis":
            return 0.0
        rotations, more = self._rotations, float(self._mean[0]) - self._usual
        is_longer = more > _LONGER * math.sqrt(self._covariance[0, 0])
        turned = rotations.most if is_longer and not self.kind else 0.0
        if rotations.is_likely:
            turned = rotations.rate
        if not (self.kind or rotations.are_enough):
            early = max(rotations.most, is_longer * more / self._usual * rate)
            turned = max(turned, min(early, _CROPPED / _SWAY * self._usual))
        return turned / self._usual

    def _along(self, axis: int) -> MeasuredReadout:
        """Return the readout time along an axis, if the shutter moves along it."""
        other, spread, shorter = 1 - axis, self._covariance[_TIMES, _TIMES], self._shorter
        gain = spread[axis, other] / spread[other, other]
        value = float(self._mean[axis] - gain * self._mean[other]) / (1.0 + shorter)
        deviation = math.sqrt(spread[axis, axis] - gain * spread[axis, other])
        return MeasuredReadout(value, math.hypot(deviation, _UNSURE * shorter * value))

    def _judge(self, seconds: float) -> None:
        """Judge what is contradicted; neighbours are so far apart."""
        vibrates = self._unlike >= _SHAKEN or self._rotations.vibrates
        if not vibrates and np.all(np.abs(self._mean[_TIMES]) < 0.55 * seconds):
            self._judge_shutter()
        elif self.kind in ("", "stabilized"):
            self.trusted, self._doubted = True, ""
        if self._rotations.is_certain and self.kind != "axis":
            self.kind, self.error = "stabilized", 0.0
            turned = math.degrees(self._turned())
            self.fault = (
                f"rows show rotations that differ by {turned:.0f} deg/s (rms) from those between "
                "images, which no shutter does: is the film stabilized? Poses are those of the "
                "picture that it shows; switch stabilization off"
            )
        elif self.kind == "stabilized":
            self.kind = self.fault = ""

    def _judge_shutter(self) -> None:
        """Judge whether axis, direction or readout time are contradicted."""
        far = self._mean[_TIMES] ** 2 / self._covariance[_TIMES, _TIMES].diagonal()
        odds = 0.5 * float(far[1] - far[0])  # of the other axis; a global shutter has both
        if odds > _SUSPICIOUS or (self.kind == "axis" and odds > 0.0):
            self.trusted, self._doubted = False, "axis"
            if self.kind == "axis" or (odds > _CERTAIN and len(self._rotations) >= _SOME):
                self.kind, self.fault = "axis", self._fault_of_axis()
            return
        measured, usual = self._along(0), self._usual
        found, self.measured = measured.readout_time, None
        if measured.deviation < usual:
            self.measured = measured
        self.kind, self.fault = self._fault_of_time(measured)
        shorter = usual / max(abs(found), _GLOBAL * usual, measured.deviation)
        off = math.hypot(found - usual, measured.deviation)
        self.error = off * max(shorter, 1.0) if self.kind else 0.0
        of_global, of_reversed = (measured.odds(value, usual) for value in (0.0, -usual))
        is_reversed = self.kind == "reversed" or of_reversed > _SUSPICIOUS
        self._doubted, doubt = "reversed" if is_reversed else "", max(of_global, of_reversed)
        if (self.kind and found < FAR_OFF * usual) or doubt > _SUSPICIOUS:
            self.trusted = False
        elif doubt < _SHOWN:
            self.trusted = True

    def _fault_of_axis(self) -> str:
        across, direction = self._along(1), ACROSS[self._direction]
        direction = direction if across.readout_time > 0.0 else REVERSED[direction]
        return (
            f"the image shows a shutter that moves {direction} in {across}, not "
            f"{self._direction}; no poses are published until scan_direction is {direction}"
        )

    def _fault_of_time(self, measured: MeasuredReadout) -> tuple[str, str]:
        """Return the kind of the fault of the set readout time, and a sentence; empty: none."""
        found, usual, direction = measured.readout_time, self._usual, self._direction
        if not measured.contradicts(usual):
            return "", ""
        if found < -_SURELY * measured.deviation:
            return "reversed", (
                f"the shutter moves against scan_direction {direction}, in {measured}: is it "
                f"{REVERSED[direction]}?"
            )
        # One of both; or vibration or a stop, which may look like it.
        if found < -_GLOBAL * usual or not (self.kind or self._rotations.are_enough):
            return "", ""
        kind, named = "duration", ""
        if found < _GLOBAL * usual:
            kind, named = "global", " (a global shutter)"
        return kind, (
            f"estimated readout time {measured}{named} differs from readout_time = "
            f"{1e3 * usual:g} ms"
        )


@entry
def _robust(rows: Array2, off: Array1, errors: Array1) -> tuple[Array, Array]:
    """Return information (21,21) and that times the numbers (21,) by which points are off.

    Args:
        rows: (2 n,21) px by the numbers.
        off: (2 n,) px.
        errors: (2 n,) px, with the estimate of the frame.
    """
    left, information, weighed, weights = errors, _OF_WAYS_BESIDE, rows, np.ones(len(rows))
    variance = np.median(errors**2) / _OF_NORMAL
    for k in range(_ROUNDS):
        if k > 0:
            known = information + _OF_WAYS_BESIDE
            left = errors - rows @ np.linalg.solve(known, errors @ weighed)
            variance = np.sum(weights * left**2) / np.sum(weights)
            variance *= len(left) / (len(left) - _TOLD)
        weights = 1.0 / (max(variance, _LEAST_NOISE**2) + left**2 / 9.0)
        weighed = rows * weights.reshape(-1, 1)
        information = weighed.T @ rows
    return information, off @ weighed


def _vibrates(found: Estimate) -> bool:
    """Return whether a vibration within an image shows."""
    if not len(found.shake):
        return False
    return bool(roughness(found) > _ROUGH * np.linalg.norm(found.angular_velocity))
