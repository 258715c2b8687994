"""The linearized points of a frame as products of columns: motion, shaking and smooth field."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.lanes.jit import kernel
from rs_localizer.core.shake import FIRST_DEGREE, legendre, shake_basis
from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.prior_kernels import add_prior
from rs_localizer.estimation.prior_terms import PriorTerms

# Coefficients of the field: polynomials of the image up to the third degree, in two directions.
_FIELD_DEGREE = 3
_FIELD_TERMS = (_FIELD_DEGREE + 1) * (_FIELD_DEGREE + 2) // 2
# Size of each degree: fields of lenses and maps are smooth. Those of real maps shear and stretch an
# image as much as they move it: printers stretch paper, markers are surveyed one by one.
_FIELD_DEGREE_SIZES = (1.0, 1.0, 0.5, 0.25)
_TERM_SIZES = np.array(
    [
        _FIELD_DEGREE_SIZES[degree] * math.sqrt((2 * i + 1) * (2 * (degree - i) + 1))
        for degree in range(_FIELD_DEGREE + 1)
        for i in range(degree + 1)
    ]
) / math.sqrt(sum((d + 1) * size**2 for d, size in enumerate(_FIELD_DEGREE_SIZES)))


class Columns(NamedTuple):
    """Products of all columns of a linearized frame, over its inliers.

    The columns are the derivatives by the motion (18), by the coefficients of the shaking (3 per
    polynomial) and by those of the field; products with the errors are those of the negative ones,
    for a least-squares step.
    """

    products: Array  # (m,m)
    with_errors: Array  # (m,)
    squared_errors: float
    shake: int  # coefficients


@kernel
def columns_of(
    errors: Array, by_motion: Array, by_turn: Array, tau: Array, rays: Array, inliers: BoolArray,
    degrees: int, field: bool,
) -> Columns:  # fmt: skip
    """Multiply the columns of a frame (see :func:`rs_localizer.estimation.residuals.linearized`).

    Args:
        errors, by_motion, by_turn, tau: of the points, at the motion.
        rays: (n,2) of the points, to say where in the image they are.
        inliers: (n,) the points that count.
        degrees: of the polynomials of the shaking; 0: none.
        field: whether to add the columns of the field.
    """
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for i in range(len(rays)):
        if inliers[i]:
            for k in range(2):
                low[k], high[k] = min(low[k], rays[i, k]), max(high[k], rays[i, k])
    polynomials = max(degrees - FIRST_DEGREE + 1, 0)
    shake = 3 * polynomials
    size = PARAMETERS + shake + (2 * _FIELD_TERMS if field else 0)
    products, with_errors, squared = np.zeros((size, size)), np.zeros(size), 0.0
    # Of the errors in the one direction and in the other, which have the shaking's turn in common,
    # but not the field.
    first, second = np.zeros(size), np.zeros(size)
    values, rates = np.empty(polynomials), np.empty(polynomials)
    terms, x, y = np.empty(_FIELD_TERMS), np.empty(_FIELD_DEGREE + 1), np.empty(_FIELD_DEGREE + 1)
    for i in range(len(errors)):
        if not inliers[i]:
            continue
        if polynomials > 0:
            shake_basis(tau[i], degrees, values, rates)
        if field:
            legendre((2.0 * rays[i, 0] - low[0] - high[0]) / max(high[0] - low[0], 1e-12), x)
            legendre((2.0 * rays[i, 1] - low[1] - high[1]) / max(high[1] - low[1], 1e-12), y)
            _field_terms(x, y, terms)
            for k in range(_FIELD_TERMS):
                first[PARAMETERS + shake + k] = terms[k]
                second[PARAMETERS + shake + _FIELD_TERMS + k] = terms[k]
        for k in range(PARAMETERS):
            first[k], second[k] = by_motion[i, 0, k], by_motion[i, 1, k]
        for k in range(polynomials):
            for axis in range(3):
                place = PARAMETERS + 3 * k + axis
                first[place] = values[k] * by_turn[i, 0, axis]
                second[place] = values[k] * by_turn[i, 1, axis]
        one, other = errors[i, 0], errors[i, 1]
        squared += one * one + other * other
        for k in range(size):
            here, there = first[k], second[k]
            with_errors[k] -= here * one + there * other
            row = products[k]
            for m in range(k + 1):
                row[m] += here * first[m] + there * second[m]
    for k in range(size):
        for m in range(k):
            products[m, k] = products[k, m]
    return Columns(products, with_errors, squared, shake)


@kernel
def with_prior(columns: Columns, prior: PriorTerms, state: Array, noise: float) -> Columns:
    """The columns and the prior of the motion at a state (24,), weighed against the noise (px)."""
    information, slope = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    cost = add_prior(
        prior.informations, prior.references, prior.gravity, state, noise * noise,
        information, slope,
    )  # fmt: skip
    products, with_errors = columns.products.copy(), columns.with_errors.copy()
    for i in range(PARAMETERS):
        with_errors[i] -= slope[i]
        for j in range(PARAMETERS):
            products[i, j] += information[i, j]
    return Columns(products, with_errors, columns.squared_errors + cost, columns.shake)


@kernel
def _field_terms(x: Array, y: Array, terms: Array) -> None:
    """Fill in the terms of a field whose expected mean square over the image is 1."""
    place = 0
    for degree in range(_FIELD_DEGREE + 1):
        for i in range(degree + 1):
            terms[place] = x[i] * y[degree - i]
            place += 1
    for place in range(_FIELD_TERMS):
        terms[place] *= _TERM_SIZES[place]
