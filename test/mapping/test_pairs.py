"""Which keyframes are compared."""

from __future__ import annotations

import numpy as np

from rs_localizer.features.extraction import Features
from rs_localizer.mapping.pairs import choose_pairs


def features(descriptors: np.ndarray) -> Features:
    count = len(descriptors)
    return Features(np.zeros((count, 2)), np.ones(count), np.ones(count), descriptors)


def scenes(count: int) -> list[Features]:
    """Images of so many places that have nothing in common."""
    rng = np.random.default_rng(0)
    return [features(rng.integers(0, 256, (60, 128)).astype(np.uint8)) for _ in range(count)]


def test_of_few_all_are_compared() -> None:
    assert choose_pairs(scenes(6)) == [(i, j) for i in range(6) for j in range(i + 1, 6)]


def test_of_many_neighbours_are_compared_and_where_the_camera_comes_back() -> None:
    images = scenes(60)
    rng = np.random.default_rng(1)
    again = np.clip(images[3].descriptors + rng.normal(0.0, 4.0, (60, 128)), 0, 255)
    images[50] = features(again.astype(np.uint8))
    pairs = choose_pairs(images)
    assert (3, 50) in pairs
    assert all(j - i <= 8 for i, j in pairs if (i, j) != (3, 50))
    assert {(i, i + 1) for i in range(59)} <= set(pairs)


def test_images_without_features_do_not_matter() -> None:
    images = scenes(40)
    images[20] = features(np.zeros((0, 128), np.uint8))
    assert (12, 20) in choose_pairs(images)
