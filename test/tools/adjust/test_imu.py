# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A gyroscope beside the camera: what is found of it, and what is refused."""

import numpy as np
import projector
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core.camera import Camera
from rs_localizer.io.imu import ImuRecording
from rs_localizer.tools.adjust.observe import ImagePoints
from rs_localizer.tools.camera_calibration import calibrate

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


def test_offset_rotation_and_bias_are_found():
    """An offset of 5 ms to 0.1 ms, although the gyroscope's scales are 1 % off."""
    rng, seconds, readout = np.random.default_rng(3), 3.0, 0.02
    motion = projector.Motion.random(rng)
    frames = projector.record(rng, motion, projector.room(rng), readout=readout, seconds=seconds,
                              count=60)  # fmt: skip
    images = [ImagePoints(round(1e9 * (10.0 + f.stamp)), f.points, f.pixels) for f in frames]
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
