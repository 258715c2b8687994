# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A gyroscope beside the camera: derivatives, what is found of it, and what is refused."""

from dataclasses import replace

import numpy as np
import projector
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core.camera import Camera
from rs_localizer.trajectory.calibration import calibrate
from rs_localizer.trajectory.gyro import MOUNT, GyroMount, GyroSamples, first_mount
from rs_localizer.trajectory.gyro_terms import GyroTerms
from rs_localizer.trajectory.imu import ImuRecording
from rs_localizer.trajectory.model import State
from rs_localizer.trajectory.observe import Observed
from rs_localizer.trajectory.spline import Layout, Spline

CAMERA = Camera(width=projector.WIDTH, height=projector.HEIGHT, K=projector.K, D=projector.D)
CAMERA_FROM_IMU = Rotation.from_rotvec([0.3, -1.2, 0.7]).as_matrix()
BIAS, OFFSET = np.array([0.02, -0.01, 0.03]), 0.005


def gyroscope(
    rng: np.random.Generator, motion: projector.Motion, seconds: float, shape: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Times (k,) by its own clock and rates (k,3) at 200 Hz, 0.01 rad/s noise."""
    times = np.arange(-0.1, seconds + 0.1, 0.005)
    rates = motion.twist(times)[0] @ CAMERA_FROM_IMU @ (np.eye(3) + shape)
    return times - OFFSET, rates + BIAS + rng.normal(0.0, 0.01, rates.shape)


def spline_of(motion: projector.Motion, seconds: float, spacing: float) -> Spline:
    layout = Layout.over(np.array([[0.0, seconds]]), spacing)
    return Spline(layout, *motion.pose(layout.control_times()))


def test_derivatives_are_those_of_the_errors():
    rng = np.random.default_rng(0)
    motion = projector.Motion.random(rng)
    mount = GyroMount(CAMERA_FROM_IMU, BIAS, 0.003, rng.normal(0.0, 0.05, 6))
    state = State(spline_of(motion, 0.3, 0.05), 0.0, np.zeros(0), np.zeros((0, 3)), np.zeros(0),
                  mount)  # fmt: skip
    samples = GyroSamples(np.linspace(0.05, 0.25, 7), rng.normal(size=(7, 3)), 1.0)
    terms = GyroTerms(samples, state, 0)
    turns, h = terms.look(state), 1e-6

    def errors(step: np.ndarray, controls: np.ndarray) -> np.ndarray:
        moved = replace(state, spline=state.spline.moved(controls), mount=mount.moved(step))
        return terms.look(moved).errors

    count = 6 * len(state.spline.positions)
    for k in range(MOUNT):
        step = h * np.eye(MOUNT)[k]
        numeric = (errors(step, np.zeros(count)) - errors(-step, np.zeros(count))) / (2 * h)
        np.testing.assert_allclose(turns.by_mount[:, :, k], numeric, atol=1e-6)
    for k in range(24):
        for sample, first in enumerate(turns.first):
            step = np.zeros(count)
            step[6 * first + k] = h
            numeric = (errors(np.zeros(MOUNT), step) - errors(np.zeros(MOUNT), -step)) / (2 * h)
            np.testing.assert_allclose(turns.by_controls[sample, :, k], numeric[sample], atol=1e-5)


def test_offset_rotation_and_bias_are_found():
    """An offset of 5 ms to 0.1 ms, although the gyroscope's scales are 1 % off."""
    rng, seconds, readout = np.random.default_rng(3), 3.0, 0.02
    motion = projector.Motion.random(rng)
    frames = projector.record(rng, motion, projector.room(rng), readout=readout, seconds=seconds,
                              count=60)  # fmt: skip
    images = [Observed(round(1e9 * (10.0 + f.stamp)), f.points, f.pixels) for f in frames]
    shape = 0.01 * np.array([[1.0, 0.3, 0.0], [0.3, -1.0, 0.2], [0.0, 0.2, 0.5]])
    times, rates = gyroscope(rng, motion, seconds, shape)
    rates[100] = 50.0  # a message that went wrong
    imu = ImuRecording(np.round(1e9 * (10.0 + times)).astype(np.int64), rates)
    found = calibrate(CAMERA, images, imu=imu)
    mount = found.mount
    assert mount.time_offset_determined
    assert mount.rotation_determined
    assert mount.bias_determined
    assert abs(mount.time_offset - OFFSET) < 1e-4
    assert abs(mount.time_offset - OFFSET) < 4.0 * mount.time_offset_deviation < 2e-4
    assert mount.mount.turned_from(CAMERA_FROM_IMU) < 4.0 * np.linalg.norm(
        mount.rotation_deviations
    )
    assert mount.mount.turned_from(CAMERA_FROM_IMU) < np.radians(0.3)
    assert np.all(np.abs(mount.mount.bias - BIAS) < 4.0 * mount.bias_deviations)
    truth = shape[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]]
    assert np.all(np.abs(mount.mount.shape - truth) < 5.0 * mount.shape_deviations)
    assert mount.noise == pytest.approx(0.01, rel=0.2)
    assert abs(found.readout_time - readout) < 4.0 * found.deviation < 2e-4


def test_a_turn_about_one_axis_leaves_the_rotation_about_it_open():
    """A rotation that is given stands in where the motion says nothing."""
    rng = np.random.default_rng(2)
    motion = projector.Motion.random(rng)
    motion.amplitudes[1:3] = 0.0
    samples = GyroSamples(*gyroscope(rng, motion, 3.0, np.zeros((3, 3))))
    mount = first_mount(samples, spline_of(motion, 3.0, 1 / 30), CAMERA_FROM_IMU)
    assert abs(mount.delay - OFFSET) < 5e-3
    assert mount.turned_from(CAMERA_FROM_IMU) < np.radians(3.0)
