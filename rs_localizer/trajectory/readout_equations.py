# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The estimating equation of the readout time over many triples of frames, compiled.

Names and symbols are those of :mod:`rs_localizer.trajectory.online_readout`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from rs_localizer.core.arrays import Array
from rs_localizer.core.blocks import median, write
from rs_localizer.core.rate_spline import multiplied
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.so3 import log
from rs_localizer.estimation.refine import inverted

_LAGS = 6  # neighbouring triples share frames, and errors of the map
_ROUNDS, _SETTLED = 12, 1e-4
# Covariances of frames may be wrong by this share; so is the correction for noise at slow motion.
_COVARIANCE_ERROR = 0.5
_MODEL_ERROR = 0.005  # of Simpson's rule and of constant velocities in a frame
# Contradicted is a value that chance puts so far away as seldom as four deviations of a Gaussian,
# one-sided, and that is off by more than this share.
_CHANCE, _LEAST_DIFFERENCE = 3.2e-5, 0.06


@dataclass(frozen=True, slots=True)
class MeasuredReadout:
    """A readout time that the frames of the last seconds show."""

    readout_time: float  # s; negative: against the scan direction that was assumed
    deviation: float  # s
    triples: int  # frames with two neighbours
    telling: float  # effective number of them: those of one jolt alone make about 2

    def contradicts(self, readout_time: float) -> bool:
        """Whether this readout time (s, of the assumed direction) must be wrong."""
        off = abs(self.readout_time - readout_time)
        largest = max(abs(self.readout_time), readout_time)
        # Of few triples the deviation itself is uncertain: Student's t.
        deviations = float(stdtrit(min(self.triples, 4.0 * self.telling) / _LAGS, 1.0 - _CHANCE))
        return off > max(deviations * self.deviation, _LEAST_DIFFERENCE * largest)

    @property
    def relative_deviation(self) -> float:
        """Deviation by value."""
        return self.deviation / max(abs(self.readout_time), 1e-12)


class Measurement:
    """Finds the readout time that some equations show, in rounds that may be taken one by one."""

    def __init__(self, of: Equations) -> None:
        self._of = of
        self._value, self._step, self._rounds = 0.0, math.inf, 0
        self.done = False
        self.found: MeasuredReadout | None = None  # None: the motion is not more than its noise

    def advance(self, triples: int) -> None:
        """Compute one round, or as many as look at so many triples together.

        Raises:
            LinAlgError: a frame has no covariance.
        """
        for _ in range(max(triples // len(self._of.x), 1)):
            if not self.done:
                self._next_round()

    def finish(self) -> MeasuredReadout | None:
        """Compute all that is left; raises as :meth:`advance`."""
        while not self.done:
            self._next_round()
        return self.found

    def _next_round(self) -> None:
        now: Score = score(self._of, self._value)
        if math.isnan(now.slope):
            raise np.linalg.LinAlgError("the covariance of a frame is none")
        if abs(self._step) < _SETTLED * abs(self._value) or self._rounds == _ROUNDS:
            self.found, self.done = _measured(now, self._value), True
        elif not now.slope > max(now.noise, 1.0):
            self.done = True
        else:
            self._step = float(np.sum(now.terms)) / now.slope
            self._value += self._step
            self._rounds += 1


def _measured(at: Score, value: float) -> MeasuredReadout:
    """The value with its deviation, from the equation there."""
    variance = float(at.terms @ at.terms)
    for lag in range(1, _LAGS):
        share = 2.0 * (1.0 - lag / _LAGS)
        variance += share * float(at.terms[lag:] @ at.terms[:-lag])
    systematic = _COVARIANCE_ERROR * at.noise / at.slope
    deviation = math.sqrt(
        max(variance / at.slope**2, 1.0 / at.slope) + value**2 * (systematic**2 + _MODEL_ERROR**2)
    )
    return MeasuredReadout(value, deviation, len(at.terms), at.telling)


SIDE = 6
"""Numbers of each side of an equation: angular and linear."""
# What a camera may do (rad/s, m/s), squared: where the way is less certain than this, it says less.
_MOTION = np.square([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
_HUBER = 12.6  # squared length beyond which a triple counts less: 95 % of six degrees of freedom
_MEDIAN = 5.35  # median of chi-squared of six degrees of freedom

# What no camera does between its frames (rad/s^2, m/s^2): it is elsewhere all at once, as in
# recordings that were cut. So many deviations of noise beside that.
_JUMP = (75.0, 40.0)
_NOISE = 5.0


class View(NamedTuple):
    """One frame."""

    rotation: Array  # (3,3) map_from_camera
    position: Array  # (3,)
    motion: Array  # (6,) angular and linear per readout, of the image alone
    covariance: Array  # (12,12) of the image alone


class Equations(NamedTuple):
    """Triples ``y = T x``, stacked, and the covariances of both sides."""

    x: Array  # (n,6)
    y: Array  # (n,6)
    xx: Array  # (n,6,6)
    yx: Array  # (n,6,6)
    yy: Array  # (n,6,6)


class Score(NamedTuple):
    """The estimating equation at one readout time."""

    terms: Array  # (n,) of which the sum is zero at the solution
    slope: float  # of the sum, without the part of the noise; negated
    noise: float  # part of the noise that was taken away
    telling: float  # effective number of triples: one that says all makes 1


@kernel
def score(of: Equations, value: float) -> Score:
    """``sum of x*^T W (y - T x)``, where ``x*`` is the best estimate of the displacement.

    What its noise shares with that of ``y - T x`` is removed, so that both are independent, and it
    is shrunk towards rest where it is only noise.

    NaN where a covariance is none.
    """
    count = len(of.x)
    terms, error, squared = np.zeros(count), np.empty((count, SIDE)), np.zeros(count)
    weights = np.empty((count, SIDE, SIDE))
    spread = np.empty((SIDE, SIDE))
    for n in range(count):
        for i in range(SIDE):
            error[n, i] = of.y[n, i] - value * of.x[n, i]
            for j in range(SIDE):
                both = of.yx[n, i, j] + of.yx[n, j, i]
                spread[i, j] = of.yy[n, i, j] - value * both + value * value * of.xx[n, i, j]
        write(weights[n], inverted(spread))
        for i in range(SIDE):
            for j in range(SIDE):
                squared[n] += error[n, i] * weights[n, i, j] * error[n, j]
    scale = max(1.0, median(squared) / _MEDIAN)
    slope, noise, squares = 0.0, 0.0, 0.0
    covariance, displacement = np.empty((SIDE, SIDE)), np.empty(SIDE)
    for n in range(count):
        robust = min(1.0, np.sqrt(_HUBER * scale / max(squared[n], 1e-12))) / scale
        shrink = _decorrelate(of, n, value, weights[n], error[n], displacement, covariance)
        own = 0.0
        for i in range(SIDE):
            likely = 0.0
            for j in range(SIDE):
                likely += shrink[i, j] * displacement[j]
            for j in range(SIDE):
                pulled = robust * weights[n, j, i] * likely
                terms[n] += pulled * error[n, j]
                own += pulled * of.x[n, j]
                through = 0.0
                for k in range(SIDE):
                    through += shrink[i, k] * covariance[k, j]
                noise += robust * weights[n, j, i] * through
        slope += own
        squares += own * own
    return Score(terms, slope - noise, noise, slope * slope / max(squares, 1e-300))


@kernel
def _decorrelate(
    of: Equations,
    n: int,
    value: float,
    weight: Array,
    error: Array,
    displacement: Array,
    covariance: Array,
) -> Array:
    """Write displacement (6,) and covariance (6,6) of ``x`` without the noise of the error (6,).

    The error's inverse covariance is weight (6,6); return the matrix (6,6) that shrinks the
    displacement towards rest.
    """
    shared, gain = np.empty((SIDE, SIDE)), np.empty((SIDE, SIDE))
    for i in range(SIDE):
        for j in range(SIDE):
            shared[i, j] = of.yx[n, j, i] - value * of.xx[n, i, j]
    for i in range(SIDE):
        displacement[i] = of.x[n, i]
        for j in range(SIDE):
            gain[i, j] = 0.0
            for k in range(SIDE):
                gain[i, j] += shared[i, k] * weight[k, j]
            displacement[i] -= gain[i, j] * error[j]
    spread = np.empty((SIDE, SIDE))
    for i in range(SIDE):
        for j in range(SIDE):
            covariance[i, j] = of.xx[n, i, j]
            for k in range(SIDE):
                covariance[i, j] -= gain[i, k] * shared[j, k]
            spread[i, j] = covariance[i, j]
        spread[i, i] += _MOTION[i]
    shrink = inverted(spread)
    for i in range(SIDE):
        for j in range(SIDE):
            shrink[i, j] *= _MOTION[i]
    return shrink


@kernel
def equation(
    before: View, now: View, after: View, first: float, second: float, of: Equations, place: int
) -> None:
    """Write the equation of a triple to its place.

    Args:
        first, second: s from the first view to the second one and on to the third.
    """
    span = first + second
    # Integral of the parabola through three values (Simpson's rule for unlike intervals).
    shares = (2.0 - second / first, span * span / (first * second), 2.0 - first / second)
    back = now.rotation.T.copy()
    onward = log(multiplied(before.rotation.T.copy(), now.rotation))
    further = log(multiplied(back, after.rotation))
    for i in range(3):
        displacement = 0.0
        for j in range(3):
            displacement += back[i, j] * (after.position[j] - before.position[j])
        of.x[place, i], of.x[place, 3 + i] = (onward[i] + further[i]) / span, displacement / span
    of.y[place], of.xx[place], of.yx[place], of.yy[place] = 0.0, 0.0, 0.0, 0.0
    views = (before, now, after)
    for k in range(3):
        axes = np.eye(2 * SIDE)  # now from then; turns add up in the camera's own axes
        moved = multiplied(back, views[k].rotation)
        for i in range(3):
            for j in range(3):
                axes[3 + i, 3 + j] = axes[9 + i, 9 + j] = moved[i, j]
        covariance = axes @ views[k].covariance @ axes.T
        share, pace = shares[k] / 6.0, (k - 1.0) / span
        for i in range(SIDE):
            for j in range(SIDE):
                of.y[place, i] += share * axes[i, j] * views[k].motion[j]
                of.xx[place, i, j] += pace * pace * covariance[i, j]
                of.yx[place, i, j] += pace * share * covariance[SIDE + i, j]
                of.yy[place, i, j] += share * share * covariance[SIDE + i, SIDE + j]


@kernel
def jumps(before: View, now: View, after: View, first: float, second: float) -> bool:
    """Whether three views are of no one way, whatever the shutter; as :func:`equation`."""
    back, on = np.ascontiguousarray(before.rotation.T), np.ascontiguousarray(now.rotation.T)
    turn = log(on @ after.rotation) / second - log(back @ now.rotation) / first
    displacement = (after.position - now.position) / second - (
        now.position - before.position
    ) / first
    views, paces = (before, now, after), (1.0 / first, 1.0 / first + 1.0 / second, 1.0 / second)
    for part in range(2):
        squared, noise = 0.0, 0.0
        for i in range(3):
            squared += displacement[i] * displacement[i] if part else turn[i] * turn[i]
            for k in range(3):
                noise += paces[k] * paces[k] * views[k].covariance[3 * part + i, 3 * part + i]
        if np.sqrt(squared) > 0.5 * (first + second) * _JUMP[part] + _NOISE * np.sqrt(noise):
            return True
    return False
