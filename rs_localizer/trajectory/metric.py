"""Metres and gravity of a motion in units of its own, from an accelerometer that went along.

Mean accelerations (:mod:`rs_localizer.trajectory.mean_accelerations`), divided by the scale s:

    seen = m forces + w gravity - axes bias - arms lever

is linear in m, gravity, bias and lever arm, each by s. The positions, which images know only so
well, stand alone on the left: noise in what a fit regresses on would make the scale too small.
``m`` is 1 / s but for what the accelerometer's own scale is off; the length of gravity says the
same of 1 / s.

The noise of neighbouring means hangs together: that of positions by their second differences, that
of accelerations (an orientation that is off turns gravity) by the overlap of the B-splines. How
much there is of both is told by the residuals, by restricted maximum likelihood (Patterson,
Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika 1971).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cholesky, solve_triangular, toeplitz

from rs_localizer.core.arrays import Array
from rs_localizer.inertial.gravity import STANDARD_GRAVITY
from rs_localizer.trajectory.mean_accelerations import DEGREE, Means

# What is known beforehand (m/s^2): gravity by place, biases of consumer accelerometers; their
# scale, by itself.
_GRAVITY_DEVIATION, _BIAS_DEVIATION, _SCALE_DEVIATION = 0.02, 0.5, 0.01
# Unknowns: 1 / s as the forces say it, and gravity, bias, lever arm and 1 / s by s.
_FORCE, _GRAVITY, _BIAS, _LEVER, _INVERSE = 0, slice(1, 4), slice(4, 7), slice(7, 10), 10
_UNKNOWNS = 11
# Variance of accelerations by that of positions, s^-4: what may be, and where to begin.
_RATIOS = np.geomspace(1e-3, 1e7, 41)
_PLAIN = 1e3
_ROUNDS = 5
# So much of the accelerations that images show must be the accelerometer's.
_LEAST_EXPLAINED = 0.5


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
    lever: Array  # (3,) m, of the IMU in the camera's axes
    force: float  # scale of the forces' own by that of gravity
    explained: float  # share of the accelerations that camera and IMU have in common
    parts: tuple[tuple[float, float], ...]  # scale and deviation (share) of parts on their own
    means: int  # number of mean accelerations


class _Whitened:
    """Equations of means, their noise made white at a ratio of variances."""

    def __init__(self, means: Sequence[Means], ratio: float) -> None:
        self.normal = np.zeros((_INVERSE, _INVERSE))
        self.right = np.zeros(_INVERSE)
        self.squared, self.log_determinant, self.count = 0.0, 0.0, 0
        factors: dict[int, Array] = {}
        for part in means:
            size = len(part.times)
            if size not in factors:
                factors[size] = cholesky(_covariance(size, part.spacing, ratio), lower=True)
            factor = factors[size]
            rows = solve_triangular(factor, _design(part).reshape(size, -1), lower=True)
            errors = solve_triangular(factor, part.seen, lower=True).ravel()
            rows = rows.reshape(3 * size, _INVERSE)
            self.normal += rows.T @ rows
            self.right += rows.T @ errors
            self.squared += float(errors @ errors)
            self.log_determinant += 6.0 * float(np.sum(np.log(np.diag(factor))))
            self.count += 3 * size

    def left(self, found: Array) -> float:
        """Sum of squares that a solution leaves."""
        x = found[:_INVERSE]
        return float(self.squared - 2.0 * x @ self.right + x @ self.normal @ x)


def _design(part: Means) -> Array:
    """(n,3,10)."""
    rows = np.zeros((len(part.times), 3, _INVERSE))
    rows[:, :, _FORCE] = part.forces
    rows[:, :, _GRAVITY] = part.weights[:, None, None] * np.eye(3)
    rows[:, :, _BIAS] = -part.axes
    rows[:, :, _LEVER] = -part.arms
    return rows


def _covariance(count: int, spacing: float, ratio: float) -> Array:
    """Of means (n,n): white noise of positions (1), and of accelerations (``ratio``)."""
    differences = np.zeros((count, count + 2))
    for offset, factor in enumerate((1.0, -2.0, 1.0)):
        differences[np.arange(count), np.arange(count) + offset] = factor / spacing**2
    of_positions = differences @ _overlaps(DEGREE - 2, count + 2) @ differences.T
    return np.asarray((of_positions + ratio * _overlaps(DEGREE, count)) / spacing)


def _overlaps(degree: int, count: int) -> Array:
    """Integrals (n,n) of the products of B-splines a spacing apart, by it: one of twice the degree
    and one more.
    """
    order = 2 * degree + 1
    knots = np.arange(order + 2) - 0.5 * (order + 1)
    values = BSpline.basis_element(knots, extrapolate=False)(np.arange(count, dtype=float))
    return np.asarray(toeplitz(np.nan_to_num(values)))


@dataclass(frozen=True, slots=True, eq=False)
class _Fitted:
    """The most likely unknowns at a ratio of variances."""

    found: Array  # (11,)
    covariance: Array  # (11,11)
    variance: float  # of the white noise
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
    first = _start(means)
    whitened = [_Whitened(means, float(ratio)) for ratio in _RATIOS]
    fitted = [_fit(of, first, lever) for of in whitened]
    best = int(np.argmax([each.likelihood for each in fitted]))
    fit, ratio = fitted[best], float(_RATIOS[best])
    inverse = float(fit.found[_INVERSE])
    if not (inverse > 0.0 and fit.explained > _LEAST_EXPLAINED):
        raise NoMetric(_too_little(max(fit.explained, 0.0)))
    gravity = fit.found[_GRAVITY] / inverse
    across = np.eye(3) - np.outer(gravity, gravity) / (gravity @ gravity)
    tilt = across @ fit.covariance[_GRAVITY, _GRAVITY] @ across / (gravity @ gravity) / inverse**2
    return Metric(
        scale=1.0 / inverse,
        share=float(np.sqrt(fit.covariance[_INVERSE, _INVERSE])) / inverse,
        gravity=gravity,
        gravity_deviation=float(np.sqrt(np.linalg.eigvalsh(tilt)[-1])),
        bias=fit.found[_BIAS] / inverse,
        lever=fit.found[_LEVER] / inverse,
        force=float(fit.found[_FORCE]) / inverse,
        explained=fit.explained,
        parts=tuple(_part(part, ratio, fit) for part in means),
        means=sum(len(part.times) for part in means),
    )


def _start(means: Sequence[Means]) -> Array:
    """Forces' scale and gravity (4,) of least squares."""
    plain = _Whitened(means, _PLAIN)
    alone = slice(_FORCE, _GRAVITY.stop)
    found: Array = np.linalg.solve(plain.normal[alone, alone], plain.right[alone])
    explained = float(found @ plain.right[alone]) / plain.squared
    if not found[_FORCE] > 0.0:
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


def _fit(whitened: _Whitened, first: Array, lever: Lever) -> _Fitted:
    inverse, down = float(first[_FORCE]), first[_GRAVITY] / np.linalg.norm(first[_GRAVITY])
    variance = whitened.squared / whitened.count
    for _ in range(_ROUNDS):
        rows, values = _known(inverse, down, lever)
        normal = rows.T @ rows
        normal[:_INVERSE, :_INVERSE] += whitened.normal / variance
        right = rows.T @ values
        right[:_INVERSE] += whitened.right / variance
        found = np.linalg.solve(normal, right)
        left = whitened.left(found)
        variance = left / (whitened.count - _INVERSE)
        inverse, down = float(found[_INVERSE]), found[_GRAVITY] / np.linalg.norm(found[_GRAVITY])
    likelihood = -0.5 * (
        whitened.count * (1.0 + np.log(variance))
        + whitened.log_determinant
        + np.linalg.slogdet(normal)[1]
    )
    explained = 1.0 - left / whitened.squared
    return _Fitted(found, np.linalg.inv(normal), variance, float(likelihood), explained)


def _known(inverse: float, down: Array, lever: Lever) -> tuple[Array, Array]:
    """What is known beforehand: equations (8,11) of deviation 1, at a scale and a direction."""
    rows = np.zeros((8, _UNKNOWNS))
    rows[:3, _BIAS] = np.eye(3) / (_BIAS_DEVIATION * inverse)
    rows[3:6, _LEVER] = np.eye(3) / (lever.deviation * inverse)
    rows[3:6, _INVERSE] = -lever.position / (lever.deviation * inverse)
    rows[6, _FORCE], rows[6, _INVERSE] = np.array([1.0, -1.0]) / (_SCALE_DEVIATION * inverse)
    rows[7, _GRAVITY] = down / (_GRAVITY_DEVIATION * inverse)
    rows[7, _INVERSE] = -STANDARD_GRAVITY / (_GRAVITY_DEVIATION * inverse)
    return rows, np.zeros(8)


def _part(part: Means, ratio: float, fit: _Fitted) -> tuple[float, float]:
    """The scale of a part with gravity, bias and lever of the whole, and its deviation (share)."""
    alone = _Whitened([part], ratio)
    metres = fit.found[:_INVERSE] / fit.found[_INVERSE]  # of accelerations in m/s^2
    weight = float(metres @ alone.normal @ metres)
    inverse = float(metres @ alone.right) / weight
    return 1.0 / inverse, float(np.sqrt(fit.variance / weight) / abs(inverse))
