# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Motions within an image: points by their rows, waves, known rotations, rectified pixels."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from benchmarks.independent.cameras import Camera as TrueCamera
from benchmarks.independent.cameras import Scan
from rs_localizer.core import shake
from rs_localizer.core.camera import Camera
from rs_localizer.core.rotation_prior import NODES, WHOLE, RotationPrior, compensated, parts_of
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.core.so3 import hat

from ..moving import camera_of, shown  # noqa: TID252 - Python has a package "test"

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
    values, rates = np.empty(shake.FUNCTIONS), np.empty(shake.FUNCTIONS)
    shake.shake_basis(tau, values, rates)
    return values, rates


def plain(tau):
    """Values (28,) of one cosine and one sine per half-cycle, without value and slope at 0."""
    angle = 2.0 * np.pi * np.arange(0.5, 7.5, 0.5) * tau
    return np.column_stack([np.cos(angle) - 1.0, np.sin(angle) - angle]).ravel()


def test_what_is_taken_away_there_makes_it_whole_waves_again():
    values, slopes = shake.MIDDLE_VALUES, shake.MIDDLE_RATES
    for tau in TAUS:
        angle = 2.0 * np.pi * shake.CYCLES * tau
        waves = np.column_stack([np.cos(angle), np.sin(angle)]).ravel()
        np.testing.assert_allclose(basis(tau)[0] + values + tau * slopes, waves, atol=1e-12)


def test_the_turn_of_many_rows_is_the_sum_of_all_functions():
    rng = np.random.default_rng(0)
    tau, coefficients = rng.uniform(-0.5, 0.5, 9), rng.normal(size=(shake.FUNCTIONS, 3))
    found, h = shake.shake_at(tau, coefficients), 1e-5
    ahead, here, behind = (
        np.array([plain(t + x) for t in tau]) @ coefficients for x in (h, 0.0, -h)
    )
    np.testing.assert_allclose(found[:, :3], here, atol=1e-11)
    np.testing.assert_allclose(found[:, 3:], (ahead - behind) / (2.0 * h), atol=1e-4)
    assert not shake.shake_at(tau, np.zeros((0, 3))).any()


TAU = np.linspace(-0.8, 0.8, 33)
ROWS = np.linspace(-0.5, 0.5, 7)


def integrated(rate, tau):
    """Rotation (3,3) camera_then_from_camera_at_0 of a body rate."""

    def kinematics(time, rotation):
        return -(hat(rate(time)) @ rotation.reshape(3, 3)).ravel()

    found = solve_ivp(kinematics, (0.0, tau), np.eye(3).ravel(), rtol=1e-12, atol=1e-13)
    return found.y[:, -1].reshape(3, 3)


def known():
    """The rotation with these rates, by its turns at the nodes."""
    shaking = 0.3 * np.column_stack([np.sin(9.0 * TAU), np.cos(5.0 * TAU), 0.4 + TAU])
    spline = CubicSpline(TAU, shaking, bc_type="natural")
    turns = np.array([integrated(spline, tau) for tau in NODES])
    return RotationPrior(*parts_of(turns), np.zeros((WHOLE, WHOLE)), False), spline


def test_rotations_are_the_integral_of_the_rates():
    rotation, spline = known()
    turns, rates = rotation.at_rows(ROWS)
    for tau, turn in zip(ROWS, turns, strict=True):
        np.testing.assert_allclose(turn, integrated(spline, tau), atol=3e-5)
    np.testing.assert_allclose(rates, spline(ROWS), atol=1e-3)


def test_compensated_bearings_are_those_of_the_middle_row():
    rng = np.random.default_rng(1)
    rays, tau = rng.uniform(-0.6, 0.6, (20, 2)), rng.uniform(-0.5, 0.5, 20)
    turn, _ = known()
    by_ray = np.broadcast_to(400.0 * np.eye(2), (20, 2, 2)).copy()
    found, _ = compensated(rays, tau, by_ray, np.zeros(2), turn)
    bearings = np.column_stack([rays, np.ones(20)])
    expected = np.einsum("nji,nj->ni", turn.at_rows(tau)[0], bearings)
    np.testing.assert_allclose(found, expected[:, :2] / expected[:, 2:], atol=1e-14)


def test_derivatives_of_compensated_bearings_by_differences():
    """Noise of the pixel moves the bearing and, with the row time, the turn."""
    (turn, _), gradient, step = known(), np.array([3e-4, 2e-3]), 1e-4
    ray, tau, focal = np.array([0.2, -0.3]), 0.21, 400.0

    def steady(pixel):  # where a pixel's own row time puts its bearing
        later = tau + gradient @ (pixel - focal * ray)
        return compensated(
            pixel[None] / focal, np.array([later]), np.zeros((1, 2, 2)), gradient, turn
        )[0][0]

    steps = step * np.eye(2)
    changes = [steady(focal * ray + one) - steady(focal * ray - one) for one in steps]
    by_pixel = np.array(changes).T / (2.0 * step)
    _, found = compensated(ray[None], np.array([tau]), focal * np.eye(2)[None], gradient, turn)
    np.testing.assert_allclose(found[0] @ by_pixel, np.eye(2), atol=1e-6)


TRUE = TrueCamera(focal=500.0, distortion=(-0.2, 0.05, 1e-3, -1e-3, 0.0))
OMEGA, V = np.array([0.1, -0.25, 0.15]), np.array([0.05, -0.03, 0.08])  # per readout
START = Rotation.from_rotvec([-0.1, -0.2, 0.1])  # map_from_camera
MOTION = rsl.Motion(START.inv().as_matrix(), np.zeros(3), OMEGA, V)
POINTS = np.random.default_rng(0).uniform([-1.0, -0.8, 2.0], [1.0, 0.8, 6.0], (60, 3))


def pose(seconds):
    tau = seconds[:, None] / TRUE.readout_time
    return START * Rotation.from_rotvec(tau * OMEGA), START.apply(tau * V)


def local(points, tau):
    """Points in the camera's axes, each at its row time."""
    rotation, place = pose(TRUE.readout_time * tau)
    return rotation.inv().apply(points - place)


@pytest.mark.parametrize(("tau", "scan"), [(0.0, Scan.DOWN), (-0.5, Scan.LEFT), (0.37, Scan.UP)])
def test_with_depths_pixels_are_exact(tau, scan):
    true = replace(TRUE, scan=scan)
    camera, pixels = camera_of(true), shown(true, pose, POINTS)
    depths = local(POINTS, camera.row_time(pixels))[:, 2]
    expected = camera.project(local(POINTS, np.full(60, tau)))
    rectified = rsl.rectify(camera, MOTION, pixels, depths, tau)
    np.testing.assert_allclose(rectified, expected, atol=1e-4)
    assert np.abs(pixels - expected).max() > 10.0  # there is something to undo


def test_without_depths_it_is_exact_for_what_is_far_away():
    camera, far = camera_of(TRUE), 1e6 * POINTS
    pixels, expected = shown(TRUE, pose, far), camera.project(local(far, np.zeros(60)))
    rectified = rsl.rectify(camera, MOTION, pixels)
    np.testing.assert_allclose(rectified, expected, atol=1e-3)
    np.testing.assert_allclose(rsl.rectify(camera, MOTION, pixels, np.inf), rectified)


def test_combinations_of_vibration_are_those_of_the_build_whatever_lapack_says(monkeypatch):
    """NumPy 2.4 and 2.5 differ in seven signs of these vectors, which kernels hold as they were."""

    def other_svd(matrix, svd=np.linalg.svd, **options):
        left, values, right = svd(matrix, **options)
        signs = np.where(np.arange(len(values)) % 3, 1.0, -1.0)
        return left * signs, values, signs[:, None] * right

    monkeypatch.setattr(np.linalg, "svd", other_svd)
    np.testing.assert_allclose(shake._resolved()[0], shake.COMBINATIONS, rtol=0.0, atol=1e-15)
