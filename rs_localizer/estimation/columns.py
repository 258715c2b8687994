"""The linearized points of a frame as products of columns: motion, shaking and smooth field."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.shake import FIRST_DEGREE, legendre, shake_basis
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.core.simd.tracing import LANES, traced_products
from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.prior_kernels import add_prior
from rs_localizer.estimation.prior_terms import PriorTerms
from rs_localizer.estimation.residuals import Lines

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
# Columns are multiplied in tiles of so many, whose sums fit registers; so many points at a time
# stay in the fast caches.
_TILE, _CHUNK = 4, 256
_tile_products = traced_products(_TILE)


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
def columns_of(lines: Lines, inliers: BoolArray, degrees: int, field: bool) -> Columns:
    """Multiply the columns of a frame.

    The field is that of the places where the motion *sees* the points: taken where they were
    measured, it would have their noise in it, as the errors have, but not the derivatives by the
    motion, from which some fields differ by that alone.

    Args:
        lines: of the points, at the motion; of the derivatives by it, the first 18 count.
        inliers: (n,) the points that count.
        degrees: of the polynomials of the shaking; 0: none.
        field: whether to add the columns of the field.
    """
    errors, by_motion, by_turn, tau, image = lines
    chosen = np.flatnonzero(inliers)
    polynomials = max(degrees - FIRST_DEGREE + 1, 0)
    shake = 3 * polynomials
    # Those of motion and shaking, and the errors as the last one; their products with themselves,
    # with the field's terms in either direction, and those of the terms.
    last, terms = PARAMETERS + shake, _FIELD_TERMS if field else 0
    wide, high = -(-(last + 1) // _TILE) * _TILE, -(-terms // _TILE) * _TILE
    products, first, second = np.zeros((wide, wide)), np.zeros((high, wide)), np.zeros((high, wide))
    of_terms = np.zeros((high, high))
    blocks = -(-min(len(chosen), _CHUNK) // LANES)
    dense = np.zeros((wide // _TILE, 2 * blocks, _TILE * LANES))
    smooth = np.zeros((high // _TILE, blocks, _TILE * LANES))
    for start in range(0, len(chosen), _CHUNK):
        part = chosen[start : start + _CHUNK]
        if start > 0:
            dense[:], smooth[:] = 0.0, 0.0
        _fill_dense(dense, errors, by_motion, by_turn, tau, part, degrees)
        _add_products(dense, dense, True, products)
        if field:
            _fill_smooth(smooth, image, chosen, part)
            _add_products(smooth, dense[:, :blocks], False, first)
            _add_products(smooth, dense[:, blocks:], False, second)
            _add_products(smooth, smooth, True, of_terms)
    return _assembled(products, first, second, of_terms, shake, terms)


@inlined
def _fill_dense(
    dense: Array, errors: Array, by_motion: Array, by_turn: Array, tau: Array, chosen: IntArray,
    degrees: int,
) -> None:  # fmt: skip
    """Columns of motion, shaking and errors of the chosen points, in tiles and lanes.

    The second half of the blocks is of the errors in the other direction.
    """
    polynomials = max(degrees - FIRST_DEGREE + 1, 0)
    values, rates = np.empty(polynomials), np.empty(polynomials)
    half = dense.shape[1] // 2
    for place in range(len(chosen)):
        i = chosen[place]
        if polynomials > 0:
            shake_basis(tau[i], degrees, values, rates)
        lane = place % LANES
        for row in range(2):
            block = row * half + place // LANES
            for k in range(PARAMETERS):
                dense[k // _TILE, block, k % _TILE * LANES + lane] = by_motion[i, row, k]
            column = PARAMETERS
            for k in range(polynomials):
                for axis in range(3):
                    value = values[k] * by_turn[i, row, axis]
                    dense[column // _TILE, block, column % _TILE * LANES + lane] = value
                    column += 1
            dense[column // _TILE, block, column % _TILE * LANES + lane] = errors[i, row]


@inlined
def _fill_smooth(smooth: Array, image: Array, inliers: IntArray, chosen: IntArray) -> None:
    """The field's terms of the chosen points among the inliers, in tiles and lanes."""
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for i in inliers:
        for k in range(2):
            low[k], high[k] = min(low[k], image[i, k]), max(high[k], image[i, k])
    scale = (2.0 / max(high[0] - low[0], 1e-12), 2.0 / max(high[1] - low[1], 1e-12))
    middle = (0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]))
    terms, x, y = np.empty(_FIELD_TERMS), np.empty(_FIELD_DEGREE + 1), np.empty(_FIELD_DEGREE + 1)
    for place in range(len(chosen)):
        i = chosen[place]
        legendre(scale[0] * (image[i, 0] - middle[0]), x)
        legendre(scale[1] * (image[i, 1] - middle[1]), y)
        _field_terms(x, y, terms)
        block, lane = place // LANES, place % LANES
        for k in range(_FIELD_TERMS):
            smooth[k // _TILE, block, k % _TILE * LANES + lane] = terms[k]


@kernel
def _add_products(columns: Array, others: Array, triangle: bool, products: Array) -> None:
    """Add the products of all columns with others; of a triangle those below the diagonal."""
    sums = np.empty(_TILE * _TILE)
    for a in range(len(columns)):
        for b in range(a + 1 if triangle else len(others)):
            _tile_products(columns[a], others[b], columns.shape[1], sums)
            for i in range(_TILE):
                for j in range(_TILE):
                    products[a * _TILE + i, b * _TILE + j] += sums[i * _TILE + j]


@inlined
def _assembled(
    products: Array, first: Array, second: Array, of_terms: Array, shake: int, terms: int
) -> Columns:
    """All products: terms of one direction have none with those of the other."""
    last = PARAMETERS + shake
    size = last + 2 * terms
    whole, with_errors = np.zeros((size, size)), np.empty(size)
    for k in range(last):
        with_errors[k] = -products[last, k]
        for m in range(k + 1):
            whole[k, m] = products[k, m]
            whole[m, k] = products[k, m]
    for k in range(terms):
        one, other = last + k, last + terms + k
        with_errors[one], with_errors[other] = -first[k, last], -second[k, last]
        for m in range(last):
            whole[one, m], whole[m, one] = first[k, m], first[k, m]
            whole[other, m], whole[m, other] = second[k, m], second[k, m]
        for m in range(k + 1):
            for shift in (last, last + terms):
                whole[shift + k, shift + m] = of_terms[k, m]
                whole[shift + m, shift + k] = of_terms[k, m]
    return Columns(whole, with_errors, products[last, last], shake)


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


@inlined
def _field_terms(x: Array, y: Array, terms: Array) -> None:
    """Fill in the terms of a field whose expected mean square over the image is 1."""
    place = 0
    for degree in range(_FIELD_DEGREE + 1):
        for i in range(degree + 1):
            terms[place] = x[i] * y[degree - i]
            place += 1
    for place in range(_FIELD_TERMS):
        terms[place] *= _TERM_SIZES[place]
