"""Following a camera that shakes, against pixels of the tests' own projector."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.frames.conditions import named
from benchmarks.frames.judged import judge
from rs_localizer.config import LocalizerConfig
from rs_localizer.core.camera import Camera
from rs_localizer.estimation.model_error import gain_of_shaking
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.shake_sizes import _share, sizes_and_step
from rs_localizer.estimation.shaking import Scales, follow
from rs_localizer.localizer import assumptions
from rs_localizer.solvers.table import find_solver

from .projection import (
    STILL,
    disturbed,
    gradient,
    jacobian_of,
    pixels_of,
    project,
    row_time,
    scene,
    shake,
)

DIRECTION, NOISE = "top_to_bottom", 0.1
CAMERA = Camera(640, 480, np.diag([590.0, 590.0, 1.0]), readout_time=0.03)
TERMS, ASSUMED = assumptions(CAMERA, LocalizerConfig(), find_solver("r6p_vcwt"))
ROWS = np.linspace(-0.42, 0.42, 41)  # those that see points
CLOSE = np.radians(0.025)  # a quarter of a pixel


def shaken(seed, size, count=100, outliers=0):
    """Observations, state (24,) and coefficients (7,3) of a camera that shakes by ``size`` rad."""
    rng = np.random.default_rng(seed)
    state, points = scene(DIRECTION, seed, count, speed=0.03, acceleration=0.0)
    coefficients = size * rng.normal(size=(7, 3))
    rays, _ = project(state, points, DIRECTION, coefficients)
    off = NOISE * rng.normal(size=rays.shape)
    off[:outliers] = rng.uniform(-60.0, 60.0, (outliers, 2))
    rays += np.linalg.solve(jacobian_of(rays), off[..., None])[..., 0]
    observations = Observations.of(
        points, rays, row_time(pixels_of(rays), DIRECTION), jacobian_of(rays), gradient(DIRECTION)
    )
    return observations, state, coefficients


def followed(observations, state, inliers=None, size=0.003):
    inliers = np.ones(len(observations), dtype=bool) if inliers is None else inliers
    return follow(observations, state, inliers, TERMS, Scales(0.5, size, ASSUMED.shake, 2.0))


def turns(state, coefficients):
    """Orientations camera_from_map at all rows: what anyone may ask of the motion."""
    tau = ROWS[:, None]
    swing = Rotation.from_rotvec(-shake(ROWS, coefficients))
    motion = Rotation.from_rotvec(-tau * state[12:15] - 0.5 * tau**2 * state[18:21])
    return swing * motion * Rotation.from_matrix(state[:9].reshape(3, 3))


@pytest.mark.parametrize("seed", range(3))
def test_the_orientation_is_followed_through_all_rows(seed):
    observations, state, coefficients = shaken(seed, 0.003)
    found = followed(observations, state)
    off = (turns(found.state, found.coefficients) * turns(state, coefficients).inv()).magnitude()
    swing = np.linalg.norm(shake(ROWS, coefficients), axis=1)
    assert np.sqrt(np.mean(off**2)) < min(CLOSE, 0.15 * np.sqrt(np.mean(swing**2)))
    assert found.noise == pytest.approx(NOISE, rel=0.2)
    assert found.agreement < 1.7
    assert found.inliers.all()


def test_points_that_the_motion_alone_loses_come_back_and_outliers_do_not():
    observations, state, _ = shaken(1, 0.003, outliers=15)
    passed_by = np.sqrt(observations.squared_errors(state)) < 2.0
    assert passed_by.sum() < 80
    found = followed(observations, state, passed_by)
    assert found.inliers[15:].mean() > 0.95
    assert found.inliers[:15].sum() <= 2


def test_the_region_holds_pose_and_velocities():
    """Beside the shaking, which is zero with its slope in the middle row: the true state."""
    squared = []
    for seed in range(12):
        observations, state, _ = shaken(seed, 0.003)
        found = followed(observations, state)

        # By differences: which step leads from the estimate to the truth.
        def away(step, found=found, state=state):
            return disturbed(found.state, step)[:18] - state[:18]

        jacobian = np.stack(
            [(away(1e-6 * e) - away(-1e-6 * e)) / 2e-6 for e in np.eye(18)[:12]], axis=1
        )
        step = np.linalg.lstsq(jacobian, -away(np.zeros(18)), rcond=None)[0]
        squared.append(step @ np.linalg.solve(found.covariance[:12, :12], step))
    assert np.median(squared) < 16.0  # 11.3 of twelve parameters
    assert max(squared) < 60.0


def test_a_camera_that_does_not_shake_is_not_said_to():
    observations, state, _ = shaken(2, 0.0)
    found = followed(observations, state, size=ASSUMED.shake)
    off = (turns(found.state, found.coefficients) * turns(state, STILL).inv()).magnitude()
    assert np.sqrt(np.mean(off**2)) < CLOSE


def test_few_points_cannot_tell():
    observations, state, _ = shaken(3, 0.003, count=30)
    assert followed(observations, state) is None


@pytest.mark.parametrize("count", [1, 2, 5, 21])
def test_sizes_are_shared_among_neighbouring_degrees(count):
    found = np.random.default_rng(count).uniform(size=count)
    sizes = np.empty(count)
    _share(found, 0.25, sizes)
    weights = np.array([1.0, 2.0, 3.0, 2.0, 1.0])
    middle = slice(2, -2)
    expected = np.convolve(found, weights)[middle] / np.convolve(np.ones(count), weights)[middle]
    np.testing.assert_allclose(sizes, expected + 0.25)


def gain(observations, state):
    return gain_of_shaking(
        observations.packed, state, observations.row_time_gradient,
        np.ones(len(observations), dtype=bool), TERMS, 22, 2.0 * len(observations) - 12.0, NOISE,
    )  # fmt: skip


def test_one_linear_solve_tells_whether_shaking_may_be_there():
    """A tenth of a pixel of noise, and swings of as much about all axes."""
    still = [gain(*shaken(seed, 0.0, count=250)[:2]) for seed in range(20)]
    assert min(still) >= 0.0
    assert np.mean(np.array(still) > 0.1) < 0.3
    for seed in range(5):
        observations, state, _ = shaken(seed, 0.0005, count=250)
        assert gain(observations, state) > 5.0


def plain_sizes_and_step(columns, errors, prior, sizes, noise, least):
    """Expectation maximization by whole matrices, at coefficients of zero."""
    products, right = columns.T @ columns, columns.T @ errors

    def solved(doubt):
        known = np.diag(np.concatenate([np.zeros(18), np.repeat(1.0 / (doubt * sizes), 3)]))
        known[:18, :18] += prior
        covariance = np.linalg.inv(products / noise**2 + known)
        return covariance @ right / noise**2, covariance

    for _ in range(7):
        step, covariance = solved(1.0)
        squares = (step**2 + np.diag(covariance))[18:].reshape(-1, 3).mean(axis=1)
        left = np.sum((errors - columns @ step) ** 2)
        noise = np.sqrt(left / (len(errors) - np.trace(covariance @ products) / noise**2))
        sizes = np.empty_like(squares)
        _share(squares, least**2, sizes)
    return *solved(2.0), noise, sizes


def test_sizes_step_and_noise_are_those_of_plain_matrices():
    rng = np.random.default_rng(4)
    columns = rng.normal(size=(160, 18 + 3 * 11))
    columns[:, :18] *= 10.0 ** rng.uniform(-2.0, 2.0, 18)
    errors = columns[:, 18:30] @ rng.normal(size=12) + 0.5 * rng.normal(size=160)
    prior = np.diag(rng.uniform(0.0, 1.0, 18))
    sizes = np.full(11, 0.5)
    expected = plain_sizes_and_step(columns, errors, prior, sizes.copy(), 1.0, 0.01)
    step, covariance, noise = sizes_and_step(
        columns.T @ columns, columns.T @ errors, errors @ errors, 160.0, prior, np.zeros(18),
        np.zeros((11, 3)), 1.0, 0.01, sizes,
    )  # fmt: skip
    np.testing.assert_allclose(step, expected[0], rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(covariance, expected[1], rtol=1e-6, atol=1e-12)
    assert noise == pytest.approx(expected[2], rel=1e-8)
    np.testing.assert_allclose(sizes, expected[3], rtol=1e-7)


def test_fast_shaking_that_the_rows_show_is_followed_and_not_refused():
    """A camera at rest before a wrong map explains much of it, but not that rows agree."""
    found = judge(named("sine/0.3deg/100Hz/0.3px"), 15, 1, {})
    assert np.mean(found.localized) > 0.9
    assert np.mean(found.inside("pose")) > 0.7
    assert np.median(found.of("deg")) < 0.03  # deg, of 0.3 that it shakes
