"""Errors and derivatives against the forward projection, which solves for each point's row."""

import numpy as np
import pytest

from rs_localizer.core.shutter import project_rolling
from rs_localizer.estimation import packing, residuals
from rs_localizer.estimation.refine import apply_step

DIRECTIONS = ["top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left"]


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_the_error_is_measured_at_the_row_where_the_model_puts_the_point(scene, direction):
    camera, motion, points, true, measured = scene.frame(
        direction, speed=0.3, noise=0.3, acceleration=0.3
    )
    found = residuals.squared_errors(
        scene.pack(camera, points, measured),
        len(points),
        scene.state_of(motion),
        camera.row_time_gradient,
    )
    expected = np.linalg.norm(measured - true, axis=1)
    # The naive error, with the pose of the measured row, is off by up to a third here.
    np.testing.assert_allclose(np.sqrt(found), expected, rtol=0.02)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_the_jacobian_is_the_finite_difference_of_the_forward_projection(scene, direction):
    camera, motion, points, true, _ = scene.frame(direction, acceleration=0.2)
    state, h = scene.state_of(motion), 1e-5
    columns = []
    for k in range(18):
        ahead, behind = (
            project_rolling(
                camera, scene.motion_of(apply_step(state, sign * h * np.eye(18)[k])).at_rows, points
            )[0]
            for sign in (1, -1)
        )
        columns.append((ahead - behind) / (2 * h))
    jacobian = np.stack(columns, axis=-1)  # (n,2,18)
    information, slope = np.empty((18, 18)), np.empty(18)
    residuals.normal_equations(
        scene.pack(camera, points, true), state, camera.row_time_gradient, 100.0, 0.0,
        2, information, slope,
    )  # fmt: skip
    expected = np.einsum("nci,ncj->ij", jacobian, jacobian)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        information / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-6
    )
    shift = np.array([0.01, -0.02])  # a small error, so that the slope is not zero
    residuals.normal_equations(
        scene.pack(camera, points, true + shift), state, camera.row_time_gradient, 100.0, 0.0,
        2, information, slope,
    )  # fmt: skip
    np.testing.assert_allclose(
        slope / scale, np.einsum("nci,c->i", jacobian, -shift) / scale, atol=1e-3
    )


def test_a_search_looks_at_the_measured_row_and_finds_nearly_the_same_derivatives(scene):
    camera, motion, points, true, measured = scene.frame(noise=1.0)
    state, found = scene.state_of(motion), []
    for pixels, looks, size in ((measured, 1, 12), (measured, 2, 18), (true, 2, 18)):
        information, slope = np.empty((size, size)), np.empty(size)
        residuals.normal_equations(
            scene.pack(camera, points, pixels), state, camera.row_time_gradient, 100.0, 0.0,
            looks, information, slope,
        )  # fmt: skip
        found.append(information[:12, :12])
    once, twice, noise_free = found
    scale = np.sqrt(np.outer(np.diag(noise_free), np.diag(noise_free)))
    assert 1e-5 < np.abs((once - twice) / scale).max() < 0.02
    np.testing.assert_allclose(once / scale, noise_free / scale, atol=0.02)


def test_the_cost_of_a_still_camera_is_that_of_one_that_hardly_moves(scene):
    camera, motion, points, _, measured = scene.frame(speed=0.05, noise=1.0)
    still, creeping = scene.state_of(motion), scene.state_of(motion)
    still[12:], creeping[12:] = 0.0, 1e-12
    points[0] -= 10 * motion.rotation[2]  # behind the camera
    data, gradient = scene.pack(camera, points, measured), camera.row_time_gradient
    cost = residuals.truncated_cost(data, still, gradient, 50.0, np.inf)
    assert 2500 < cost < 2500 * len(points)
    assert cost == pytest.approx(
        residuals.truncated_cost(data, creeping, gradient, 50.0, np.inf), rel=1e-9
    )


def test_the_derivative_by_the_angular_velocity_is_that_of_the_exponential(scene):
    """Large turns, where the right Jacobian of the exponential matters, without the row's part."""
    camera, motion, points, true, _ = scene.frame(speed=0.5, acceleration=0.5)
    state, h, gradient = scene.state_of(motion), 1e-6, np.zeros(2)

    def errors(s):
        rays, tau = camera.rays(true), camera.row_time(true)
        rotations, translations = scene.motion_of(s).at_rows(tau)
        seen = np.einsum("nij,nj->ni", rotations, points) + translations
        by_ray = camera.pixel_jacobian(rays)
        return np.einsum("nij,nj->ni", by_ray, seen[:, :2] / seen[:, 2:] - rays)

    jacobian = np.stack(
        [
            (errors(apply_step(state, h * e)) - errors(apply_step(state, -h * e))) / (2 * h)
            for e in np.eye(18)
        ],
        axis=-1,
    )
    information, slope = np.empty((18, 18)), np.empty(18)
    residuals.normal_equations(scene.pack(camera, points, true), state, gradient, 100.0, 0.0,
                               2, information, slope)  # fmt: skip
    expected = np.einsum("nci,ncj->ij", jacobian, jacobian)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        information / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-7
    )


@pytest.mark.parametrize("softness", [0.0, 1.0])
def test_robust_cost_and_its_slope_belong_together(scene, softness):
    camera, motion, points, _, measured = scene.frame(noise=2.0, seed=5, acceleration=0.2)
    data, gradient = scene.pack(camera, points, measured), np.zeros(2)
    state, scale, h = scene.state_of(motion), 3.0, 1e-6
    information, slope = np.empty((18, 18)), np.empty(18)

    def cost_of(s):
        return residuals.normal_equations(data, s, gradient, scale, softness, 2, information, slope)

    steps = [sign * h * np.eye(18)[k] for k in range(18) for sign in (1, -1)]
    around = [cost_of(apply_step(state, step)) for step in steps]
    cost_of(state)
    for k in range(18):
        derivative = (around[2 * k] - around[2 * k + 1]) / (2 * h)
        assert derivative == pytest.approx(2 * slope[k], rel=1e-3, abs=1.0)


def test_truncated_costs_are_those_of_the_formulas(scene):
    # A search's cost is that of its one look, which knows no accelerations.
    camera, motion, points, _, measured = scene.frame(noise=2.0, seed=5)
    data, state, gradient = (
        scene.pack(camera, points, measured),
        scene.state_of(motion),
        np.zeros(2),
    )
    squared, c2 = residuals.squared_errors(data, len(points), state, gradient), 9.0
    assert (squared > c2).any()
    assert (squared < c2).any()
    truncated = residuals.truncated_cost(data, state, gradient, 3.0, np.inf)
    assert truncated == pytest.approx(np.minimum(squared, c2).sum())
    information, slope = np.empty((18, 18)), np.empty(18)
    tukey = c2 / 3 * (1 - (1 - np.minimum(squared / c2, 1)) ** 3)
    for softness, expected in ((0.0, truncated), (1.0, tukey.sum())):
        assert residuals.normal_equations(
            data, state, gradient, 3.0, softness, 2, information, slope
        ) == pytest.approx(expected)
    bounded = residuals.truncated_cost(data, state, gradient, 3.0, 0.1 * truncated)
    assert 0.1 * truncated <= bounded < truncated


def test_points_behind_the_camera_are_outliers_and_disturb_nothing(scene):
    camera, motion, points, _, measured = scene.frame()
    behind = points.copy()
    depth = (points @ motion.rotation.T + motion.translation)[:, 2]
    behind[0] = points[0] - 2 * depth[0] * motion.rotation[2]
    state, gradient = scene.state_of(motion), camera.row_time_gradient
    data = scene.pack(camera, behind, measured)
    squared = residuals.squared_errors(data, len(points), state, gradient)
    assert np.isinf(squared[0])
    assert squared[1:].max() < 1e-6
    information, slope = np.empty((18, 18)), np.empty(18)
    without = np.empty((18, 18))
    residuals.normal_equations(data, state, gradient, 3.0, 0.0, 2, information, slope)
    residuals.normal_equations(
        scene.pack(camera, points[1:], measured[1:]), state, gradient, 3.0, 0.0, 2, without, slope
    )
    np.testing.assert_allclose(information, without, rtol=1e-9, atol=1e-6)


def test_weights_choose_the_points(scene):
    camera, motion, points, _, measured = scene.frame(noise=1.0)
    state, gradient = scene.state_of(motion), camera.row_time_gradient
    data = scene.pack(camera, points, measured)
    data = packing.weighted(data, (np.arange(len(points)) < 13).astype(float))
    expected = residuals.truncated_cost(
        scene.pack(camera, points[:13], measured[:13]), state, gradient, 1e3, np.inf
    )
    assert residuals.truncated_cost(data, state, gradient, 1e3, np.inf) == pytest.approx(expected)
