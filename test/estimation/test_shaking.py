"""Following a camera that shakes, against pixels of the tests' own projector."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.config import LocalizerConfig
from rs_localizer.core.camera import Camera
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.shaking import _share, follow
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
    return follow(observations, state, inliers, TERMS, 0.5, size, ASSUMED.shake, 2.0)


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
