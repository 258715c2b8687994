"""The room surrounds the way, leaves it free, and has depth."""

from __future__ import annotations

import numpy as np

from rs_localizer.simulation.scene import room

WAY = np.stack([np.linspace(-2, 2, 50), np.linspace(0, 1, 50), np.ones(50)], axis=1)


def test_room_surrounds_the_way_and_leaves_it_free() -> None:
    points = room(WAY, np.random.default_rng(1), count=4000)
    assert points.shape == (4000, 3)
    assert np.all(points.min(axis=0) < WAY.min(axis=0) - 1.4)
    assert np.all(points.max(axis=0) > WAY.max(axis=0) + 1.4)
    distances = np.linalg.norm(points[:, None] - WAY[None], axis=2).min(axis=1)
    assert distances.min() > 0.7
    assert np.percentile(distances, 90) > 1.8 * np.percentile(distances, 10)


def test_every_direction_shows_points() -> None:
    bearings = room(WAY, np.random.default_rng(2)) - WAY[25]
    bearings /= np.linalg.norm(bearings, axis=1, keepdims=True)
    directions = np.random.default_rng(3).normal(size=(100, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    assert ((directions @ bearings.T) > np.cos(0.35)).sum(axis=1).min() > 150


def test_same_generator_same_room() -> None:
    one, same, other = (room(WAY, np.random.default_rng(seed), 500) for seed in (7, 7, 8))
    np.testing.assert_array_equal(one, same)
    assert not np.array_equal(one, other)
