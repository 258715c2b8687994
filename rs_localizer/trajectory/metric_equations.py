"""The equations of :mod:`rs_localizer.trajectory.metric`, their noise made white."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import cholesky, solve_triangular, toeplitz

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.trajectory.mean_accelerations import DEGREE, Means

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
    """Integrals (n,n) of the products of B-splines a spacing apart, by it: one of twice the degree
    and one more.
    """
    order = 2 * degree + 1
    knots = np.arange(order + 2) - 0.5 * (order + 1)
    values = BSpline.basis_element(knots, extrapolate=False)(np.arange(count, dtype=float))
    return np.asarray(toeplitz(np.nan_to_num(values)))
