import numpy as np
import pytest

from rs_localizer.core.posterior import (
    maximum_a_posteriori,
    noise_deviation,
    weigh_against_rest,
)
from rs_localizer.core.prior import velocity_terms
from rs_localizer.core.ransac import Observations
from rs_localizer.core.refine import step_between

PRIOR = velocity_terms(0.17, 0.1)


@pytest.mark.parametrize("gate", [2.6, 3.5, 8.0])
def test_noise_is_measured_whatever_the_gate_cuts_off(gate):
    errors = np.sum((1.3 * np.random.default_rng(0).normal(size=(200_000, 2))) ** 2, axis=1)
    assert noise_deviation(errors, gate, 0.0) == pytest.approx(1.3, rel=0.03)


def test_noise_counts_the_degrees_of_freedom_and_never_divides_by_none():
    errors = np.full(10, 0.01)
    assert noise_deviation(errors, 10.0, 10.0) == pytest.approx(np.sqrt(0.1 / 10), rel=1e-3)
    assert np.isfinite(noise_deviation(errors, 10.0, 20.0))
    assert noise_deviation(np.zeros(10), 1.0, 0.0) > 0.0
    # Points strewn evenly over the gate show no noise that fits into it.
    strewn = np.linspace(0.0, 4.0, 500)
    assert noise_deviation(strewn, 2.0, 0.0) > 1.9


def observe(scene, speed, noise, count, seed, outliers=0):
    camera, motion, points, _, measured = scene.frame(
        speed=speed, noise=noise, count=count, seed=seed
    )
    rng = np.random.default_rng(seed)
    measured[:outliers] = rng.uniform([0, 0], [639, 479], (outliers, 2))
    rays = camera.rays(measured)
    observations = Observations.of(
        points, rays, camera.row_time(measured), camera.pixel_jacobian(rays),
        camera.row_time_gradient,
    )  # fmt: skip
    return observations, scene.state_of(motion)


def test_inliers_are_those_within_the_noise_even_beyond_the_threshold(scene):
    observations, truth = observe(scene, 0.1, 1.0, 200, 0, outliers=40)
    posterior = maximum_a_posteriori(observations, truth, PRIOR, 2.0)
    # Two pixels would keep 86 % of the true inliers at this noise.
    assert posterior.inliers[40:].mean() > 0.98
    assert posterior.inliers[:40].sum() <= 1
    assert posterior.noise == pytest.approx(1.0, rel=0.1)


def distances(scene, speed, frames, parts, weigh=False):
    """Squared Mahalanobis distances of the error in the given parts of the covariance."""
    result = []
    for seed in range(frames):
        observations, truth = observe(scene, speed, 0.5, 60, seed)
        posterior = maximum_a_posteriori(observations, truth, PRIOR, 2.0)
        if weigh:
            posterior = weigh_against_rest(observations, posterior, PRIOR, None)
        error = step_between(posterior.state, truth)[parts]
        result.append(error @ np.linalg.solve(posterior.covariance[parts, parts], error))
    return np.array(result)


def test_the_covariance_covers_a_moving_camera(scene):
    squared = distances(scene, 0.05, 150, slice(0, 12), weigh=True)
    assert 9.8 < np.median(squared) < 13.2  # 11.34
    assert 0.88 < np.mean(squared < 21.03) < 0.99


def test_at_rest_the_pose_is_as_good_as_with_six_parameters(scene):
    """Pose errors, in units of the six-parameter covariance, are those of six parameters."""
    squared = distances(scene, 0.0, 150, slice(0, 6), weigh=True)
    assert 4.3 < np.median(squared) < 6.6  # 5.35
    assert 0.88 < np.mean(squared < 12.59) < 0.99
    observations, truth = observe(scene, 0.0, 0.5, 60, 0)
    moving = maximum_a_posteriori(observations, truth, PRIOR, 2.0)
    resting = weigh_against_rest(observations, moving, PRIOR, None)
    ratio = np.diag(resting.covariance)[:6] / np.diag(moving.covariance)[:6]
    assert ratio.min() < 0.7
    assert ratio.max() < 1.0
    velocities = resting.state[12:]
    assert velocities @ np.linalg.solve(resting.covariance[6:, 6:], velocities) < 1.0


def test_a_clear_motion_is_left_alone(scene):
    observations, truth = observe(scene, 0.1, 0.5, 60, 1)
    moving = maximum_a_posteriori(observations, truth, PRIOR, 2.0)
    assert weigh_against_rest(observations, moving, PRIOR, None) is moving


def test_slow_motions_are_averaged_without_a_jump_and_covered(scene):
    """Between rest and motion the mixture still covers the truth."""
    for speed in (0.002, 0.005, 0.01):
        squared = distances(scene, speed, 60, slice(0, 12), weigh=True)
        assert np.mean(squared < 21.03) > 0.85, speed
