# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks taken out of the normal equations of a map, compiled (Schur complement).

With the landmarks' 3x3 blocks V, the derivatives W of controls and shared numbers by landmarks and
the rest H, the reduced system is ``H - W V^-1 W^T`` (Triggs et al., *Bundle adjustment: a modern
synthesis*, 1999, section 6). Of a keypoint only its whitened row is kept: 24 controls, shared
numbers, 3 of its landmark and the error.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.trajectory.sight_kernels import Curve, Sights, Terms, differentiate, make_row
from rs_localizer.trajectory.spline_kernels import CONTROL, LOCAL, ORDER


class Rows(NamedTuple):
    """Whitened derivatives of all keypoints, and the landmarks that they show."""

    values: Array  # (n,2,24 + s + 3 + 1): controls, shared numbers, landmark, error
    first: IntArray  # (n,) first of the four controls
    order: IntArray  # (n,) keypoints by landmark, those of each by ``first``
    starts: IntArray  # (p + 1,) where each landmark begins in ``order``
    precisions: Array  # (p,) 1/m^2, of what is known of the landmarks beforehand
    offsets: Array  # (p,3) m, how far they are from that
    controls: int
    damping: float  # the diagonal of V is multiplied by 1 + this


class Scratch(NamedTuple):
    """What is computed of one landmark after the other."""

    place: IntArray  # (controls,) of a control among those that see the landmark; -1: does not
    touched: IntArray  # (controls,) these, rising
    # (3, controls + 1) runs of columns of the reduced system that the landmark touches: where in
    # ``coupled`` a run begins and where the next one does, and its first column.
    runs: IntArray
    coupled: Array  # (3, 6 controls + s) W^T at these columns
    inverse: Array  # (3,3) V^-1
    slope: Array  # (3,)


@kernel
def make_scratch(rows: Rows) -> Scratch:
    """Room for one landmark."""
    most = CONTROL * rows.controls + rows.values.shape[2] - LOCAL - 4
    return Scratch(
        np.full(rows.controls, -1), np.empty(rows.controls, np.int64),
        np.empty((3, rows.controls + 1), np.int64), np.zeros((3, most)), np.empty((3, 3)),
        np.empty(3),
    )  # fmt: skip


@kernel
def record(curve: Curve, sights: Sights, terms: Terms, values: Array) -> None:
    """Fill the whitened rows of keypoints; zeros for those that do not count."""
    row = make_row(sights, terms)
    shared = row.by_shared.shape[1]
    for n in range(len(sights.first)):
        weight, _ = differentiate(curve, sights, terms, n, row)
        scale = np.sqrt(weight)
        if weight == 0.0:
            values[n] = 0.0
            continue
        for r in range(2):
            out = values[n, r]
            for k in range(LOCAL):
                out[k] = scale * row.by_controls[r, k]
            for k in range(shared):
                out[LOCAL + k] = scale * row.by_shared[r, k]
            for k in range(3):
                out[LOCAL + shared + k] = scale * row.by_landmark[r, k]
            out[LOCAL + shared + 3] = scale * row.error[r]


@inlined
def _invert(a: Array, out: Array) -> None:
    """Inverse of a symmetric positive (3,3) matrix."""
    c00 = a[1, 1] * a[2, 2] - a[1, 2] * a[1, 2]
    c01 = a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2]
    c02 = a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]
    share = 1.0 / (a[0, 0] * c00 + a[0, 1] * c01 + a[0, 2] * c02)
    out[0, 0] = share * c00
    out[0, 1] = out[1, 0] = share * c01
    out[0, 2] = out[2, 0] = share * c02
    out[1, 1] = share * (a[0, 0] * a[2, 2] - a[0, 2] * a[0, 2])
    out[1, 2] = out[2, 1] = share * (a[0, 1] * a[0, 2] - a[0, 0] * a[1, 2])
    out[2, 2] = share * (a[0, 0] * a[1, 1] - a[0, 1] * a[0, 1])


@kernel
def gather(rows: Rows, landmark: int, scratch: Scratch) -> int:
    """Fill the blocks of one landmark; returns the number of runs of columns that it touches."""
    shared = rows.values.shape[2] - LOCAL - 4
    own, information, slope = LOCAL + shared, np.zeros((3, 3)), scratch.slope
    count, runs = _touch(rows, landmark, scratch, shared)
    end = CONTROL * count
    for i in range(3):
        information[i, i] = rows.precisions[landmark]
        slope[i] = rows.precisions[landmark] * rows.offsets[landmark, i]
    for k in range(rows.starts[landmark], rows.starts[landmark + 1]):
        n = rows.order[k]
        base = CONTROL * scratch.place[rows.first[n]]
        for r in range(2):
            row = rows.values[n, r]
            for i in range(3):
                x, coupled = row[own + i], scratch.coupled[i]
                slope[i] += x * row[own + 3]
                for j in range(i, 3):
                    information[i, j] += x * row[own + j]
                for a in range(LOCAL):  # the four controls follow each other
                    coupled[base + a] += x * row[a]
                for a in range(shared):
                    coupled[end + a] += x * row[LOCAL + a]
    for i in range(3):
        information[i, i] *= 1.0 + rows.damping
    _invert(information, scratch.inverse)
    for k in range(count):
        scratch.place[scratch.touched[k]] = -1
    return runs


@inlined
def _touch(rows: Rows, landmark: int, scratch: Scratch, shared: int) -> tuple[int, int]:
    """List the controls that see a landmark, and clear what couples it with them; returns their
    number, and that of their runs and of the shared numbers' one.
    """
    count = runs = 0
    starts, ends, columns = scratch.runs
    for k in range(rows.starts[landmark], rows.starts[landmark + 1]):
        first = rows.first[rows.order[k]]
        for c in range(first, first + ORDER):
            if scratch.place[c] >= 0:
                continue
            if count == 0 or scratch.touched[count - 1] != c - 1:
                starts[runs], columns[runs] = CONTROL * count, CONTROL * c
                runs += 1
            scratch.place[c] = count
            scratch.touched[count] = c
            count += 1
            ends[runs - 1] = CONTROL * count
    if count and shared:
        starts[runs], ends[runs] = CONTROL * count, CONTROL * count + shared
        columns[runs] = CONTROL * rows.controls
        runs += 1
    scratch.coupled[:, : CONTROL * count + shared] = 0.0
    return count, runs


@kernel
def eliminate(rows: Rows, sequence: IntArray, part: int, parts: int, system: Array) -> None:
    """Take the landmarks out of the lower triangle of a system (N,N): every ``parts``-th control's
    rows of it, so that threads do not meet.

    Args:
        sequence: (p,) the landmarks, those that the same images see behind each other: what they
            touch of a large system is then still at hand.
    """
    scratch = make_scratch(rows)
    inverse, coupled = scratch.inverse, scratch.coupled
    starts, ends, columns = scratch.runs
    for landmark in sequence:
        runs = gather(rows, landmark, scratch)
        for mine in range(runs):
            for a in range(starts[mine], ends[mine]):
                to = columns[mine] + a - starts[mine]
                if (to // CONTROL) % parts != part:
                    continue
                x = y = z = 0.0
                for i in range(3):
                    x += coupled[i, a] * inverse[i, 0]
                    y += coupled[i, a] * inverse[i, 1]
                    z += coupled[i, a] * inverse[i, 2]
                for other in range(mine + 1):
                    start, end = starts[other], min(ends[other], a + 1)
                    row = system[to, columns[other] : columns[other] + end - start]
                    u, v, w = coupled[0, start:end], coupled[1, start:end], coupled[2, start:end]
                    for b in range(end - start):
                        row[b] -= x * u[b] + y * v[b] + z * w[b]


@kernel
def lift(rows: Rows, right: Array, out: Array) -> None:
    """Add ``W V^-1 r`` of right sides (p,3,m) to (N,m)."""
    scratch = make_scratch(rows)
    starts, ends, columns = scratch.runs
    share = np.empty(3)
    for landmark in range(len(rows.starts) - 1):
        runs, r = gather(rows, landmark, scratch), right[landmark]
        for m in range(r.shape[1]):
            for i in range(3):
                share[i] = 0.0
                for j in range(3):
                    share[i] += scratch.inverse[i, j] * r[j, m]
            for run in range(runs):
                for a in range(starts[run], ends[run]):
                    to = columns[run] + a - starts[run]
                    for i in range(3):
                        out[to, m] += scratch.coupled[i, a] * share[i]


@kernel
def lower(rows: Rows, reduced: Array, right: Array) -> None:
    """Turn right sides (p,3,m) into the landmarks' part of the solution, ``V^-1 (r - W^T x)``,
    where ``x`` (N,m) solves the reduced system.
    """
    scratch = make_scratch(rows)
    starts, ends, columns = scratch.runs
    left = np.empty(3)
    for landmark in range(len(rows.starts) - 1):
        runs, r = gather(rows, landmark, scratch), right[landmark]
        for m in range(r.shape[1]):
            for i in range(3):
                left[i] = r[i, m]
            for run in range(runs):
                for a in range(starts[run], ends[run]):
                    x = reduced[columns[run] + a - starts[run], m]
                    for i in range(3):
                        left[i] -= scratch.coupled[i, a] * x
            for i in range(3):
                r[i, m] = 0.0
                for j in range(3):
                    r[i, m] += scratch.inverse[i, j] * left[j]


@kernel
def slopes(rows: Rows, out: Array) -> None:
    """Derivatives (p,3) of half the cost by the landmarks."""
    scratch = make_scratch(rows)
    for landmark in range(len(rows.starts) - 1):
        gather(rows, landmark, scratch)
        out[landmark] = scratch.slope


@inlined
def _within(scratch: Scratch, runs: int, inverse: Array, out: Array) -> None:
    """``W^T S^-1 W`` (3,3), by the lower triangle of ``S^-1``: what lies beside its diagonal
    counts twice.
    """
    coupled = scratch.coupled
    starts, ends, columns = scratch.runs
    half = np.zeros((3, 3))
    for mine in range(runs):
        for a in range(starts[mine], ends[mine]):
            x = y = z = 0.0
            line = inverse[columns[mine] + a - starts[mine]]
            for other in range(mine + 1):
                start, end = starts[other], min(ends[other], a + 1)
                row = line[columns[other] : columns[other] + end - start]
                u, v, w = coupled[0, start:end], coupled[1, start:end], coupled[2, start:end]
                for b in range(end - start):
                    x += row[b] * u[b]
                    y += row[b] * v[b]
                    z += row[b] * w[b]
            own = 0.5 * line[columns[mine] + a - starts[mine]]
            for i in range(3):
                half[i, 0] += coupled[i, a] * (x - own * coupled[0, a])
                half[i, 1] += coupled[i, a] * (y - own * coupled[1, a])
                half[i, 2] += coupled[i, a] * (z - own * coupled[2, a])
    for i in range(3):
        for j in range(3):
            out[i, j] = half[i, j] + half[j, i]


@kernel
def covariances(rows: Rows, sequence: IntArray, inverse: Array, out: Array) -> None:
    """Fill the covariances (p,3,3) of some landmarks, ``V^-1 + V^-1 W^T S^-1 W V^-1``, from the
    lower triangle of ``S^-1`` (N,N); ``sequence`` as for :func:`eliminate`.
    """
    scratch = make_scratch(rows)
    middle, own = np.empty((3, 3)), scratch.inverse
    for landmark in sequence:
        runs = gather(rows, landmark, scratch)
        _within(scratch, runs, inverse, middle)
        for i in range(3):
            for j in range(3):
                total = own[i, j]
                for k in range(3):
                    for m in range(3):
                        total += own[i, k] * middle[k, m] * own[m, j]
                out[landmark, i, j] = total
