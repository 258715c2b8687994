# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Mixtures of Gaussians about motions, against samples of them."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core.state import step_between
from rs_localizer.estimation.gaussian import Gaussians, along_arcs, mixture, moments

from .projection import disturbed

CENTRE = np.array([0.3, -0.2, 3.0])
TURNS, MOVES = np.diag([0.05, 0.03, 0.02]), np.diag([0.001, 0.002, 0.02])


def hat(v):
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


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
    alone = along_arcs(both, CENTRE, np.ones(1), np.zeros((1, 18)), both[None])
    # One Gaussian of these moments is 15 % off along the line of sight.
    assert abs(alone[5, 5] / expected[5, 5] - 1.0) > 0.1


@pytest.fixture(scope="module")
def parts():
    """Three motions with in-frame turns near each other, and samples of each, as steps."""
    rng = np.random.default_rng(4)
    first = np.concatenate([Rotation.random(random_state=2).as_matrix().ravel(), CENTRE,
                            0.1 * rng.normal(size=12)])  # fmt: skip
    away = 1e-5 * rng.normal(size=(3, 18))
    states = np.array([disturbed(first, step) for step in away])
    halves = 1e-5 * rng.normal(size=(3, 24, 24))
    covariances = halves @ halves.transpose(0, 2, 1)
    turns, evidences = 1e-5 * rng.normal(size=(3, 6)), np.array([-4.0, -5.0, -3.5])
    return Gaussians(states, turns, covariances, evidences), first


@pytest.mark.parametrize("temper", [1.0, 0.25])
def test_mean_and_moments_are_by_their_own_weights(parts, temper):
    """So near each other that arcs do not bend: as numbers, a mixture is a sum."""
    given, first = parts
    preferences = np.array([0.0, np.log(7.0), 0.0])
    found = mixture(given, preferences, temper)
    probable = np.exp(given.evidences) * [1.0, 7.0, 1.0]
    probable /= probable.sum()
    possible = np.exp(temper * given.evidences)
    possible /= possible.sum()
    np.testing.assert_allclose(found.probable, probable)
    np.testing.assert_allclose(found.possible, possible)
    assert found.evidence == pytest.approx(np.log(np.exp(given.evidences).sum()))
    steps = np.array([
        [*step_between(first, state), *turn]
        for state, turn in zip(given.states, given.turns, strict=True)
    ])  # fmt: skip
    mean = probable @ steps
    np.testing.assert_allclose(step_between(first, found.state), mean[:18], atol=1e-8)
    np.testing.assert_allclose(found.turn, mean[18:])
    away = steps - mean
    expected = np.einsum("k,ki,kj->ij", possible, away, away)
    expected += np.tensordot(possible, given.covariances, 1)
    scale = np.sqrt(expected.diagonal())
    np.testing.assert_allclose(
        found.covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.02
    )
    np.testing.assert_allclose(found.along_arcs(), found.covariance[:18, :18], atol=1e-12)


def test_a_mixture_of_one_is_itself(parts):
    given, _ = parts
    found = mixture(Gaussians(*(each[1:2] for each in given)), np.zeros(1), 0.25)
    np.testing.assert_allclose(found.state, given.states[1], atol=1e-12)
    np.testing.assert_allclose(found.turn, given.turns[1])
    np.testing.assert_allclose(found.covariance, given.covariances[1], atol=1e-12)
    assert found.evidence == given.evidences[1]


def test_cameras_on_an_arc_have_their_mean_on_it():
    """Two views of points 3 m away that differ by a quarter of a radian see them at one place."""
    turns = Rotation.from_rotvec([[0.0, 0.12, 0.0], [0.0, -0.12, 0.0]]).as_matrix()
    states = np.array([[*turn.ravel(), 0.0, 0.0, 3.0, *np.zeros(12)] for turn in turns])
    covariances = np.broadcast_to(1e-8 * np.eye(18), (2, 18, 18)).copy()
    parts = Gaussians(states, np.zeros((2, 0)), covariances, np.zeros(2))
    found = mixture(parts, np.zeros(2), 1.0)
    np.testing.assert_allclose(found.state[:12], [*np.eye(3).ravel(), 0.0, 0.0, 3.0], atol=1e-9)
    # In the camera's axes it moves by the arc's height, of which the ellipsoid knows nothing.
    height = 3.0 * (1.0 - np.cos(0.12))
    assert found.covariance[5, 5] < 0.1 * height**2
    assert found.along_arcs()[5, 5] == pytest.approx(height**2, rel=0.05)


def test_moments_are_about_zero():
    rng = np.random.default_rng(0)
    means, covariances, weights = rng.normal(size=(3, 4)), rng.normal(size=(3, 4, 4)), [0.5, 0, 0.5]
    expected = sum(
        w * (c + np.outer(m, m)) for w, m, c in zip(weights, means, covariances, strict=True)
    )
    np.testing.assert_allclose(moments(means, covariances, np.array(weights)), expected)
