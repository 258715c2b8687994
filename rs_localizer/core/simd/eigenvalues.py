# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Real eigenvalues of many small matrices at once, one matrix per lane.

Householder's reduction to Hessenberg form and Francis' implicit double shifts, as in EISPACK's
``hqr`` (Martin, Peters, Wilkinson, "The QR algorithm for real Hessenberg matrices", Numer. Math.
14, 1970), without eigenvectors. All lanes take part in every sweep; each has its own window and
shifts, and outside of its window its reflections are the identity.

Nothing is scaled: entries should lie within 1e-70 and 1e70, or a lane loses its eigenvalues.
A matrix of size n is stored with row length n + 1, ``(n + 1)^2`` values in all: the row and
column of zeros let a sweep run over the end of its window.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.simd.tracing import LANES
from rs_localizer.core.simd.vectors import absolute, load, root, store, uniform, where_less
from rs_localizer.native import inlined

_EPSILON = 2.0**-52
_SWEEPS = 8  # per eigenvalue of the slowest lane; the usual number is below two


@inlined
def reduce_to_hessenberg(h: Array, n: int, axis: Array) -> None:
    """Transform matrices to upper Hessenberg form by similarity, in place.

    Args:
        h: matrices of size n.
        axis: room for n values.
    """
    row = n + 1
    zero, one = uniform(0.0), uniform(1.0)
    for k in range(n - 2):
        head = load(h, (k + 1) * row + k)
        square = head * head
        for i in range(k + 2, n):
            x = load(h, i * row + k)
            square = square + x * x
            store(axis, i, x)
            store(h, i * row + k, zero)
        norm = root(square)
        diagonal = where_less(head, zero, norm, -norm)  # the sign that avoids cancellation
        first = head - diagonal
        scale = where_less(zero, square, one / (diagonal * first), zero)
        store(axis, k + 1, first)
        store(h, (k + 1) * row + k, diagonal)
        for j in range(k + 1, n):
            product = zero
            for i in range(k + 1, n):
                product = product + load(axis, i) * load(h, i * row + j)
            product = product * scale
            for i in range(k + 1, n):
                store(h, i * row + j, load(h, i * row + j) + load(axis, i) * product)
        for i in range(n):
            product = zero
            for j in range(k + 1, n):
                product = product + load(axis, j) * load(h, i * row + j)
            product = product * scale
            for j in range(k + 1, n):
                store(h, i * row + j, load(h, i * row + j) + load(axis, j) * product)


@inlined
def _sweep(h: Array, n: int, first: Array, last: Array, bulge: Array) -> None:
    """Apply one implicit double shift to the window ``first .. last`` of every lane.

    Args:
        h: Hessenberg matrices of size n.
        first, last: the windows; ``last < first`` where there is none.
        bulge: first column of the shifted and squared window (3 values).
    """
    row = n + 1
    begin, end = n, 0
    for lane in range(LANES):
        if last[lane] > first[lane]:
            begin = min(begin, int(first[lane]))
            end = max(end, int(last[lane]))
    zero, one = uniform(0.0), uniform(1.0)
    top, bottom = load(first, 0), load(last, 0)
    for k in range(begin, end):
        here = uniform(float(k))
        p, q, r = load(bulge, 0), load(bulge, 1), load(bulge, 2)
        if k > begin:
            # Inside a window the bulge lies left of the diagonal.
            left = k * row + k - 1
            kept = load(h, left)
            p = where_less(top, here, kept, p)
            q = where_less(top, here, load(h, left + row), q)
            r = where_less(top, here, load(h, left + row + row), r)
        r = where_less(uniform(k + 1.0), bottom, r, zero)
        norm = root(p * p + q * q + r * r)
        norm = where_less(p, zero, -norm, norm)
        works = where_less(here, top, zero, where_less(here, bottom, norm * norm, zero))
        if k > begin:
            moves = where_less(top, here, works, zero)
            store(h, left, where_less(zero, moves, -norm, kept))
            below = load(h, left + row)
            store(h, left + row, where_less(zero, moves, zero, below))
            below = load(h, left + row + row)
            store(h, left + row + row, where_less(zero, moves, zero, below))
        # I - (x, y, z)^T (1, q, r)
        head = p + norm
        inverse = where_less(zero, works, one / (norm * head), zero)
        over_norm, over_head = head * inverse, norm * inverse
        x = head * over_norm
        y, z = q * over_norm, r * over_norm
        q, r = q * over_head, r * over_head
        for at in range(k * row + k, k * row + end + 1):
            a, b, c = load(h, at), load(h, at + row), load(h, at + row + row)
            s = a + q * b + r * c
            store(h, at, a - s * x)
            store(h, at + row, b - s * y)
            store(h, at + row + row, c - s * z)
        for i in range(begin, min(k + 3, end) + 1):
            at = i * row + k
            a, b, c = load(h, at), load(h, at + 1), load(h, at + 2)
            s = a * x + b * y + c * z
            store(h, at, a - s)
            store(h, at + 1, b - s * q)
            store(h, at + 2, c - s * r)


@inlined
def _find_windows(h: Array, n: int, first: Array, last: Array) -> None:
    """Set ``first`` to the top of the unreduced block that ends at ``last``, in every lane."""
    row = n + 1
    zero, epsilon = uniform(0.0), uniform(_EPSILON)
    bottom = load(last, 0) + uniform(0.5)
    top = zero
    above = absolute(load(h, 0))
    for k in range(1, n):
        at = k * row + k
        here = absolute(load(h, at))
        left = load(h, at - 1)
        small = where_less(epsilon * (above + here), absolute(left), zero, uniform(1.0))
        store(h, at - 1, where_less(zero, small, zero, left))
        index = uniform(float(k))
        top = where_less(index * small, bottom, where_less(zero, small, index, top), top)
        above = here
    store(first, 0, top)


@inlined
def _deflate(
    h: Array, n: int, lane: int, begin: int, end: int, bound: float, counts: Any, eigenvalues: Array
) -> None:
    """Take the real eigenvalues of the diagonal block ``begin .. end`` of size one or two."""
    at = (end * (n + 1) + end) * LANES + lane
    near = far = h[at]
    if begin < end:
        half = 0.5 * (h[at - (n + 2) * LANES] - near)
        product = h[at - LANES] * h[at - (n + 1) * LANES]
        square = half * half + product
        if not square >= 0.0:
            return
        span = half + (np.sqrt(square) if half >= 0.0 else -np.sqrt(square))
        far = near + span
        if span != 0.0:
            near -= product / span
    for value in (near, far) if begin < end else (near, np.nan):
        if abs(value) <= bound:
            eigenvalues[counts[lane] * LANES + lane] = value
            counts[lane] += 1


@inlined
def _shift(
    h: Array, n: int, lane: int, begin: int, end: int, exceptional: bool, bulge: Array
) -> None:
    """Write the first column of (H - a)(H - b), with eigenvalues a, b of the window's last 2x2."""
    row = (n + 1) * LANES
    at = (end * (n + 1) + end) * LANES + lane
    up = at - row - LANES
    x, y, w = h[at], h[up], h[at - LANES] * h[at - row]
    if exceptional:
        s = abs(h[at - LANES]) + abs(h[up - LANES])
        x = y = x + 0.75 * s
        w = -0.4375 * s * s
    at = (begin * (n + 1) + begin) * LANES + lane
    z, below = h[at], h[at + row]
    r, s = x - z, y - z
    bulge[lane] = r * s - w + h[at + LANES] * below
    bulge[LANES + lane] = below * (h[at + row + LANES] - z - r - s)
    bulge[2 * LANES + lane] = below * h[at + 2 * row + LANES]


@inlined
def real_eigenvalues(
    h: Array, n: int, bound: float, work: Array, counts: Any, eigenvalues: Array
) -> None:
    """Write the real eigenvalues of absolute value up to ``bound``, in no particular order.

    Args:
        h: Hessenberg matrices of size n; destroyed. One with NaN or infinity has no eigenvalues.
        bound: largest absolute value of interest.
        work: room for 5 values.
        counts: (LANES,) result: how many each lane has.
        eigenvalues: result (n values, of which a lane's first ``counts[lane]`` are set).
    """
    first, last, bulge = work[:LANES], work[LANES : 2 * LANES], work[2 * LANES :]
    total = uniform(0.0)
    for at in range((n + 1) * (n + 1)):
        total = total + load(h, at) * uniform(0.0)
    store(first, 0, total)  # NaN where anything is not finite
    tries = np.zeros(LANES, np.int64)
    for lane in range(LANES):
        last[lane] = n - 1.0 if first[lane] == 0.0 else -1.0
        counts[lane] = 0
    for _ in range(_SWEEPS * n):
        deflated = True
        while deflated:
            deflated = False
            _find_windows(h, n, first, last)
            for lane in range(LANES):
                begin, end = int(first[lane]), int(last[lane])
                if end >= 0 and end - begin < 2:
                    _deflate(h, n, lane, begin, end, bound, counts, eigenvalues)
                    last[lane] = begin - 1.0
                    tries[lane] = 0
                    deflated = True
        waiting = False
        for lane in range(LANES):
            begin, end = int(first[lane]), int(last[lane])
            if end >= 0:
                waiting = True
                tries[lane] += 1
                exceptional = tries[lane] % 10 == 0  # other shifts break a cycle
                _shift(h, n, lane, begin, end, exceptional, bulge)
        if not waiting:
            return
        _sweep(h, n, first, last, bulge)
