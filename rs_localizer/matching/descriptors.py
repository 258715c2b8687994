# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks' descriptors, ready to be searched: binary ones by Hamming, others by L2 distance.

Every search is exact and repeatable. On two cores, 500 descriptors of 32 bytes among 100,000 take
OpenCV's brute-force matcher 0.5 s, and its approximate one gives other matches in every run.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.io.maps.landmarks import Descriptors
from rs_localizer.matching.kernels import (
    Best,
    Near,
    nearest_binary,
    nearest_binary_within,
    nearest_real_within,
)

_WORD_BYTES = 8
_WORDS_AT_ONCE = 4
# Numbers in a block of products of keypoints and landmarks: 32 MB.
_MOST_PRODUCTS = 8_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Nearest:
    """The two nearest landmarks of each keypoint; -1 at an infinite distance: none."""

    distances: Array  # (q,2)
    landmarks: IntArray  # (q,2)

    @classmethod
    def none(cls, count: int) -> Nearest:
        return cls(np.full((count, 2), np.inf), np.full((count, 2), -1, np.int64))


@dataclass(frozen=True, slots=True, eq=False)
class Visible:
    """Landmarks and where they are predicted, in the order of the second coordinate."""

    landmarks: IntArray  # (v,)
    pixels: Array  # (v,2)
    gate: float  # px


class Index(Protocol):
    """A search among the descriptors (n,d) that it was made of.

    Costs are what one core of an AMD EPYC took, in ns: they only decide which search is made, and
    that has to be the same in a replay.
    """

    pair_cost: float  # of a query and a landmark, in the search among all
    candidate_cost: float  # of a landmark that is predicted near a query

    def nearest(self, queries: Descriptors) -> Nearest:
        """Among all of them, for queries (q,d)."""
        ...

    def nearest_within(
        self, queries: Descriptors, pixels: Array, visible: Visible
    ) -> tuple[Nearest, IntArray]:
        """Among those predicted near pixels (q,2); also each one's own nearest query (v,)."""
        ...


class BinaryIndex:
    """Bits, compared by how many of them differ."""

    def __init__(self, descriptors: Descriptors) -> None:
        self.pair_cost, self.candidate_cost = 0.014 * descriptors.shape[1], 100.0
        self._rows = _words(descriptors)
        self._columns = np.ascontiguousarray(self._rows.T)

    def nearest(self, queries: Descriptors) -> Nearest:
        result = Nearest.none(len(queries))
        nearest_binary(_words(queries), self._columns, result.distances, result.landmarks)
        return result

    def nearest_within(
        self, queries: Descriptors, pixels: Array, visible: Visible
    ) -> tuple[Nearest, IntArray]:
        return _within(nearest_binary_within, self._rows, _words(queries), pixels, visible)


class RealIndex:
    """Numbers, compared by their Euclidean distance."""

    def __init__(self, descriptors: Descriptors) -> None:
        width = descriptors.shape[1]
        self.pair_cost, self.candidate_cost = 0.033 * width, 1.8 * width
        self._rows = np.array(descriptors, np.float32)
        with np.errstate(over="ignore"):
            self._squares = np.square(self._rows).sum(axis=1)

    def nearest(self, queries: Descriptors) -> Nearest:
        queries = np.asarray(queries, np.float32)
        result = Nearest.none(len(queries))
        block = max(1, _MOST_PRODUCTS // len(self._rows))
        # What overflows is far away, or nowhere.
        with np.errstate(over="ignore", invalid="ignore"):
            for start in range(0, len(queries), block):
                part = slice(start, start + block)
                products = queries[part] @ self._rows.T
                products *= -2.0
                products += self._squares  # but for a constant of each query
                for column in range(min(2, len(self._rows))):
                    best = products.argmin(axis=1)
                    offsets = queries[part].astype(np.float64) - self._rows[best]
                    result.landmarks[part, column] = best
                    result.distances[part, column] = np.sqrt(np.square(offsets).sum(axis=1))
                    products[np.arange(len(best)), best] = np.inf
        # Rounding of the products may have swapped them.
        order = np.argsort(result.distances, axis=1, kind="stable")
        return Nearest(
            np.take_along_axis(result.distances, order, 1),
            np.take_along_axis(result.landmarks, order, 1),
        )

    def nearest_within(
        self, queries: Descriptors, pixels: Array, visible: Visible
    ) -> tuple[Nearest, IntArray]:
        rows = np.array(queries, np.float32)
        return _within(nearest_real_within, self._rows, rows, pixels, visible)


def make_index(descriptors: Descriptors, *, binary: bool) -> Index:
    """The search for descriptors (n,d) that are bits or numbers."""
    return BinaryIndex(descriptors) if binary else RealIndex(descriptors)


def _within(
    search: Any, rows: NDArray[Any], queries: NDArray[Any], pixels: Array, visible: Visible
) -> tuple[Nearest, IntArray]:
    result, count = Nearest.none(len(queries)), len(visible.landmarks)
    owners = np.full(count, -1, np.int64)
    near = Near(pixels, visible.landmarks, visible.pixels, visible.gate)
    best = Best(result.distances, result.landmarks, np.full(count, np.inf), owners)
    search(queries, rows, near, best)
    return result, owners


def _words(descriptors: Descriptors) -> NDArray[np.uint64]:
    """Bytes (n,d) as words (n,w), w a multiple of four; the bytes that are added are zero."""
    count, width = descriptors.shape
    chunk = _WORD_BYTES * _WORDS_AT_ONCE
    padded = np.zeros((count, -(-width // chunk) * chunk), np.uint8)
    padded[:, :width] = descriptors
    return padded.view(np.uint64)
