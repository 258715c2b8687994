"""Which pairs of keyframes are worth comparing.

Neighbours in time show the same place. Others do where the camera comes back: a few features of
each tell them (C. Wu, Towards linear-time incremental structure from motion, 3DV 2013, section 3,
does so with the largest ones).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rs_localizer.features.extraction import Features

Pair = tuple[int, int]
# Keyframes that are matched with each one, in both directions of time, and the most likely others.
_NEIGHBOURS, _OTHERS = 8, 5
# With so few keyframes, each is matched with each.
_FEW = 24
# Features of an image that stand for all, and how many of them another one must show again.
_SOME, _LEAST_COMMON = 400, 10
_RATIO = 0.8


def choose_pairs(features: Sequence[Features]) -> list[Pair]:
    """Pairs ``i < j`` of images in the order of time, by their features."""
    count = len(features)
    reach = count if count <= _FEW else _NEIGHBOURS
    chosen = {(i, j) for i in range(count) for j in range(i + 1, min(i + reach + 1, count))}
    some = [_best(each) for each in features]
    for i in range(count):
        others = [j for j in range(count) if abs(i - j) > reach]
        likely = sorted((-_common(some[i], some[j]), j) for j in others)[:_OTHERS]
        chosen |= {(min(i, j), max(i, j)) for less, j in likely if -less >= _LEAST_COMMON}
    return sorted(chosen)


def _best(features: Features) -> NDArray[np.float32]:
    """Descriptors of unit length of the features with the highest scores."""
    order = np.argsort(-features.scores, kind="stable")[:_SOME]
    rows = features.descriptors[order].astype(np.float32)
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.maximum(lengths, 1e-6), np.float32)


def _common(one: NDArray[np.float32], other: NDArray[np.float32]) -> int:
    """How many features of the one are found again clearly in the other."""
    if min(len(one), len(other)) < 2:
        return 0
    likeness = one @ other.T
    two = np.partition(likeness, -2, axis=1)[:, -2:]
    squared = np.maximum(2.0 - 2.0 * two, 0.0)
    clear = squared[:, 1] < _RATIO**2 * squared[:, 0]
    mutual = likeness.argmax(axis=0)[likeness.argmax(axis=1)] == np.arange(len(one))
    return int(np.count_nonzero(clear & mutual))
