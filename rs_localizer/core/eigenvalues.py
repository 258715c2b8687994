"""Real eigenvalues of many small matrices at once, one matrix per lane.

Householder's reduction to Hessenberg form and Francis' implicit double shifts, as in EISPACK's
``hqr`` (Martin, Peters, Wilkinson, "The QR algorithm for real Hessenberg matrices", Numer. Math.
14, 1970), without eigenvectors. All lanes take part in every sweep; each has its own window and
shifts, and outside of its window its reflections are the identity.

A matrix of size n is stored with row length n + 1, ``(n + 1)^2`` values in all: the row and
column of zeros let a sweep run over the end of its window.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from rs_localizer.core.jit import kernel
from rs_localizer.core.simd import LANES
from rs_localizer.core.so3 import Array
from rs_localizer.core.vectors import load, root, store, uniform, where_less

_EPSILON = 2.0**-52
_SWEEPS = 8  # per eigenvalue of the slowest lane; the usual number is below two


@kernel
def reduce_to_hessenberg(h: Array, n: int, axis: Array) -> None:
    """Similarity transformation to upper Hessenberg form, in place.

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


@kernel
def _sweep(h: Array, n: int, first: Array, last: Array, bulge: Array) -> None:
    """One implicit double shift in the window ``first .. last`` of every lane.

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
        head = p + norm
        inverse = one / norm
        x = where_less(zero, works, head * inverse, zero)
        y = where_less(zero, works, q * inverse, zero)
        z = where_less(zero, works, r * inverse, zero)
        inverse = one / head
        q = where_less(zero, works, q * inverse, zero)
        r = where_less(zero, works, r * inverse, zero)
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


@kernel
def real_eigenvalues(
    h: Array, n: int, bound: float, work: Array, counts: Any, eigenvalues: Array
) -> None:
    """Real eigenvalues of absolute value up to ``bound``, in no particular order.

    Args:
        h: Hessenberg matrices of size n; destroyed. One with NaN or infinity has no eigenvalues.
        bound: largest absolute value of interest.
        work: room for 5 values.
        counts: (LANES,) result: how many each lane has.
        eigenvalues: result (n values, of which a lane's first ``counts[lane]`` are set).
    """
    row = n + 1
    first, last, bulge = work[:LANES], work[LANES : 2 * LANES], work[2 * LANES :]
    tries = np.zeros(LANES, np.int64)
    for lane in range(LANES):
        total = 0.0
        for i in range(n):
            for j in range(max(i - 1, 0), n):
                total += h[(i * row + j) * LANES + lane]
        counts[lane] = 0
        first[lane] = 0.0
        last[lane] = n - 1.0 if np.isfinite(total) else -1.0
    for _ in range(_SWEEPS * n):
        waiting = 0
        for lane in range(LANES):
            end = int(last[lane])
            begin = end
            while end >= 0:
                begin = end
                while begin > 0:
                    at = (begin * row + begin) * LANES + lane
                    up = at - (row + 1) * LANES
                    if abs(h[at - LANES]) <= _EPSILON * (abs(h[at]) + abs(h[up])):
                        h[at - LANES] = 0.0
                        break
                    begin -= 1
                if end - begin > 1:
                    break
                at = (end * row + end) * LANES + lane
                if begin == end:
                    if abs(h[at]) <= bound:
                        eigenvalues[counts[lane] * LANES + lane] = h[at]
                        counts[lane] += 1
                else:
                    up = at - (row + 1) * LANES
                    half = 0.5 * (h[up] - h[at])
                    product = h[at - LANES] * h[at - row * LANES]
                    square = half * half + product
                    if square >= 0.0:
                        far = half + (np.sqrt(square) if half >= 0.0 else -np.sqrt(square))
                        near = h[at] - product / far if far != 0.0 else h[at]
                        for value in (h[at] + far, near):
                            if abs(value) <= bound:
                                eigenvalues[counts[lane] * LANES + lane] = value
                                counts[lane] += 1
                end = begin - 1
                tries[lane] = 0
            last[lane] = end
            first[lane] = begin if end >= 0 else 0.0
            if end < 0:
                continue
            waiting += 1
            tries[lane] += 1
            at = (end * row + end) * LANES + lane
            up = at - (row + 1) * LANES
            x, y, w = h[at], h[up], h[at - LANES] * h[at - row * LANES]
            if tries[lane] % 10 == 0:  # a cycle: any other shifts break it
                s = abs(h[at - LANES]) + abs(h[up - LANES])
                x = y = x + 0.75 * s
                w = -0.4375 * s * s
            at = (begin * row + begin) * LANES + lane
            below = h[at + row * LANES]
            z = h[at]
            r, s = x - z, y - z
            bulge[lane] = r * s - w + h[at + LANES] * below
            bulge[LANES + lane] = below * (h[at + (row + 1) * LANES] - z - r - s)
            bulge[2 * LANES + lane] = below * h[at + (2 * row + 1) * LANES]
        if waiting == 0:
            return
        _sweep(h, n, first, last, bulge)
