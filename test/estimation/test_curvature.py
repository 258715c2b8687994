# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A camera that may have turned about what it sees is somewhere on an arc, not on its tangent."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.frames.conditions import named
from benchmarks.frames.judged import judge
from rs_localizer.estimation.modes import along_arcs

CENTRE = np.array([0.3, -0.2, 3.0])
TURNS, MOVES = np.diag([0.05, 0.03, 0.02]), np.diag([0.001, 0.002, 0.02])


def hat(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def step_covariance(turn, seen):
    """Of turn and move, of a camera that turns and then sees the centre elsewhere."""
    by = np.block([[np.eye(3), np.zeros((3, 3))], [hat(CENTRE), -np.eye(3)]])
    covariance = np.diag(np.arange(1.0, 19.0))
    covariance[:6, :6] = by @ np.block([[turn, np.zeros((3, 3))], [np.zeros((3, 3)), seen]]) @ by.T
    return covariance


def alone(covariance):
    """One Gaussian, as a mixture."""
    return CENTRE, np.ones(1), np.zeros((1, 18)), covariance[None]


def test_the_second_order_is_that_of_cameras_on_the_arc():
    rng = np.random.default_rng(0)
    turn, seen = TURNS @ TURNS, MOVES @ MOVES
    covariance = step_covariance(turn, seen)
    phi = rng.multivariate_normal(np.zeros(3), turn, 200_000)
    d = rng.multivariate_normal(np.zeros(3), seen, len(phi))
    move = CENTRE - Rotation.from_rotvec(phi).apply(CENTRE + d)
    beyond = move + d + np.cross(phi, CENTRE)
    expected = beyond.T @ beyond / len(phi)
    added = along_arcs(covariance, *alone(covariance)) - covariance
    np.testing.assert_allclose(added[3:6, 3:6], expected, atol=0.05 * np.diag(expected).max())
    added[3:6, 3:6] = 0.0
    assert not np.any(added)  # the turn is what it was, and so is all else


def test_moments_of_a_mixture_are_those_of_cameras_on_the_arc():
    rng = np.random.default_rng(1)
    weights, count = np.array([0.8, 0.2]), 200_000
    middles = np.array([[-0.03, 0.01, 0.0, 0.002, 0.0, 0.01], [0.12, -0.04, 0.02, 0.0, 0.01, 0.0]])
    deviations = np.array([np.diag([*TURNS.diagonal(), *MOVES.diagonal()])] * 2)
    deviations[1] *= 0.5
    which = (np.arange(count) < weights[1] * count).astype(int)
    samples = middles[which] + np.einsum(
        "nij,nj->ni", deviations[which], rng.normal(size=(count, 6))
    )
    phi, d = samples[:, :3], samples[:, 3:]
    moved = CENTRE - Rotation.from_rotvec(phi).apply(CENTRE + d)
    steps = np.hstack([phi, moved])
    expected = steps.T @ steps / count
    by = np.block([[np.eye(3), np.zeros((3, 3))], [hat(CENTRE), -np.eye(3)]])
    offsets, covariances = np.zeros((2, 18)), np.zeros((2, 18, 18))
    offsets[:, :6] = middles @ by.T
    covariances[:, :6, :6] = by @ deviations**2 @ by.T
    both = np.einsum("k,ki,kj->ij", weights, offsets, offsets)
    both += np.tensordot(weights, covariances, 1)
    found = along_arcs(both, CENTRE, weights, offsets, covariances)[:6, :6]
    scale = np.sqrt(expected.diagonal())
    np.testing.assert_allclose(
        found / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.03
    )
    # One Gaussian of these moments is 15 % off along the line of sight.
    assert abs(along_arcs(both, *alone(both))[5, 5] / expected[5, 5] - 1.0) > 0.1


def test_where_the_orientation_is_known_nothing_is_added():
    covariance = step_covariance(1e-8 * np.eye(3), 1e-8 * np.eye(3))
    added = along_arcs(covariance, *alone(covariance)) - covariance
    assert np.abs(added).max() < 1e-6 * covariance[3, 3]


@pytest.mark.bench
def test_regions_before_a_small_tilted_plane_hold_under_motion():
    """Along the ellipsoid's own axes they held in half of the frames."""
    found = judge(named("planes/0.6m/tilt 30/10deg/1px"), 40, 2, {})
    assert np.mean(found.localized) > 0.8
    for moment in ("pose_s", "pose"):
        assert np.mean(found.inside(moment)) >= 0.85
