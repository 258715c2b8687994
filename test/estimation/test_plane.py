# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The other pose before a plane, and the one between both."""

import numpy as np
import pytest

from rs_localizer.core import so3
from rs_localizer.estimation.points import leaning_less

MOTION = np.linspace(0.01, 0.12, 12)  # velocities and accelerations


def plane():
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-1, 1, (40, 2)), np.zeros(40)])
    return flat + np.array([5.0, 6.0, 7.0])


def seen(points, turn, leans, sight):
    """State (24,) that leans less, of a camera that sees the points' middle there."""
    state = np.concatenate([turn.ravel(), sight - turn @ points[:40].mean(axis=0), MOTION])
    found, other = leaning_less(points, np.ones(len(points), dtype=bool), state, leans)
    assert found
    return other


@pytest.mark.parametrize("leans", [2.0, 1.0])
@pytest.mark.parametrize("sight", [[0.0, 0.0, 4.0], [1.0, -0.5, 4.0]])
def test_the_plane_leans_the_other_way_at_the_same_place_or_faces_the_camera(sight, leans):
    sight, points = np.array(sight), plane()
    towards = sight / np.linalg.norm(sight)
    # Facing the line of sight, then leaning by 0.4 rad about an axis across it.
    axis = np.cross(towards, [0.3, 1.0, 0.0])
    axis /= np.linalg.norm(axis)
    across = np.cross([0.0, 0.0, 1.0], towards)
    facing = so3.exp(across * np.arccos(towards[2]) / max(np.linalg.norm(across), 1e-12))
    other = seen(points, so3.exp(0.4 * axis) @ facing, leans, sight)
    turned = other[:9].reshape(3, 3)
    np.testing.assert_allclose(turned, so3.exp((0.4 - 0.4 * leans) * axis) @ facing, atol=1e-9)
    np.testing.assert_allclose(turned @ points.mean(axis=0) + other[9:12], sight, atol=1e-9)
    np.testing.assert_array_equal(other[12:], MOTION)
