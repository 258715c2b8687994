# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The other pose before a plane."""

import numpy as np
import pytest

from rs_localizer.core import so3
from rs_localizer.estimation.mirror import facing, mirrored

MOTION = np.linspace(0.01, 0.12, 12)  # velocities and accelerations
ALL = np.ones(40, dtype=bool)


def plane(relief=0.0):
    rng = np.random.default_rng(0)
    flat = np.column_stack([rng.uniform(-1, 1, (40, 2)), relief * rng.normal(size=40)])
    return flat + np.array([5.0, 6.0, 7.0])


def state_of(rotation, translation):
    return np.concatenate([rotation.ravel(), translation, MOTION])


@pytest.mark.parametrize("sight", [[0.0, 0.0, 4.0], [1.0, -0.5, 4.0]])
def test_the_mirrored_plane_leans_the_other_way_at_the_same_place(sight):
    sight, points = np.array(sight), plane()
    towards = sight / np.linalg.norm(sight)
    # Facing the line of sight, then leaning by 0.4 rad about an axis across it.
    axis = np.cross(towards, [0.3, 1.0, 0.0])
    axis /= np.linalg.norm(axis)
    facing = so3.exp(np.cross([0, 0, 1.0], towards) / np.linalg.norm(np.cross([0, 0, 1.0], towards))
                     * np.arccos(towards[2])) if towards[2] < 1 else np.eye(3)  # fmt: skip
    rotation = so3.exp(0.4 * axis) @ facing
    centre = points.mean(axis=0)
    other = mirrored(points, ALL, state_of(rotation, sight - rotation @ centre))
    turned = other[:9].reshape(3, 3)
    np.testing.assert_allclose(turned, so3.exp(-0.4 * axis) @ facing, atol=1e-9)
    np.testing.assert_allclose(turned @ centre + other[9:12], sight, atol=1e-9)
    np.testing.assert_array_equal(other[12:], MOTION)


def test_there_is_none_of_a_plane_that_faces_the_camera_and_of_what_is_no_plane():
    rotation = so3.exp(np.array([0.4, 0.0, 0.0]))
    for points, turn in ((plane(), np.eye(3)), (plane(relief=0.3), rotation)):
        centre = points.mean(axis=0)
        assert mirrored(points, ALL, state_of(turn, [0, 0, 4.0] - turn @ centre)) is None
    points = plane(relief=0.01)
    nearly = state_of(rotation, [0, 0, 4.0] - rotation @ points.mean(axis=0))
    assert mirrored(points, ALL, nearly) is not None


def test_only_the_points_that_count_are_the_plane():
    points, rotation = plane(), so3.exp(np.array([0.4, 0.0, 0.0]))
    state = state_of(rotation, [0, 0, 4.0] - rotation @ points.mean(axis=0))
    strewn = np.vstack([points, points[:10] + np.array([0.0, 0.0, 3.0])])
    assert mirrored(strewn, np.ones(50, dtype=bool), state) is None
    counting = np.arange(50) < 40
    np.testing.assert_allclose(
        mirrored(strewn, counting, state), mirrored(points, ALL, state), atol=1e-12
    )
    assert mirrored(strewn, np.zeros(50, dtype=bool), state) is None


def test_half_way_to_the_mirrored_pose_the_plane_faces_the_camera():
    points, rotation = plane(), so3.exp(np.array([0.4, 0.3, 0.0]))
    sight = np.array([1.0, -0.5, 4.0])
    found = facing(points, ALL, state_of(rotation, sight - rotation @ points.mean(axis=0)))
    turned = found[:9].reshape(3, 3)
    across = np.cross(turned[:, 2], sight / np.linalg.norm(sight))
    np.testing.assert_allclose(across, 0.0, atol=1e-9)
    np.testing.assert_allclose(turned @ points.mean(axis=0) + found[9:12], sight, atol=1e-9)
    assert facing(points, ALL, found) is None
