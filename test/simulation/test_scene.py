# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The room surrounds the way, leaves it free, and has depth."""

import numpy as np

from rs_localizer.simulation.scene import room

WAY = np.stack([np.linspace(-2, 2, 50), np.linspace(0, 1, 50), np.ones(50)], axis=1)


def test_room_surrounds_the_way_and_leaves_it_free():
    points = room(WAY, np.random.default_rng(1), count=4000)
    assert points.shape == (4000, 3)
    assert np.all(points.min(axis=0) < WAY.min(axis=0) - 1.4)
    assert np.all(points.max(axis=0) > WAY.max(axis=0) + 1.4)
    distances = np.linalg.norm(points[:, None] - WAY[None], axis=2).min(axis=1)
    assert distances.min() > 0.7
    assert np.percentile(distances, 90) > 1.8 * np.percentile(distances, 10)
