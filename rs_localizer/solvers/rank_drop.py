# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Where a 6x4 matrix whose entries are linear in three unknowns x, y, z drops rank.

All of its fifteen 4x4 minors vanish there: quartics with 35 monomials. Their QR decomposition,
the monomials of degree four first, expresses ``y m`` for each of the ten cubic monomials m by the
20 monomials up to degree three (the *relations*). Multiplication by y thereby becomes a 20x20
matrix, whose eigenvalues are the values of y at the 20 solutions (Cox, Little, O'Shea, "Using
Algebraic Geometry", 2005, sec. 2.4); at each of them the relations are linear in the ten
monomials of x and z.

Everything happens in lanes (:mod:`rs_localizer.core.simd.vectors`). The matrix is stored by rows
of four entries of four coefficients: of 1, x, y and z.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.simd.algebra import least_squares
from rs_localizer.core.simd.tracing import LANES, Lanes, Vector, traced
from rs_localizer.core.simd.vectors import load, root, store, uniform, where_less
from rs_localizer.native import inlined, kernel

SOLUTIONS = 20
RELATIONS = 10 * SOLUTIONS  # y m + sum_j relation[m, j] basis_j = 0

_ROWS = 6
_MINORS = 15

Exponents = tuple[int, int, int]


def _monomials(degree: int) -> list[Exponents]:
    """Return the exponents of x, y, z of all monomials of that degree."""
    powers = itertools.product(range(degree, -1, -1), repeat=3)
    return [(x, y, z) for x, y, z in powers if x + y + z == degree]


def _times(a: Exponents, b: Exponents) -> Exponents:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


_Y = (0, 1, 0)
_CUBICS = _monomials(3)
_BASIS = [m for degree in range(4) for m in _monomials(degree)]
# Monomials up to degree d come first, for every d; the ten multiples of y come last.
_ALL = [*_BASIS, *(m for m in _monomials(4) if m[1] == 0), *(_times(_Y, m) for m in _CUBICS)]
_PLANAR = [m for degree in (3, 2, 1, 0) for m in _monomials(degree) if m[1] == 0]

_WIDTH = len(_ALL)
_FIRST_Y = _WIDTH - len(_CUBICS)
_TIMES_Y = np.array([_ALL.index(_times(_Y, m)) for m in _BASIS])
_COUNT = (1, 4, 10, SOLUTIONS, _WIDTH)  # monomials up to that degree


def _subsets(size: int) -> list[tuple[int, ...]]:
    return list(itertools.combinations(range(_ROWS), size))


def _terms(size: int) -> Any:
    """Expand all minors of ``size`` rows along their last column (Laplace).

    Returns:
        (minor, place, 2): a row, and the number of the smaller minor of the other rows; minors
        are numbered by their rows.
    """
    smaller = {rows: i for i, rows in enumerate(_subsets(size - 1))}
    return np.array(
        [
            [(row, smaller[(*rows[:i], *rows[i + 1 :])]) for i, row in enumerate(rows)]
            for rows in _subsets(size)
        ]
    )


def _expand(size: int) -> Any:
    """Trace a minor (up to its sign) from the last entries of its rows and smaller minors."""
    count = _COUNT[size - 1]

    def expand(values: list[Lanes]) -> Vector:
        minor: Vector = [0.0] * _COUNT[size]
        for i in range(size):
            entry = values[4 * i : 4 * i + 4]
            smaller = values[4 * size + count * i :][:count]
            for a, x in zip(_BASIS, entry, strict=False):
                signed = -x if i % 2 else x
                for b, y in zip(_BASIS, smaller, strict=False):
                    at = _ALL.index(_times(a, b))
                    minor[at] = signed * y + minor[at]
        return minor

    return traced(expand, size * (4 + count))


_TERMS_2, _TERMS_3, _TERMS_4 = _terms(2), _terms(3), _terms(4)
_expand_2, _expand_3, _expand_4 = _expand(2), _expand(3), _expand(4)

# Places in the work array of the minors of two, three and four rows, and of the operands of one
# minor.
_PAIRS = 0
_TRIPLES = _PAIRS + len(_TERMS_2) * _COUNT[2]
_QUARTICS = _TRIPLES + len(_TERMS_3) * _COUNT[3]
_OPERANDS = _QUARTICS + len(_TERMS_4) * _COUNT[4]
WORK = _OPERANDS + 4 * (4 + _COUNT[3])


@kernel
def _collect(
    matrix: Array, column: int, terms: Any, smaller: Array, begin: int, stride: int, count: int,
    operands: Array,
) -> None:  # fmt: skip
    """Collect the operands that :func:`_expand` takes."""
    size = len(terms)
    for i in range(size):
        row, others = terms[i]
        for k in range(4):
            store(operands, 4 * i + k, load(matrix, column + 16 * row + k))
        for k in range(count):
            store(operands, 4 * size + count * i + k, load(smaller, begin + stride * others + k))


@inlined
def find_relations(matrix: Array, offset: int, work: Array, relations: Array) -> None:
    """Compute the relations of the quotient ring.

    Args:
        matrix: holds the 6x4 matrix from value ``offset`` on (96 values).
        work: room for :data:`WORK` values.
        relations: result (:data:`RELATIONS` values); not finite where the minors have more
            dependences than they must.
    """
    operands = work[_OPERANDS * LANES :]
    pairs, triples = _COUNT[2], _COUNT[3]
    for i in range(len(_TERMS_2)):
        _collect(matrix, offset + 4, _TERMS_2[i], matrix, offset, 16, 4, operands)
        _expand_2(operands, work[(_PAIRS + i * pairs) * LANES :])
    for i in range(len(_TERMS_3)):
        _collect(matrix, offset + 8, _TERMS_3[i], work, _PAIRS, pairs, pairs, operands)
        _expand_3(operands, work[(_TRIPLES + i * triples) * LANES :])
    for i in range(len(_TERMS_4)):
        _collect(matrix, offset + 12, _TERMS_4[i], work, _TRIPLES, triples, triples, operands)
        _expand_4(operands, work[(_QUARTICS + i * _WIDTH) * LANES :])
    _triangularize(work, relations)
    _back_substitute(work, relations)


@inlined
def _triangularize(work: Array, axis: Array) -> None:
    """Triangularize the quartics by Householder QR, with the monomials of degree four first."""
    zero, one = uniform(0.0), uniform(1.0)
    for k in range(_MINORS):
        pivot = SOLUTIONS + k
        at = _QUARTICS + k * _WIDTH
        head = load(work, at + pivot)
        square = head * head
        for i in range(1, _MINORS - k):
            x = load(work, at + i * _WIDTH + pivot)
            square = square + x * x
            store(axis, i, x)
        norm = root(square)
        diagonal = where_less(head, zero, norm, -norm)  # the sign that avoids cancellation
        first = head - diagonal
        scale = one / (diagonal * first)
        store(axis, 0, first)
        store(work, at + pivot, diagonal)
        for j in range(_WIDTH):
            if SOLUTIONS <= j <= pivot:
                continue
            product = zero
            for i in range(_MINORS - k):
                product = product + load(axis, i) * load(work, at + i * _WIDTH + j)
            product = product * scale
            for i in range(_MINORS - k):
                entry = at + i * _WIDTH + j
                store(work, entry, load(work, entry) + load(axis, i) * product)


@inlined
def _back_substitute(work: Array, relations: Array) -> None:
    """Solve the last ten rows, which hold no other monomial of degree four, for ``y m``."""
    count = _WIDTH - _FIRST_Y
    for i in range(count - 1, -1, -1):
        at = _QUARTICS + (_MINORS - count + i) * _WIDTH
        inverse = uniform(1.0) / load(work, at + _FIRST_Y + i)
        for j in range(SOLUTIONS):
            rest = load(work, at + j)
            for k in range(i + 1, count):
                rest = rest - load(work, at + _FIRST_Y + k) * load(relations, k * SOLUTIONS + j)
            store(relations, i * SOLUTIONS + j, rest * inverse)


@inlined
def fill_multiplication(relations: Array, h: Array) -> None:
    """Write the matrix of multiplication by y, for :mod:`rs_localizer.core.simd.eigenvalues`."""
    for i in range((SOLUTIONS + 1) ** 2):
        store(h, i, uniform(0.0))
    for i in range(SOLUTIONS):
        row = i * (SOLUTIONS + 1)
        if _TIMES_Y[i] < SOLUTIONS:
            store(h, row + _TIMES_Y[i], uniform(1.0))
        else:
            relation = (_TIMES_Y[i] - _FIRST_Y) * SOLUTIONS
            for j in range(SOLUTIONS):
                store(h, row + j, -load(relations, relation + j))


def solution_at(relations: Sequence[Any], y: Any) -> Vector:
    """Return x, y, z at the eigenvalue y, from the relations there; for traced code."""
    powers = [1.0, y, y * y, y * y * y]
    powers.append(powers[2] * powers[2])
    columns = [[0.0] * len(_CUBICS) for _ in _PLANAR]
    for i, cubic in enumerate(_CUBICS):
        row = relations[i * SOLUTIONS : (i + 1) * SOLUTIONS]
        for (x, degree, z), value in [*zip(_BASIS, row, strict=True), (_times(_Y, cubic), 1.0)]:
            column = columns[_PLANAR.index((x, 0, z))]
            column[i] = powers[degree] * value + column[i]
    *unknown, constant = columns  # monomials 1 and before it z and x
    solution = least_squares(unknown, [-value for value in constant])
    return [solution[-2], y, solution[-1]]
