"""Shaking: a turn of the camera beside its motion, as polynomials of the row time."""

from __future__ import annotations

from functools import cache

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.simd.jit import kernel

# Polynomials of the row time, from the second degree: the motion has a constant and a linear part.
FIRST_DEGREE = 2
_WHOLE_SIZE = 3.0  # the degree that counts as it is


@kernel
def legendre(x: float, values: Array) -> None:
    """Fill in the Legendre polynomials of degree 0, 1, ... at x."""
    values[0] = 1.0
    values[1] = x
    for k in range(2, len(values)):
        values[k] = ((2 * k - 1) * x * values[k - 1] - (k - 1) * values[k - 2]) / k


@kernel
def shake_basis(tau: float, degrees: int, values: Array, rates: Array) -> None:
    """Fill in the polynomials of the shaking at a row time, and their rates.

    Legendre polynomials of ``2 tau`` of degree 2 to ``degrees``, less their value and slope at the
    middle row: there, pose and velocities are the motion's own. They are the smaller the faster
    they change, because what is slow swings farther.
    """
    x = 2.0 * tau
    # Polynomials of two degrees, here and at the middle row, and their derivatives by x.
    at, at_before, middle, middle_before = x, 1.0, 0.0, 1.0
    slope_at = 1.0
    for k in range(FIRST_DEGREE, degrees + 1):
        slope_at = k * at + x * slope_at
        slope = k * middle
        at, at_before = ((2 * k - 1) * x * at - (k - 1) * at_before) / k, at
        middle, middle_before = -(k - 1) * middle_before / k, middle
        size = (_WHOLE_SIZE / k) ** 2
        values[k - FIRST_DEGREE] = size * (at - middle - x * slope)
        rates[k - FIRST_DEGREE] = size * 2.0 * (slope_at - slope)


@kernel
def shake_at(tau: Array, coefficients: Array) -> Array:
    """Turn of the camera beside its motion, and its rate, (n,6) at row times (n,)."""
    count = len(coefficients)
    values, rates = np.empty(count), np.empty(count)
    shake = np.zeros((len(tau), 6))
    if count == 0:
        return shake
    for i in range(len(tau)):
        shake_basis(tau[i], count + FIRST_DEGREE - 1, values, rates)
        for k in range(count):
            for axis in range(3):
                shake[i, axis] += values[k] * coefficients[k, axis]
                shake[i, 3 + axis] += rates[k] * coefficients[k, axis]
    return shake


def within_rows(tau: float) -> float:
    """The row time itself, or that of the first or last row before or after them."""
    return min(max(tau, -0.5), 0.5)


def basis_sizes(degrees: int) -> Array:
    """Sizes (degrees - 1,) of the polynomials of :func:`shake_basis`."""
    sizes: Array = (_WHOLE_SIZE / np.arange(FIRST_DEGREE, degrees + 1)) ** 2
    return sizes


@cache
def shake_in_the_middle(count: int) -> tuple[Array, Array]:
    """Values and slopes (count,) at the middle row that :func:`shake_basis` takes away."""
    degrees = np.arange(FIRST_DEGREE, count + FIRST_DEGREE)
    polynomials = [np.polynomial.Legendre.basis(k) for k in degrees]
    sizes = basis_sizes(count + FIRST_DEGREE - 1)
    values = sizes * np.array([p(0.0) for p in polynomials])
    slopes = sizes * np.array([2.0 * p.deriv()(0.0) for p in polynomials])
    return values, slopes
