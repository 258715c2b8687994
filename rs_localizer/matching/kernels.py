# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Compiled searches for the two landmarks whose descriptors are nearest to each keypoint's.

Binary descriptors come as rows of 64-bit words, four or a multiple of four of them. Results are
written into distances (q,2), infinite before, and indices (q,2), -1 before.
"""

from typing import Any, NamedTuple

import numpy as np

from rs_localizer.core.arrays import (
    Array1,
    Array2,
    IntArray1,
    IntArray2,
    Out,
    SingleArray2,
    WordArray2,
)
from rs_localizer.native import entry, inlined, kernel

_BLOCK = 256  # landmarks whose words stay in the first cache
_FAR = 1 << 30


_PAIRS, _QUADS = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333)
_BYTES, _ONES = np.uint64(0x0F0F0F0F0F0F0F0F), np.uint64(0x0101010101010101)


@kernel
def _count_bits(word: Any) -> Any:
    """Count the set bits of a 64-bit word.

    By sums of neighbouring bits, pairs, quads and bytes, as LLVM knows it: one instruction.
    """
    word = word - ((word >> np.uint64(1)) & _PAIRS)
    word = (word & _QUADS) + ((word >> np.uint64(2)) & _QUADS)
    word = (word + (word >> np.uint64(4))) & _BYTES
    return np.int64((word * _ONES) >> np.uint64(56))


@kernel
def _insert(distance: float, index: int, distances: Any, indices: Any) -> None:
    """Keep the two nearest, the earlier ones at equal distance."""
    if distance < distances[0]:
        distances[1], indices[1] = distances[0], indices[0]
        distances[0], indices[0] = distance, index
    elif distance < distances[1]:
        distances[1], indices[1] = distance, index


@inlined
def _hamming(query: Any, columns: Any, start: int, count: int, distances: Any) -> None:
    """Write the distances of one descriptor (w,) to ``count`` columns of (w,n)."""
    for word in range(0, len(query), 4):
        a, b, c, d = query[word], query[word + 1], query[word + 2], query[word + 3]
        # Slices, not indices into the whole: these loops become vector instructions.
        one = columns[word, start : start + count]
        two = columns[word + 1, start : start + count]
        three = columns[word + 2, start : start + count]
        four = columns[word + 3, start : start + count]
        if word == 0:
            for j in range(count):
                distances[j] = (
                    _count_bits(a ^ one[j])
                    + _count_bits(b ^ two[j])
                    + _count_bits(c ^ three[j])
                    + _count_bits(d ^ four[j])
                )
        else:
            for j in range(count):
                distances[j] += (
                    _count_bits(a ^ one[j])
                    + _count_bits(b ^ two[j])
                    + _count_bits(c ^ three[j])
                    + _count_bits(d ^ four[j])
                )


@entry
def nearest_binary(
    queries: WordArray2, columns: WordArray2, distances: Out[Array2], indices: Out[IntArray2]
) -> None:
    """Find the nearest of all landmarks (w,n) for queries (q,w)."""
    block = np.empty(_BLOCK, np.int64)
    for start in range(0, columns.shape[1], _BLOCK):
        count = min(columns.shape[1] - start, _BLOCK)
        for q in range(len(queries)):
            _hamming(queries[q], columns, start, count, block)
            nearest = np.int64(_FAR)
            for j in range(count):
                nearest = min(nearest, block[j])
            second = distances[q, 1]
            if nearest < second:  # seldom, once some blocks have been seen
                for j in range(count):
                    if block[j] < second:
                        _insert(float(block[j]), start + j, distances[q], indices[q])
                        second = distances[q, 1]


class Near(NamedTuple):
    """Keypoints, and the landmarks that may be near them."""

    pixels: Array2  # (q,2) of the keypoints
    landmarks: IntArray1  # (v,) rows of descriptors
    predicted: Array2  # (v,2) their pixels, in the order of the second coordinate
    gate: float  # px between the two


class BestFound(NamedTuple):
    """Results of a search, which it fills in."""

    distances: Out[Array2]  # (q,2)
    indices: Out[IntArray2]  # (q,2)
    rivals: Out[Array1]  # (v,) distance of the nearest keypoint of each landmark
    owners: Out[IntArray1]  # (v,) and its index


@inlined
def _enter(best: BestFound, near: Near, q: int, k: int, distance: float) -> None:
    _insert(distance, near.landmarks[k], best.distances[q], best.indices[q])
    if distance < best.rivals[k]:
        best.rivals[k], best.owners[k] = distance, q


@inlined
def _is_near(near: Near, q: int, k: int) -> bool:
    u, v = near.pixels[q, 0], near.pixels[q, 1]
    square: float = (near.predicted[k, 0] - u) ** 2 + (near.predicted[k, 1] - v) ** 2
    return not square > near.gate * near.gate


@entry
def nearest_binary_within(
    queries: WordArray2, rows: WordArray2, near: Near, best: BestFound
) -> None:
    """Find the nearest of the landmarks, rows (n,w), that are predicted near the keypoint."""
    lines = near.predicted[:, 1].copy()
    for q in range(len(queries)):
        v = near.pixels[q, 1]
        for k in range(np.searchsorted(lines, v - near.gate), len(lines)):
            if lines[k] > v + near.gate:
                break
            if _is_near(near, q, k):
                row, bits = near.landmarks[k], 0
                for word in range(queries.shape[1]):
                    bits += _count_bits(queries[q, word] ^ rows[row, word])
                _enter(best, near, q, k, float(bits))


@entry
def nearest_real_within(
    queries: SingleArray2, rows: SingleArray2, near: Near, best: BestFound
) -> None:
    """Find the nearest as :func:`nearest_binary_within`, by Euclidean distance of numbers."""
    lines = near.predicted[:, 1].copy()
    for q in range(len(queries)):
        v = near.pixels[q, 1]
        for k in range(np.searchsorted(lines, v - near.gate), len(lines)):
            if lines[k] > v + near.gate:
                break
            if _is_near(near, q, k):
                row, squared = near.landmarks[k], 0.0
                for i in range(queries.shape[1]):
                    squared += (queries[q, i] - rows[row, i]) ** 2
                _enter(best, near, q, k, np.sqrt(squared))


@entry
def in_view(points: Array2, state: Array1, low: Array1, high: Array1, depths: Out[Array1]) -> None:
    """Write the depths (n,) of points (n,3) that some row may see, and 0 for the others.

    A bearing moves by half its change per readout at most, to first order.

    Args:
        state: (18,) rotation, translation, angular and linear velocity of a motion.
        low, high: (2,) bounds of the bearings in the image.
    """
    R, t, w, s = state[:9], state[9:12], state[12:15], state[15:]
    for n in range(len(points)):
        X, Y, Z = points[n, 0], points[n, 1], points[n, 2]
        x = R[0] * X + R[1] * Y + R[2] * Z + t[0]
        y = R[3] * X + R[4] * Y + R[5] * Z + t[1]
        z = R[6] * X + R[7] * Y + R[8] * Z + t[2]
        depths[n] = 0.0
        if z <= 0.0:
            continue
        # Velocity of the point in the camera: -omega x p - v.
        dx = w[2] * y - w[1] * z - s[0]
        dy = w[0] * z - w[2] * x - s[1]
        dz = w[1] * x - w[0] * y - s[2]
        a, b = x / z, y / z
        side, up = 0.5 * abs((dx - a * dz) / z), 0.5 * abs((dy - b * dz) / z)
        if low[0] - side < a < high[0] + side and low[1] - up < b < high[1] + up:
            depths[n] = z


@entry
def move(points: Array2, state: Array1, rows: Array1, moved: Out[Array2]) -> None:
    """Move points (n,3) into the axes of the camera at row times (n,).

    ``exp(-tau [omega]x) (R X + t - tau v)``, the turn about one axis by Rodrigues' formula.

    Args:
        state: (18,) as of :func:`in_view`.
    """
    R, t, w, s = state[:9], state[9:12], state[12:15], state[15:]
    rate = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    a, b, c = (w[0] / rate, w[1] / rate, w[2] / rate) if rate > 0.0 else (0.0, 0.0, 1.0)
    for n in range(len(points)):
        X, Y, Z, tau = points[n, 0], points[n, 1], points[n, 2], rows[n]
        x = R[0] * X + R[1] * Y + R[2] * Z + t[0] - tau * s[0]
        y = R[3] * X + R[4] * Y + R[5] * Z + t[1] - tau * s[1]
        z = R[6] * X + R[7] * Y + R[8] * Z + t[2] - tau * s[2]
        sine, cosine = np.sin(-tau * rate), np.cos(-tau * rate)
        along = (1.0 - cosine) * (a * x + b * y + c * z)
        moved[n, 0] = cosine * x + sine * (b * z - c * y) + along * a
        moved[n, 1] = cosine * y + sine * (c * x - a * z) + along * b
        moved[n, 2] = cosine * z + sine * (a * y - b * x) + along * c
