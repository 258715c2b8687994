# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Metres and gravity of a motion in units of its own, from an accelerometer that went along.

Mean accelerations (:mod:`rs_localizer.trajectory.metric`), divided by the scale s:

    seen = m forces + w gravity - axes bias - arms lever

is linear in m, gravity, bias and lever arm, each by s. The positions, which images know only so
well, stand alone on the left: noise in what a fit regresses on would make the scale too small.
``m`` is 1 / s but for what the accelerometer's own scale is off; the length of gravity says the
same of 1 / s.

The noise of neighbouring means hangs together: that of positions by their second differences, that
of accelerations (an orientation that is off turns gravity) by the overlap of the B-splines. How
much there is of both is told by the residuals, by restricted maximum likelihood (Patterson,
Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika 1971).

Accelerations of a motion that is known by its positions, beside what an accelerometer felt.

Nothing is differentiated. Positions averaged with a cardinal B-spline of degree k - 2, second
differences taken of the means a spacing apart, are exactly the accelerations averaged with the
B-spline of degree k (B_k'' is the second difference of B_{k-2}). The readings, turned into the
map's axes, are averaged with the latter: both sides are then the same number, and a linear
equation of scale, gravity, bias and lever arm. This is the weak form of p'' = a, with B-splines as
test functions; what it says at frequencies above the spacing's is nothing on both sides.

For a camera in units of the map at p, with an IMU at l (m) in the camera's axes, ``R`` the
camera's axes in the map and ``C`` the IMU's in the camera:

    s p'' + (R l)'' = R C (f - b) + g
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cholesky, solve_triangular, toeplitz
from scipy.special import chdtrc

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.inertial.gravity import STANDARD_GRAVITY
from rs_localizer.trajectory.spline import Layout, Spline

DEGREE = 5
"""Of the B-spline that accelerations are averaged with; positions with two less."""
_SUPPORT = DEGREE + 1  # spacings
# Positions are averaged over so many of them a spacing.
_STEPS = 20
# Without a sample for longer than this (s), or than so many usual steps, there is a gap.
_LONGEST_STEP, _MOST_STEPS = 0.02, 2.5
# So many means at once.
_MOST = 20


@dataclass(frozen=True, slots=True, eq=False)
class ForceSamples:
    """What an accelerometer measured."""

    times: Array  # (k,) s, of the spline
    forces: Array  # (k,3) m/s^2, specific force in its own axes; upwards at rest


@dataclass(frozen=True, slots=True, eq=False)
class Means:
    """Mean accelerations around n moments that follow each other."""

    spacing: float  # s
    times: Array  # (n,) s
    seen: Array  # (n,3) of the camera's centre, units of the map per s^2, along its axes
    forces: Array  # (n,3) m/s^2, likewise
    axes: Array  # (n,3,3) of the IMU, in the map's: what a bias of the readings does
    arms: Array  # (n,3,3) second derivative of the camera's axes, 1/s^2
    weights: Array  # (n,) about 1: of what is the same all the time


def mean_accelerations(
    spline: Spline, samples: ForceSamples, camera_from_imu: Array, spacing: float
) -> list[Means]:
    """Means of all parts of a motion that samples cover without a gap.

    Args:
        camera_from_imu: (3,3).
        spacing: s, of the means; half the period of the quickest motion that counts.
    """
    means = []
    for start, end in _covered(spline.layout, samples.times):
        count = int((end - start) / spacing - _SUPPORT + 1.0 + 1e-9)
        for first in range(0, count, _MOST):
            numbers = np.arange(first, min(first + _MOST, count))
            times = np.asarray(start + spacing * (0.5 * _SUPPORT + numbers), np.float64)
            means.append(_means(spline, samples, camera_from_imu, spacing, times))
    return means


def _covered(layout: Layout, times: Array) -> list[tuple[float, float]]:
    """Intervals (s) of stretches with samples without a gap."""
    if len(times) < 2:
        return []
    steps = np.diff(times)
    gaps = np.flatnonzero(steps > max(_LONGEST_STEP, _MOST_STEPS * float(np.median(steps))))
    pieces = [(part[0], part[-1]) for part in np.split(times, gaps + 1)]
    return [
        (max(start, first), min(end, last))
        for start, end in zip(layout.starts, layout.ends, strict=True)
        for first, last in pieces
        if max(start, first) < min(end, last)
    ]


def _means(
    spline: Spline, samples: ForceSamples, camera_from_imu: Array, spacing: float, times: Array
) -> Means:
    reach = 0.5 * _SUPPORT * spacing
    low, high = np.searchsorted(samples.times, [times[0] - reach, times[-1] + reach])
    near = slice(max(int(low) - 1, 0), int(high) + 1)
    at = samples.times[near]
    turns = spline.states(at).rotations @ camera_from_imu
    # Trapezoids; the B-spline is zero at both ends.
    weights = _kernel(DEGREE, (at - times[:, None]) / spacing) * np.gradient(at) / spacing
    # Positions are averaged at places that lie alike beside all means: second differences of what
    # rises evenly are zero, whatever the steps are.
    step = spacing / _STEPS
    dense = times[0] - reach + step * np.arange(_STEPS * (len(times) - 1 + _SUPPORT) + 1)
    states = spline.states(dense)
    middles = times[0] + spacing * np.arange(-1, len(times) + 1)
    average = _kernel(DEGREE - 2, (dense - middles[:, None]) / spacing) / _STEPS
    return Means(
        spacing,
        times,
        _second_differences(average @ states.positions, spacing),
        np.einsum("nk,kij,kj->ni", weights, turns, samples.forces[near], optimize=True),
        np.einsum("nk,kij->nij", weights, turns),
        _second_differences(np.einsum("nk,kij->nij", average, states.rotations), spacing),
        weights.sum(axis=1),
    )


def _kernel(degree: int, places: Array) -> Array:
    """The centred cardinal B-spline of a degree."""
    knots = np.arange(degree + 2) - 0.5 * (degree + 1)
    values = BSpline.basis_element(knots, extrapolate=False)(places)
    return np.nan_to_num(np.asarray(values, np.float64))


def _second_differences(values: Array, spacing: float) -> Array:
    return np.asarray((values[2:] - 2.0 * values[1:-1] + values[:-2]) / spacing**2)


# Unknowns: 1 / s as the forces say it, and gravity, bias, lever arm and 1 / s by s.
FORCE, GRAVITY, BIAS, LEVER, INVERSE = 0, slice(1, 4), slice(4, 7), slice(7, 10), 10
UNKNOWNS = 11


class Whitened:
    """Normal equations of means at a ratio of the variances of their two noises.

    Args:
        means: of all parts.
        kept: (n,) of each part, which count.
        ratio: s^-4, variance of accelerations by that of positions.
    """

    def __init__(self, means: Sequence[Means], kept: Sequence[BoolArray], ratio: float) -> None:
        self.normal = np.zeros((INVERSE, INVERSE))
        self.right = np.zeros(INVERSE)
        self.squared, self.log_determinant, self.count = 0.0, 0.0, 0
        for part, chosen in zip(means, kept, strict=True):
            size = int(np.count_nonzero(chosen))
            if size == 0:
                continue
            noise = covariance(len(part.times), part.spacing, ratio)
            factor = cholesky(noise[np.ix_(chosen, chosen)], lower=True)
            rows = design(part)[chosen].reshape(size, -1)
            rows = solve_triangular(factor, rows, lower=True).reshape(3 * size, INVERSE)
            values = solve_triangular(factor, part.seen[chosen], lower=True).ravel()
            self.normal += rows.T @ rows
            self.right += rows.T @ values
            self.squared += float(values @ values)
            self.log_determinant += 6.0 * float(np.sum(np.log(np.diag(factor))))
            self.count += 3 * size

    def left(self, found: Array) -> float:
        """Sum of squares that a solution (11,) leaves."""
        x = found[:INVERSE]
        return float(self.squared - 2.0 * x @ self.right + x @ self.normal @ x)


def design(part: Means) -> Array:
    """Derivatives (n,3,10) of what images show by the unknowns."""
    rows = np.zeros((len(part.times), 3, INVERSE))
    rows[:, :, FORCE] = part.forces
    rows[:, :, GRAVITY] = part.weights[:, None, None] * np.eye(3)
    rows[:, :, BIAS] = -part.axes
    rows[:, :, LEVER] = -part.arms
    return rows


def covariance(count: int, spacing: float, ratio: float) -> Array:
    """Of means (n,n): white noise of positions (1), and of accelerations (``ratio``)."""
    of_positions, of_accelerations = _noises(count, spacing)
    return np.asarray(of_positions + ratio * of_accelerations)


@lru_cache(maxsize=32)
def _noises(count: int, spacing: float) -> tuple[Array, Array]:
    """Covariances (n,n) of means by white noise of positions, and of accelerations."""
    differences = np.zeros((count, count + 2))
    for offset, factor in enumerate((1.0, -2.0, 1.0)):
        differences[np.arange(count), np.arange(count) + offset] = factor / spacing**2
    of_positions = differences @ _overlaps(DEGREE - 2, count + 2) @ differences.T
    return of_positions / spacing, _overlaps(DEGREE, count) / spacing


def _overlaps(degree: int, count: int) -> Array:
    """Integrals (n,n) of the products of B-splines a spacing apart, by it."""
    order = 2 * degree + 1
    knots = np.arange(order + 2) - 0.5 * (order + 1)
    values = BSpline.basis_element(knots, extrapolate=False)(np.arange(count, dtype=float))
    return np.asarray(toeplitz(np.nan_to_num(values)))


# What is known beforehand (m/s^2): gravity by place, biases of consumer accelerometers; their
# scale, by itself.
_GRAVITY_DEVIATION, _BIAS_DEVIATION, _SCALE_DEVIATION = 0.02, 0.5, 0.01
# Variance of accelerations by that of positions, s^-4: what may be, and where to begin.
_RATIOS = np.geomspace(1e-3, 1e7, 41)
_PLAIN = 1e3
_ROUNDS, _TRIALS = 5, 4
# Squared errors of three axes count up to so many times their median: 6 deviations.
_OUTLIER = 15.0
# Orientations by images have errors (rad) that last, which residuals do not show.
_BEND = 5e-4
# Rounding leaves at least this share of squares, and a camera at rest has none.
_EXACT, _NOTHING = 1e-12, 1e-30
# A part whose scale is known so many times worse than the best one's hardly moved, and is not asked
# whether it agrees: it shows the noise of what it is compared with.
_RESTING = 7.0
# So much of the accelerations that images show must be the accelerometer's.
_LEAST_EXPLAINED = 0.5
# Parts that would differ this much by chance once in a hundred recordings disagree.
_CHANCE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Lever:
    """Where the IMU is."""

    position: Array  # (3,) m, in the camera's axes
    deviation: float  # m, of each coordinate


@dataclass(frozen=True, slots=True, eq=False)
class Metric:
    """What an accelerometer says of a motion."""

    scale: float  # m per unit of the map
    share: float  # standard deviation of the scale, as a part of it
    gravity: Array  # (3,) m/s^2, downwards, in the map's axes
    gravity_deviation: float  # rad, of its direction
    bias: Array  # (3,) m/s^2, in the accelerometer's axes
    inflation: float  # of the scale's deviation, because parts disagree; 1: they do not
    means: int  # number of mean accelerations


@dataclass(frozen=True, slots=True, eq=False)
class _Fitted:
    """The most likely unknowns at a ratio of variances."""

    found: Array  # (11,)
    covariance: Array  # (11,11)
    ratio: float  # of the variances, s^-4
    variance: float  # of the noise of positions
    likelihood: float  # its logarithm, restricted
    explained: float


class NoMetric(ValueError):
    """Camera and accelerometer do not go together; the message says why."""


def metric(means: Sequence[Means], lever: Lever) -> Metric:
    """Scale and gravity.

    Args:
        means: of all parts of a motion.
        lever: where the IMU is, as far as that is known.

    Raises:
        NoMetric: where camera and accelerometer are not accelerated alike.
    """
    kept = [np.ones(len(part.times), np.bool_) for part in means]
    for _ in range(_TRIALS):
        fit = _best(means, kept, lever)
        before, kept = kept, _fitting(means, fit)
        if all(map(np.array_equal, before, kept)):
            break
    inverse = float(fit.found[INVERSE])
    if not (inverse > 0.0 and fit.explained > _LEAST_EXPLAINED):
        raise NoMetric(_too_little(max(fit.explained, 0.0)))
    gravity = fit.found[GRAVITY] / inverse
    across = np.eye(3) - np.outer(gravity, gravity) / (gravity @ gravity)
    tilt = across @ fit.covariance[GRAVITY, GRAVITY] @ across / (gravity @ gravity) / inverse**2
    return Metric(
        scale=1.0 / inverse,
        share=float(np.sqrt(fit.covariance[INVERSE, INVERSE])) / inverse,
        gravity=gravity,
        gravity_deviation=float(np.hypot(np.sqrt(np.linalg.eigvalsh(tilt)[-1]), _BEND)),
        bias=fit.found[BIAS] / inverse,
        inflation=_inflation(means, kept, fit),
        means=int(sum(map(np.count_nonzero, kept))),
    )


def _best(means: Sequence[Means], kept: Sequence[BoolArray], lever: Lever) -> _Fitted:
    """At the ratio of variances that is most likely."""
    first = _start(Whitened(means, kept, _PLAIN))
    fitted = [_fit(Whitened(means, kept, ratio), ratio, first, lever) for ratio in _RATIOS.tolist()]
    return max(fitted, key=lambda each: each.likelihood)


def _fitting(means: Sequence[Means], fit: _Fitted) -> list[BoolArray]:
    """Which means (n,) of each part are no outliers: a knock, images that were matched wrongly."""
    x = fit.found[:INVERSE]
    squared = [np.sum(np.square(part.seen - design(part) @ x), axis=1) for part in means]
    limit = _OUTLIER * float(np.median(np.concatenate(squared)))
    return [np.asarray(errors < limit) for errors in squared]


def _start(plain: Whitened) -> Array:
    """Forces' scale and gravity (4,) of least squares."""
    alone = slice(FORCE, GRAVITY.stop)
    # At rest, forces and gravity are one column.
    normal, right = plain.normal[alone, alone], plain.right[alone]
    found = np.asarray(np.linalg.lstsq(normal, right, rcond=None)[0], np.float64)
    explained = float(found @ right) / max(plain.squared, _NOTHING)
    if not found[FORCE] > 0.0:
        if explained < _LEAST_EXPLAINED:
            raise NoMetric(_too_little(0.0))
        raise NoMetric(
            "the accelerometer shows the reverse of how the camera is accelerated: at rest it must "
            "show +g upwards"
        )
    return found


def _too_little(explained: float) -> str:
    return (
        f"camera and accelerometer agree in {100.0 * explained:.0f} % of their accelerations: "
        "either the camera hardly moved (move it to and fro by some decimetres, briskly), or the "
        "accelerometer's axes are not the gyroscope's"
    )


def _fit(whitened: Whitened, ratio: float, first: Array, lever: Lever) -> _Fitted:
    inverse, down = float(first[FORCE]), first[GRAVITY] / np.linalg.norm(first[GRAVITY])
    variance = max(whitened.squared, _NOTHING) / whitened.count
    for _ in range(_ROUNDS):
        rows, values = _known(inverse, down, lever)
        normal = rows.T @ rows
        normal[:INVERSE, :INVERSE] += whitened.normal / variance
        right = rows.T @ values
        right[:INVERSE] += whitened.right / variance
        found = np.asarray(np.linalg.solve(normal, right), np.float64)
        squared = max(whitened.left(found), _EXACT * whitened.squared, _NOTHING)
        variance = squared / (whitened.count - INVERSE)
        inverse, down = float(found[INVERSE]), found[GRAVITY] / np.linalg.norm(found[GRAVITY])
    likelihood = -0.5 * (
        whitened.count * (1.0 + np.log(variance))
        + whitened.log_determinant
        + np.linalg.slogdet(normal)[1]
    )
    explained = 1.0 - squared / max(whitened.squared, _NOTHING)
    covariance = np.asarray(np.linalg.inv(normal), np.float64)
    return _Fitted(found, covariance, ratio, variance, float(likelihood), explained)


def _known(inverse: float, down: Array, lever: Lever) -> tuple[Array, Array]:
    """What is known beforehand: equations (8,11) of deviation 1, at a scale and a direction."""
    rows = np.zeros((8, UNKNOWNS))
    rows[:3, BIAS] = np.eye(3) / (_BIAS_DEVIATION * inverse)
    rows[3:6, LEVER] = np.eye(3) / (lever.deviation * inverse)
    rows[3:6, INVERSE] = -lever.position / (lever.deviation * inverse)
    rows[6, FORCE], rows[6, INVERSE] = np.array([1.0, -1.0]) / (_SCALE_DEVIATION * inverse)
    rows[7, GRAVITY] = down / (_GRAVITY_DEVIATION * inverse)
    rows[7, INVERSE] = -STANDARD_GRAVITY / (_GRAVITY_DEVIATION * inverse)
    return rows, np.zeros(8)


def _inflation(means: Sequence[Means], kept: Sequence[BoolArray], fit: _Fitted) -> float:
    parts = [
        _part(part, chosen, fit) for part, chosen in zip(means, kept, strict=True) if np.any(chosen)
    ]
    values, deviations = np.array(parts).T
    moved = deviations < _RESTING * deviations.min()
    return excess(values[moved], deviations[moved])


def _part(part: Means, kept: BoolArray, fit: _Fitted) -> tuple[float, float]:
    """1 / scale of a part, with gravity, bias and lever of the whole, by that of the whole.

    In the deviation is that gravity, bias and lever are not known exactly: where the camera rests,
    their errors are all that looks like an acceleration.
    """
    alone = Whitened([part], [kept], fit.ratio)
    whole = fit.found[:INVERSE]
    slope = alone.normal @ whole
    weight = max(float(whole @ slope), _NOTHING)
    across = fit.covariance[:INVERSE, INVERSE]
    others = fit.covariance[:INVERSE, :INVERSE]
    others = others - np.outer(across, across) / fit.covariance[INVERSE, INVERSE]
    variance = fit.variance / weight + float(slope @ others @ slope) / weight**2
    return float(whole @ alone.right) / weight, float(np.sqrt(variance))


def excess(values: Array, deviations: Array) -> float:
    """By how much a weighted mean's deviation is too small, as values (b,) scatter; at least 1.

    Blocks may be known very differently well; all are taken to differ by the same on top
    (DerSimonian and Laird, Meta-analysis in clinical trials, Controlled Clinical Trials 1986).
    """
    weights = deviations**-2.0
    total, squares = float(np.sum(weights)), float(np.sum(weights**2))
    mean = np.sum(weights * values) / total
    squared, freedoms = float(np.sum(weights * (values - mean) ** 2)), len(values) - 1
    if freedoms < 1 or chdtrc(freedoms, squared) > _CHANCE:
        return 1.0
    own = max(squared - freedoms, 0.0) / (total - squares / total)
    return math.sqrt(1.0 + own * squares / total)
