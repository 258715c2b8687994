# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Mixtures against samples of them; planes: both leans, and integrals over all of them."""

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
from rs_localizer.core.state import step_between
from rs_localizer.estimation import gaussian
from rs_localizer.estimation.linear_fit import Noise, nothing_shared
from rs_localizer.estimation.points import leaning_less
from rs_localizer.estimation.prior import held_terms

from .frames import alike, fitted, observe
from .projection import disturbed, pixels_of, project

CENTRE = np.array([0.3, -0.2, 3.0])
TURNS, MOVES = np.diag([0.05, 0.03, 0.02]), np.diag([0.001, 0.002, 0.02])


def arched(found):
    return gaussian.along_arcs(found.covariance[:18, :18].copy(), found.state[9:12])


def test_moments_are_those_of_cameras_on_the_arc():
    rng, count = np.random.default_rng(1), 200_000
    deviations = np.array([*TURNS.diagonal(), *MOVES.diagonal()])
    phi, d = np.split(deviations * rng.normal(size=(count, 6)), 2, axis=1)
    moved = CENTRE - Rotation.from_rotvec(phi).apply(CENTRE + d)
    steps = np.hstack([phi, moved])
    expected = steps.T @ steps / count
    by = np.block([[np.eye(3), np.zeros((3, 3))], [np.cross(np.eye(3), CENTRE), -np.eye(3)]])
    first = np.zeros((18, 18))
    first[:6, :6] = by * deviations**2 @ by.T
    found = gaussian.along_arcs(first, CENTRE)[:6, :6]
    alike(found, expected, np.sqrt(expected.diagonal()), atol=0.03)
    # Without second order the line of sight is far off.
    assert first[5, 5] < 0.95 * expected[5, 5]


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
    return gaussian.Gaussians(states, turns, covariances, evidences), first


@pytest.mark.parametrize("temper", [1.0, 0.25])
def test_mean_and_moments_are_by_their_own_weights(parts, temper):
    """So near each other that arcs do not bend: as numbers, a mixture is a sum."""
    given, first = parts
    preferences = np.array([0.0, np.log(7.0), 0.0])
    found = gaussian.mixture(given, preferences, temper)
    probable = np.exp(given.evidences) * [1.0, 7.0, 1.0]
    probable /= probable.sum()
    possible = np.exp(temper * given.evidences)
    possible /= possible.sum()
    np.testing.assert_allclose(found.probable, probable)
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
    alike(found.covariance, expected, np.sqrt(expected.diagonal()), atol=0.02)
    np.testing.assert_allclose(arched(found), found.covariance[:18, :18], atol=1e-12)


def test_a_mixture_of_one_is_itself(parts):
    given, _ = parts
    found = gaussian.mixture(gaussian.Gaussians(*(each[1:2] for each in given)), np.zeros(1), 0.25)
    np.testing.assert_allclose(found.state, given.states[1], atol=1e-12)
    np.testing.assert_allclose(found.turn, given.turns[1])
    np.testing.assert_allclose(found.covariance, given.covariances[1], atol=1e-12)
    assert found.evidence == pytest.approx(given.evidences[1])


def test_cameras_on_an_arc_have_their_mean_on_it():
    """Two views of points 3 m away that differ by a quarter of a radian see them at one place."""
    turns = Rotation.from_rotvec([[0.0, 0.12, 0.0], [0.0, -0.12, 0.0]]).as_matrix()
    states = np.array([[*turn.ravel(), 0.0, 0.0, 3.0, *np.zeros(12)] for turn in turns])
    covariances = np.broadcast_to(1e-8 * np.eye(18), (2, 18, 18)).copy()
    parts = gaussian.Gaussians(states, np.zeros((2, 0)), covariances, np.zeros(2))
    found = gaussian.mixture(parts, np.zeros(2), 1.0)
    np.testing.assert_allclose(found.state[:12], [*np.eye(3).ravel(), 0.0, 0.0, 3.0], atol=1e-9)
    # In the camera's axes it moves by the arc's height, of which the ellipsoid knows nothing. The
    # fourth moment of a Gaussian is three times that of these two.
    height = 3.0 * (1.0 - np.cos(0.12))
    assert found.covariance[5, 5] < 0.1 * height**2
    assert arched(found)[5, 5] == pytest.approx(3.0 * height**2, rel=0.05)


COUNT = 40


def plane_frame(seed, tilt, noise):
    """Points of a plane of 0.2 m at 1.6 m that leans by ``tilt`` deg, seen by a camera at rest."""
    rng = np.random.default_rng(seed)
    points = np.c_[rng.uniform(-0.1, 0.1, (COUNT, 2)), np.zeros(COUNT)]
    points -= np.median(points, axis=0)
    rotation = Rotation.from_euler("x", tilt, degrees=True).as_matrix()
    state = np.concatenate([rotation.ravel(), [0.0, 0.0, 1.6], np.zeros(12)])
    pixels = pixels_of(project(state, points)[0])
    pixels += noise * np.random.default_rng(seed + 1).normal(size=pixels.shape)
    return observe(state, points, noise, seed + 1), points, pixels, state


def beside(points, pixels, rotation, translation, axes):
    """Best squared errors over turns about some axes and moves, and volume of what is left."""

    def errors(step):
        turned = Rotation.from_rotvec(axes.T @ step[: len(axes)]).as_matrix() @ rotation
        seen = points @ turned.T + translation + step[len(axes) :]
        return (pixels_of(seen[:, :2] / seen[:, 2:]) - pixels).ravel()

    fit = least_squares(errors, np.zeros(len(axes) + 3), method="lm", x_scale=0.01)
    return 2.0 * fit.cost, -0.5 * np.linalg.slogdet(fit.jac.T @ fit.jac)[1]


@pytest.mark.parametrize(("tilt", "noise"), [(0.0, 0.5), (12.0, 1.0)])
def test_leans_are_integrated_as_on_a_fine_grid(tilt, noise):
    observations, points, pixels, truth = plane_frame(3, tilt, noise)
    terms = held_terms()
    best = fitted(observations, truth, terms, 4.0)
    assert np.all(best.inliers)
    noise = Noise(best.noise, 1.0, 2.0 * COUNT - best.freedom)
    inliers, smooth = best.inliers, nothing_shared(COUNT)
    seen = gaussian.Frame(observations.packed, points, inliers, smooth, noise, 590.0, 1.6)
    mode, _, _ = gaussian.mode_of(seen, best.state, gaussian.linear_at(seen, best.state), terms)
    found = gaussian.over_leans(seen, mode, terms)
    rotation, translation = mode.state[:9].reshape(3, 3), mode.state[9:12]
    normal, freedom = rotation[:, 2], best.freedom
    across = np.linalg.svd(normal[None])[2][1:]
    grid = np.radians(np.arange(-36.0, 36.1, 2.0 if tilt == 0.0 else 3.0))
    places = np.stack(np.meshgrid(grid, grid, indexing="ij"), axis=-1)
    logarithms = np.empty(places.shape[:2])
    for where in np.ndindex(logarithms.shape):
        turn = Rotation.from_rotvec(places[where] @ across).as_matrix()
        about = (turn @ normal)[None]
        square, volume = beside(points, pixels, turn @ rotation, translation, about)
        # The noise is any: its logarithm is integrated out.
        logarithms[where] = volume - 0.5 * freedom * np.log(square)
    weights = np.exp(logarithms - logarithms.max())
    edges = weights[[0, -1]], weights[:, [0, -1]]
    assert max(edge.max() for edge in edges) < 1e-2
    total = weights.sum()
    mean = np.tensordot(weights, places, 2) / total
    spread = np.sqrt(np.tensordot(weights, (places - mean) ** 2, 2) / total)
    turned = Rotation.from_matrix(found.state[:9].reshape(3, 3) @ rotation.T).as_rotvec()
    np.testing.assert_allclose(across @ turned, mean, atol=0.1 * spread.max())
    deviations = np.sqrt(np.diag(across @ found.covariance[:3, :3] @ across.T))
    np.testing.assert_allclose(deviations, spread, rtol=0.1)
    # More than the Gaussian about the optimum, by as much as the grid says.
    whole = np.log(total) + logarithms.max() + np.log((grid[1] - grid[0]) ** 2 / (2.0 * np.pi))
    square, volume = beside(points, pixels, rotation, translation, np.vstack([normal, across]))
    one = volume - 0.5 * freedom * np.log(square) + 2.0 * np.log(best.noise)
    assert found.evidence - mode.evidence == pytest.approx(whole - one, abs=0.1)


@pytest.mark.parametrize(("third", "fourth"), [(0.0, 0.1), (0.1, 0.0), (-0.05, 0.05)])
def test_a_lean_that_is_nearly_gaussian_has_the_moments_of_its_orders(third, fourth, as_python):
    deviation, axis = 0.05, np.array([0.0, 0.6, 0.8])
    covariance = np.diag(np.r_[np.full(3, 1e-4), np.full(15, 1.0)])
    covariance[:3, :3] += (deviation**2 - 1e-4) * np.outer(axis, axis)
    state = np.concatenate([np.eye(3).ravel(), np.zeros(15)])
    mode = gaussian.Mode(state, covariance, 0.0, 1.0, 1.0, 0.0, 30.0)
    falls = 1.0 - np.array([[fourth + third, fourth - third]])
    found = as_python(gaussian._bent_by)(mode, axis[None], falls, 0.0)
    z = np.linspace(-4.0, 4.0, 2001)
    orders = third * z**3 / 3.0 + fourth * z**4 / 4.5 * (np.abs(z) < 3.0)
    weights = np.exp(orders - 0.5 * z**2)
    mean = weights @ z / weights.sum()
    variance = weights @ (z - mean) ** 2 / weights.sum()
    turned = Rotation.from_matrix(found.states[0, :9].reshape(3, 3)).as_rotvec()
    assert -axis @ turned / deviation == pytest.approx(mean, abs=0.02)
    own = axis @ found.covariances[0, :3, :3] @ axis / deviation**2
    assert own == pytest.approx(variance, abs=0.03)
    evidence = np.log(weights.sum() * (z[1] - z[0]) / np.sqrt(2.0 * np.pi))
    assert found.evidences[0] == pytest.approx(evidence, abs=0.02)


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
