# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from rs_localizer.core.camera import Camera
from rs_localizer.core.shake import (
    CYCLES,
    FUNCTIONS,
    MIDDLE_RATES,
    MIDDLE_VALUES,
    shake_at,
    shake_basis,
)
from rs_localizer.core.shutter import Motion, project_rolling

K = np.array([[400.0, 0.0, 319.5], [0.0, 400.0, 239.5], [0.0, 0.0, 1.0]])
DIRECTIONS = ["top_to_bottom", "bottom_to_top", "left_to_right", "right_to_left"]


def some_motion(seed=0, acceleration=0.0):
    rng = np.random.default_rng(seed)
    return Motion(
        Rotation.random(random_state=seed).as_matrix(),
        np.array([0.1, -0.2, 3.0]),
        0.3 * rng.normal(size=3),
        0.3 * rng.normal(size=3),
        angular_acceleration=acceleration * rng.normal(size=3),
        linear_acceleration=acceleration * rng.normal(size=3),
    )


def centre(motion, tau):
    rotation, translation = motion.at(tau)
    return -rotation.T @ translation


def test_accelerations_are_the_second_derivatives_at_the_middle_row():
    motion, h = some_motion(acceleration=0.5), 1e-4
    bent = (centre(motion, h) - 2 * centre(motion, 0.0) + centre(motion, -h)) / h**2
    np.testing.assert_allclose(motion.rotation @ bent, motion.linear_acceleration, atol=1e-6)
    turns = [Rotation.from_matrix(motion.rotation @ motion.at(t)[0].T).as_rotvec() for t in (h, -h)]
    np.testing.assert_allclose(sum(turns) / h**2, motion.angular_acceleration, atol=1e-6)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_point_is_seen_by_its_own_row(direction):
    camera = Camera(640, 480, K, [-0.2, 0.05, 0.001, 0.0, 0.0], scan_direction=direction)
    motion = some_motion(3)
    points = np.random.default_rng(4).uniform(-1, 1, (30, 3))
    pixels, tau = project_rolling(camera, motion.at_rows, points)

    def mismatch(row_time, point):  # an independent way to the same answer
        rotation, translation = motion.at(row_time)
        return camera.row_time(camera.project((rotation @ point + translation)[None]))[0] - row_time

    seen = 0
    for point, pixel, row_time in zip(points, pixels, tau, strict=True):
        if not camera.inside(pixel[None])[0]:
            continue
        seen += 1
        assert brentq(mismatch, -0.6, 0.6, args=(point,), xtol=1e-12) == pytest.approx(
            row_time, abs=1e-9
        )
        assert camera.row_time(pixel[None])[0] == pytest.approx(row_time, abs=1e-9)
    assert seen > 10


def test_a_point_behind_the_camera_is_seen_by_no_row():
    camera = Camera(640, 480, K)
    motion = Motion(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
    pixels, tau = project_rolling(camera, motion.at_rows, np.array([[0, 0, -2.0], [0, 0, 2.0]]))
    assert np.isnan(pixels[0]).all()
    assert np.isnan(tau[0])
    np.testing.assert_allclose(pixels[1], [319.5, 239.5])


TAUS = [-0.5, -0.21, 0.0, 0.37, 0.5]


def basis(tau):
    values, rates = np.empty(FUNCTIONS), np.empty(FUNCTIONS)
    shake_basis(tau, values, rates)
    return values, rates


def plain(tau):
    """Values (28,) of one cosine and one sine per half-cycle, without value and slope at 0."""
    angle = 2.0 * np.pi * np.arange(0.5, 7.5, 0.5) * tau
    return np.column_stack([np.cos(angle) - 1.0, np.sin(angle) - angle]).ravel()


def test_what_is_taken_away_there_makes_it_whole_waves_again():
    values, slopes = MIDDLE_VALUES, MIDDLE_RATES
    for tau in TAUS:
        angle = 2.0 * np.pi * CYCLES * tau
        waves = np.column_stack([np.cos(angle), np.sin(angle)]).ravel()
        np.testing.assert_allclose(basis(tau)[0] + values + tau * slopes, waves, atol=1e-12)


def test_the_turn_of_many_rows_is_the_sum_of_all_functions():
    rng = np.random.default_rng(0)
    tau, coefficients = rng.uniform(-0.5, 0.5, 9), rng.normal(size=(FUNCTIONS, 3))
    found, h = shake_at(tau, coefficients), 1e-5
    ahead, here, behind = (
        np.array([plain(t + x) for t in tau]) @ coefficients for x in (h, 0.0, -h)
    )
    np.testing.assert_allclose(found[:, :3], here, atol=1e-11)
    np.testing.assert_allclose(found[:, 3:], (ahead - behind) / (2.0 * h), atol=1e-4)
    assert not shake_at(tau, np.zeros((0, 3))).any()
