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
from rs_localizer.core.lanes.jit import kernel
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
    columns: IntArray  # (6 controls + s,) of the reduced system that the landmark touches, rising
    coupled: Array  # (6 controls + s, 3) W: its rows at these columns
    inverse: Array  # (3,3) V^-1
    slope: Array  # (3,)


@kernel
def make_scratch(rows: Rows) -> Scratch:
    """Room for one landmark."""
    most = CONTROL * rows.controls + rows.values.shape[2] - LOCAL - 4
    return Scratch(
        np.full(rows.controls, -1), np.empty(rows.controls, np.int64), np.empty(most, np.int64),
        np.zeros((most, 3)), np.empty((3, 3)), np.empty(3),
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


@kernel
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
    """Fill the blocks of one landmark; returns how many columns it touches."""
    shared = rows.values.shape[2] - LOCAL - 4
    own, information, slope = LOCAL + shared, np.zeros((3, 3)), scratch.slope
    count = _touch(rows, landmark, scratch)
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
                x = row[own + i]
                slope[i] += x * row[own + 3]
                for j in range(i, 3):
                    information[i, j] += x * row[own + j]
                for a in range(LOCAL):  # the four controls follow each other
                    scratch.coupled[base + a, i] += x * row[a]
                for a in range(shared):
                    scratch.coupled[end + a, i] += x * row[LOCAL + a]
    for i in range(3):
        information[i, i] *= 1.0 + rows.damping
    _invert(information, scratch.inverse)
    for k in range(count):
        scratch.place[scratch.touched[k]] = -1
    return end + shared


@kernel
def _touch(rows: Rows, landmark: int, scratch: Scratch) -> int:
    """List the controls that see a landmark, and clear their rows; returns their number."""
    count = 0
    for k in range(rows.starts[landmark], rows.starts[landmark + 1]):
        first = rows.first[rows.order[k]]
        for c in range(first, first + ORDER):
            if scratch.place[c] < 0:
                scratch.place[c] = count
                scratch.touched[count] = c
                for b in range(CONTROL):
                    scratch.columns[CONTROL * count + b] = CONTROL * c + b
                count += 1
    shared = rows.values.shape[2] - LOCAL - 4
    for a in range(shared):
        scratch.columns[CONTROL * count + a] = CONTROL * rows.controls + a
    scratch.coupled[: CONTROL * count + shared] = 0.0
    return count


@kernel
def eliminate(rows: Rows, part: int, parts: int, system: Array) -> None:
    """Take the landmarks out of the lower triangle of a system (N,N): every ``parts``-th control's
    rows of it, so that threads do not meet.
    """
    scratch = make_scratch(rows)
    inverse, coupled = scratch.inverse, scratch.coupled
    for landmark in range(len(rows.starts) - 1):
        used = gather(rows, landmark, scratch)
        for a in range(used):
            to = scratch.columns[a]
            if (to // CONTROL) % parts != part:
                continue
            x = y = z = 0.0
            for i in range(3):
                w = coupled[a, i]
                x += w * inverse[i, 0]
                y += w * inverse[i, 1]
                z += w * inverse[i, 2]
            row = system[to]
            for b in range(a + 1):
                row[scratch.columns[b]] -= x * coupled[b, 0] + y * coupled[b, 1] + z * coupled[b, 2]


@kernel
def lift(rows: Rows, right: Array, out: Array) -> None:
    """Add ``W V^-1 r`` of right sides (p,3,m) to (N,m)."""
    scratch = make_scratch(rows)
    for landmark in range(len(rows.starts) - 1):
        used, r = gather(rows, landmark, scratch), right[landmark]
        for a in range(used):
            for i in range(3):
                share = 0.0
                for j in range(3):
                    share += scratch.coupled[a, j] * scratch.inverse[j, i]
                for m in range(r.shape[1]):
                    out[scratch.columns[a], m] += share * r[i, m]


@kernel
def lower(rows: Rows, reduced: Array, right: Array) -> None:
    """Turn right sides (p,3,m) into the landmarks' part of the solution, ``V^-1 (r - W^T x)``,
    where ``x`` (N,m) solves the reduced system.
    """
    scratch = make_scratch(rows)
    left = np.empty(3)
    for landmark in range(len(rows.starts) - 1):
        used, r = gather(rows, landmark, scratch), right[landmark]
        for m in range(r.shape[1]):
            for i in range(3):
                left[i] = r[i, m]
                for a in range(used):
                    left[i] -= scratch.coupled[a, i] * reduced[scratch.columns[a], m]
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


@kernel
def covariances(rows: Rows, inverse: Array, part: int, parts: int, out: Array) -> None:
    """Covariances (p,3,3) of every ``parts``-th landmark, ``V^-1 + V^-1 W^T S^-1 W V^-1``, from
    the lower triangle of ``S^-1`` (N,N).
    """
    scratch = make_scratch(rows)
    middle, half = np.empty((3, 3)), np.empty((3, 3))
    coupled, own = scratch.coupled, scratch.inverse
    for landmark in range(part, len(rows.starts) - 1, parts):
        used = gather(rows, landmark, scratch)
        middle[:] = 0.0
        for a in range(used):
            x = y = z = 0.0
            row = inverse[scratch.columns[a]]
            for b in range(a + 1):
                share = row[scratch.columns[b]] * (1.0 if b < a else 0.5)
                x += share * coupled[b, 0]
                y += share * coupled[b, 1]
                z += share * coupled[b, 2]
            for i in range(3):
                middle[i, 0] += coupled[a, i] * x
                middle[i, 1] += coupled[a, i] * y
                middle[i, 2] += coupled[a, i] * z
        for i in range(3):
            for j in range(3):
                half[i, j] = 0.0
                for k in range(3):
                    half[i, j] += own[i, k] * (middle[k, j] + middle[j, k])
        for i in range(3):
            for j in range(3):
                total = own[i, j]
                for k in range(3):
                    total += half[i, k] * own[k, j]
                out[landmark, i, j] = total
