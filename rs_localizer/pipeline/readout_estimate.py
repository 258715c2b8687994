# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The readout time from neighbouring frames, one number that each of them moves a little.

One image shows how far the camera turns and travels during its readout; the poses of the frames
before and after it show how fast it does. The ratio is the readout time, negative where the
shutter runs against the direction that was assumed. Of each frame and its two neighbours,

    y = T x + noise,    y: mean motion per readout (Simpson's rule), x: way between the outer
                        poses by time,

both in the camera's axes, angular and linear (6). Errors of map and lens look like velocities, but
are alike in neighbouring frames: both sides count by how they change. Both are noisy and their
noise belongs together, so that plain least squares would be biased, to anything at rest: the
way is freed of what its noise shares with that of ``y - T x``, and shrunk towards rest where it is
only noise (the conditional score: Stefanski, Carroll, "Conditional scores and optimal scores for
generalized linear measurement-error models", 1987). The terms ``b - T a`` of that equation are
summed with a fading memory, and so are their products with those of the last triples: the
deviation comes from the scatter of the terms, not from the covariances.

Each frame counts with what its image alone says: the estimate of a tracked frame believes in the
readout time that the tracker was given.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.rig import Exposure, Rig
from rs_localizer.core.shutter import Motion
from rs_localizer.core.state import MOTION_PARAMETERS, VELOCITIES
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.observations import lines_about

_SIDE = 6  # numbers of each side of an equation: angular and linear
_MOST_POINTS = 200  # of a frame: more take longer than they are worth
# Directions that the image does not see: least eigenvalue of the information, diagonal scaled to 1.
_LEAST_EIGENVALUE = 1e-9
_LEAST_NOISE = 1e-4  # px
# A step in directions that the image hardly sees would leave the range of the linear model: the
# velocities stay within about this (rad, m per readout) of the given ones.
_HELD = np.repeat([0.0, 0.0, 0.05**-2, 0.05**-2], 3)
# Neighbours farther away (s), or of intervals less alike than this, say little.
_LONGEST_INTERVAL, _MOST_UNLIKE = 0.15, 2.5
# What no camera does between its frames (rad/s^2, m/s^2): it is elsewhere all at once, as in
# recordings that were cut. So many deviations of noise beside that.
_JUMP, _JUMP_NOISE = np.repeat([75.0, 40.0], 3), 5.0
# Of the sums, what is left one triple later: five seconds at 30 Hz.
_MEMORY = 1.0 - 1.0 / 150.0
# Share of the newest in the running means: of a real global shutter before tags with errors of the
# map, means of 20 triples leave -7 +- 4 ms after 40, of eight -2 +- 2; with four, slow motion of a
# real webcam says nothing, with eight 13.8 +- 1.7 ms (12.9 +- 1.1 by ``calibrate``).
_MEAN = 0.13
# Errors of neighbouring triples, which share frames and what the map has wrong, belong together.
_TOGETHER = 0.8
# What a camera may do (rad/s, m/s), squared: where the way is less certain than this, it says less.
_MOTION = np.diag(np.square([1.0, 1.0, 1.0, 0.5, 0.5, 0.5]))
# Squared length beyond which a triple counts less: 95 % of six degrees of freedom. What is usual is
# learned from a twentieth of each, of no more than four times as much.
_HUBER, _LEARNING, _MOST_UNUSUAL = 12.6, 0.05, 4.0
# Covariances of frames may be wrong by this share; so is the correction for noise at slow motion.
_COVARIANCE_ERROR = 0.5
_MODEL_ERROR = 0.005  # of Simpson's rule and of constant velocities in a frame
_LONGEST = 0.2  # s
# Contradicted is a value that chance puts so far away as seldom as four deviations of a Gaussian,
# one-sided, and that is off by more than this share.
_CHANCE, _LEAST_DIFFERENCE = 3.2e-5, 0.06
_LAGS = 6  # triples that share frames, and errors of the map
# Of Student's quantile: the last term of its series is less than exp(-36). Each round is ten times
# nearer. So many terms are enough for 10,000 degrees of freedom.
_DIGITS, _ROUNDS, _MOST_TERMS = 36.0, 10, 20_000


def student_quantile(freedom: float, chance: float) -> float:
    """Number that Student's t exceeds with this small chance; infinite where there is none.

    With ``x = f / (f + t^2)`` and ``a = f / 2`` the chance is ``x^a S(x) / (2 a B(a, 1/2))``
    (Abramowitz, Stegun, 26.5.4 and 26.7.1). The power series S changes little with x, so x is found
    by putting it into S again and again, from ``S = 1``.
    """
    if not freedom > 0.0:
        return math.inf
    a = 0.5 * freedom
    log_beta = math.lgamma(a) + math.lgamma(0.5) - math.lgamma(a + 0.5)
    first = log_x = (math.log(2.0 * chance * a) + log_beta) / a
    n = np.arange(1.0, min(_MOST_TERMS, math.ceil(_DIGITS / -first)))  # S is least accurate there
    series = np.cumprod((n - 0.5) / n) * a / (a + n)
    for _ in range(_ROUNDS):
        log_x = first - math.log1p(float(series @ np.exp(log_x * n))) / a
    with np.errstate(over="ignore"):
        return float(np.sqrt(freedom * np.expm1(-log_x)))


@dataclass(frozen=True, slots=True)
class MeasuredReadout:
    """A readout time that the frames of the last seconds show."""

    readout_time: float  # s; negative: against the scan direction that was assumed
    deviation: float  # s
    triples: int  # frames with two neighbours
    telling: float  # effective number of them: those of one jolt alone make about 2
    misfit: float = 1.0  # squared errors, in variances of their noise

    def contradicts(self, readout_time: float) -> bool:
        """True if this readout time (s, of the assumed direction) must be wrong."""
        off = abs(self.readout_time - readout_time)
        largest = max(abs(self.readout_time), readout_time)
        if off <= _LEAST_DIFFERENCE * largest:
            return False
        return off > student_quantile(self._freedom, _CHANCE) * self.deviation

    def odds(self, one: float, other: float) -> float:
        """Logarithm of the odds for one readout time (s) against another."""
        left = [((value - self.readout_time) / self.deviation) ** 2 for value in (one, other)]
        ratio = (self._freedom + left[1]) / (self._freedom + left[0])
        return 0.5 * (self._freedom + 1.0) * math.log(ratio)

    @property
    def _freedom(self) -> float:
        """Degrees of freedom: of few triples the deviation itself is uncertain (Student's t)."""
        return min(self.triples, 4.0 * self.telling) / _LAGS

    @property
    def relative_deviation(self) -> float:
        """Deviation by value."""
        return self.deviation / max(abs(self.readout_time), 1e-12)


class ImageMotion(NamedTuple):
    """One frame by its image alone."""

    rotation: Array  # (3,3) map_from_camera
    position: Array  # (3,)
    motion: Array  # (6,) angular and linear per readout
    covariance: Array  # (12,12)


class Equation(NamedTuple):
    """A triple ``y = T x`` and the covariances of both sides."""

    x: Array  # (6,)
    y: Array  # (6,)
    xx: Array  # (6,6)
    yx: Array  # (6,6)
    yy: Array  # (6,6)


class ReadoutEstimate:
    """The readout time by the last seconds of frames, which come in order."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._views: deque[tuple[int, ImageMotion]] = deque(maxlen=3)
        self._before: Equation | None = None
        self._means = np.zeros((2, _SIDE))  # of x and y
        self._sums, self._last = np.zeros(2), np.zeros(2)  # of (b, a), and of the last few
        self._squares = np.zeros((2, 2))  # of sums of (b, a) over triples that belong together
        self._noise = self._ways = 0.0
        self._triples = 0
        self._usual = float(_SIDE)  # squared length of an error

    def add(
        self, time_ns: int, camera: Camera, estimate: Estimate, points: Array, pixels: Array
    ) -> None:
        """Take a frame whose middle row was exposed at ``time_ns``.

        Args:
            camera: its lens and scan direction count; its readout time does not.
            estimate: of this frame, tracked or not.
            points, pixels: (n,3) and (n,2) as they were localized.
        """
        if self._views and time_ns <= self._views[-1][0]:
            self.reset()
        seen = view(camera, estimate, points, pixels)
        if seen is None:
            self._views.clear()
            self._before = None
            return
        self._views.append((time_ns, seen))
        if len(self._views) < 3:
            return
        (before_ns, before), (now_ns, now), (after_ns, after) = self._views
        first, second = (now_ns - before_ns) * 1e-9, (after_ns - now_ns) * 1e-9
        alike = 1.0 / _MOST_UNLIKE < first / second < _MOST_UNLIKE
        near = max(first, second) <= _LONGEST_INTERVAL
        if alike and near:
            self.take(equation(before, now, after, first, second), second)

    def take(self, of: Equation, seconds: float) -> None:
        """Take a triple, so many seconds after the last one."""
        before, self._before = self._before, of
        if before is None:
            self._means = np.array([of.x, of.y])
            return
        deviations = np.sqrt(of.xx.diagonal() + before.xx.diagonal())
        if np.any(np.abs(of.x - before.x) > seconds * _JUMP + _JUMP_NOISE * deviations):
            self._before = None
            self._views.clear()
            return
        self._triples += 1
        x, y = np.array([of.x, of.y]) - self._means
        self._means += max(1.0 / (self._triples + 1.0), _MEAN) * np.array([x, y])
        try:
            term, slope, noise, own = self._score(of._replace(x=x, y=y))
        except np.linalg.LinAlgError:  # a frame without a covariance
            return
        new = np.array([term + self._value * slope, slope])
        beside = _TOGETHER * self._last
        self._last = beside + new
        cross = np.outer(new, beside)
        self._squares = _MEMORY * self._squares + np.outer(new, new) + cross + cross.T
        self._sums = _MEMORY * self._sums + new
        self._noise = _MEMORY * self._noise + noise
        self._ways = _MEMORY * self._ways + own * own

    @property
    def _determined(self) -> bool:
        """True if the motion is more than its noise."""
        return bool(self._sums[1] > max(self._noise, 1.0))

    @property
    def _value(self) -> float:
        """s, at which the equations are weighed."""
        value = self._sums[0] / self._sums[1] if self._determined else 0.0
        return min(max(float(value), -_LONGEST), _LONGEST)

    def _score(self, of: Equation) -> tuple[float, float, float, float]:
        """A term, its slope less the noise's part, that, and the slope; see the module."""
        value = self._value
        weights = np.linalg.inv(of.yy - value * (of.yx + of.yx.T) + value**2 * of.xx)
        error = of.y - value * of.x
        squared = float(error @ weights @ error)
        limit = _MOST_UNUSUAL * self._usual
        self._usual += _LEARNING * (min(squared, limit) - self._usual)
        scale = max(1.0, self._usual / _SIDE)
        robust = min(1.0, math.sqrt(_HUBER * scale / max(squared, 1e-12))) / scale
        shared = of.yx.T - value * of.xx
        gain = shared @ weights
        left = of.xx - gain @ shared.T
        shrink = _MOTION @ np.linalg.inv(_MOTION + left)
        pulled = robust * weights @ (shrink @ (of.x - gain @ error))
        noise, own = robust * float(np.trace(weights @ shrink @ left)), float(pulled @ of.x)
        return float(pulled @ error), own - noise, noise, own

    @property
    def measured(self) -> MeasuredReadout | None:
        """The readout time by the frames; None as long as the motion determines nothing."""
        if not self._determined:
            return None
        b, a = self._sums
        value, left = float(b / a), np.array([1.0, -b / a])
        scatter = float(left @ self._squares @ left) / a**2
        systematic = (_COVARIANCE_ERROR * self._noise / a) ** 2 + _MODEL_ERROR**2
        deviation = math.sqrt(max(scatter, 1.0 / a) + value**2 * systematic)
        telling = float(a + self._noise) ** 2 / max(self._ways, 1e-300)
        return MeasuredReadout(value, deviation, self._triples, telling, self._usual / _SIDE)


def view(camera: Camera, estimate: Estimate, points: Array, pixels: Array) -> ImageMotion | None:
    """A frame by its image alone: one Gauss-Newton step of constant velocities on its inliers.

    None where they are too few.
    """
    chosen = np.flatnonzero(estimate.inliers)
    chosen = chosen[:: 1 + len(chosen) // _MOST_POINTS]
    if len(chosen) <= MOTION_PARAMETERS:
        return None
    # Without accelerations and shaking: what a prior has wrong about the velocities, they mend.
    steady = Motion(
        estimate.rotation, estimate.translation, estimate.angular_velocity, estimate.linear_velocity
    )
    lines = lines_about(_exposure(camera), points[chosen], pixels[chosen], steady)
    errors = lines.errors.ravel()
    rows = lines.by_motion[:, :, :MOTION_PARAMETERS].reshape(-1, MOTION_PARAMETERS)
    if len(errors) <= 2 * MOTION_PARAMETERS:
        return None
    variance = max(float(errors @ errors) / (len(errors) - MOTION_PARAMETERS), _LEAST_NOISE**2)
    information = rows.T @ rows
    scale = 1.0 / np.sqrt(np.maximum(information.diagonal(), 1e-300))
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    basis = scale[:, None] * vectors
    free = variance * (basis / np.maximum(values, _LEAST_EIGENVALUE)) @ basis.T
    held = np.linalg.inv(np.asarray(information + np.diag(variance * _HELD), np.float64))
    step = -held @ (rows.T @ errors)
    # Poses scatter as little as that makes them; what it says of velocities is not the image's.
    covariance: Array = variance * held
    covariance[VELOCITIES, VELOCITIES] = free[VELOCITIES, VELOCITIES]
    back = estimate.rotation.T
    return ImageMotion(
        back @ so3.exp(step[:3]),
        estimate.position + back @ step[3:6],
        np.concatenate([steady.angular_velocity, steady.linear_velocity]) + step[6:],
        covariance,
    )


@lru_cache(4)
def _exposure(camera: Camera) -> Exposure:
    return Rig.of(camera).exposure().ahead()


def equation(
    before: ImageMotion, now: ImageMotion, after: ImageMotion, first: float, second: float
) -> Equation:
    """The equation of three views; ``first``, ``second``: s from one to the next."""
    span = first + second
    # Integral of the parabola through three values (Simpson's rule for unlike intervals).
    shares = (2.0 - second / first, span * span / (first * second), 2.0 - first / second)
    back = now.rotation.T
    turned = so3.log(before.rotation.T @ now.rotation) + so3.log(back @ after.rotation)
    x = np.concatenate([turned, back @ (after.position - before.position)]) / span
    y, both = np.zeros(_SIDE), np.zeros((2 * _SIDE, 2 * _SIDE))
    for each, part, pace in zip((before, now, after), shares, (-1.0, 0.0, 1.0), strict=True):
        axes = np.eye(2 * _SIDE)  # now from then; turns add up in the camera's own axes
        axes[3:6, 3:6] = axes[9:, 9:] = back @ each.rotation
        share = part / 6.0
        y += share * (axes[_SIDE:, _SIDE:] @ each.motion)
        lift = np.repeat([pace / span, share], _SIDE)[:, None] * axes
        both += lift @ each.covariance @ lift.T
    return Equation(x, y, both[:_SIDE, :_SIDE], both[_SIDE:, :_SIDE], both[_SIDE:, _SIDE:])
