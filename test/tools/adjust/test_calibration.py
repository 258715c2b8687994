# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""CameraCalibration of whole recordings of the tests' own projector, and of the real ones."""

from dataclasses import replace
from functools import cache

import numpy as np
import projector
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.io.imu import ImuRecording
from rs_localizer.tools import verdict
from rs_localizer.tools.adjust.observe import ImagePoints
from rs_localizer.tools.camera_calibration import (
    CameraCalibration,
    calibrate,
    calibrate_either_axis,
    is_turned,
)
from rs_localizer.tools.first_lens import first_lens

CAMERA = projector.make_camera()


@cache
def recording(
    readout: float = 0.02, points: str = "board", turn: float = 0.1, seconds: float = 2.5,
    outliers: float = 0.0, noise: float = 0.1, seed: int = 21, axis: int = 1,
) -> tuple[ImagePoints, ...]:  # fmt: skip
    rng = np.random.default_rng(seed)
    motion = projector.Motion.random(rng, turn, 0.8 * turn)
    landmarks = projector.board() if points == "board" else projector.room(rng)
    frames = projector.record(rng, motion, landmarks, readout=readout, seconds=seconds,
                              noise=noise, outliers=outliers, axis=axis)  # fmt: skip
    return tuple(ImagePoints(round(1e9 * (10.0 + f.stamp)), f.points, f.pixels) for f in frames)


def agrees(found: CameraCalibration, readout: float, least: float) -> None:
    assert found.determined
    assert abs(found.readout_time - readout) < 4.0 * found.deviation
    assert found.deviation < least


@pytest.fixture(scope="module")
def board() -> CameraCalibration:
    return calibrate(CAMERA, list(recording()))


@pytest.fixture(scope="module")
def room() -> CameraCalibration:
    return calibrate(CAMERA, list(recording(points="room", outliers=0.3, noise=0.5)))


@pytest.mark.parametrize("scene", ["board", "room"])
def test_readout_time_and_direction(scene, request):
    found = request.getfixturevalue(scene)
    agrees(found, 0.02, 1e-4)
    assert verdict.scan_direction(found) == "top_to_bottom"
    assert found.jitter == 0.0
    assert verdict.lens_refusal(found) == found.disbelief == ""


def test_a_global_shutter_is_one():
    found = calibrate(CAMERA, list(recording(0.0)))
    assert found.global_shutter
    assert abs(found.readout_time) < 3.0 * found.deviation < 3e-4
    assert verdict.readout_time(found) == 0.0
    assert "global shutter" in " ".join(verdict.remarks(found))
    # Even stamps of a file prove nothing: what turned or re-timed the images has made them.
    processed = replace(found, own_stamps=False)
    assert "no proof of a global shutter" in processed.disbelief
    assert verdict.readout_time(replace(processed, readout_time=0.004)) == 0.004


def test_the_other_axis_is_found_where_rows_seem_to_rotate():
    """A film of a column shutter looks stabilized along the rows, and its lens is far off."""
    found = calibrate_either_axis(CAMERA, list(recording(-0.02, axis=0)), intrinsics=True)
    agrees(found, -0.02, 1e-4)
    assert found.disbelief == ""
    assert found.fit.camera.K[0, 0] == pytest.approx(CAMERA.K[0, 0], rel=2e-3)
    assert "scan_direction: right_to_left" in " ".join(verdict.remarks(found))


def test_a_camera_at_rest_determines_nothing():
    found = calibrate(CAMERA, list(recording(0.02, turn=1e-5, seconds=1.2)))
    assert not found.determined
    assert "not observable" in found.disbelief


def test_irregular_stamps_are_noticed_and_do_little_harm():
    rng = np.random.default_rng(1)
    images = [
        replace(image, stamp_ns=image.stamp_ns + round(3e6 * rng.normal()))
        for image in recording(0.02, seconds=3.0)
    ]
    found = calibrate(CAMERA, images)
    agrees(found, 0.02, 1e-3)
    assert found.stamps.irregular
    assert found.jitter == pytest.approx(3e-3, rel=0.3)
    assert found.processed.startswith("exposures are ")
    assert any("irregular" in remark for remark in verdict.remarks(found))


def test_a_picture_that_is_turned_after_the_fact_makes_parts_disagree():
    """Stabilization: a part of the motion is taken out of the images, more or less of it."""
    images = list(recording(0.02, seconds=1.0)) + [
        replace(image, stamp_ns=image.stamp_ns + 10**10)
        for image in recording(0.008, seconds=1.0, seed=22)
    ]
    found = calibrate(CAMERA, images)
    assert found.stabilised
    assert "stabilization" in found.disbelief
    first, *_ = verdict.table(found, None)  # before figures that look like findings
    assert first.startswith("warning: parts of the recording disagree (")
    assert "is image stabilization on" in first


def smoothed(lasting: float, points: str = "board", seconds: float = 3.0) -> list[ImagePoints]:
    """A film that looks where the camera has looked in the last tenths of a second."""
    rng = np.random.default_rng(1)
    motion = projector.Motion.random(rng, 0.1, 0.08)
    landmarks = projector.board() if points == "board" else projector.room(rng)
    before, images = np.linspace(0.0, 6.0, 61) * max(lasting, 1e-6), []
    for frame in projector.record(rng, motion, landmarks, readout=0.02, seconds=seconds, noise=0.1):
        turns = Rotation.from_matrix(motion.poses(frame.stamp + 0.01 - before)[0])
        back = turns.mean(np.exp(-before / max(lasting, 1e-6))).inv() * turns[0]
        pixels = CAMERA.project(CAMERA.bearings(frame.pixels) @ back.as_matrix().T)
        images.append(ImagePoints(round(1e9 * (10.0 + frame.stamp)), frame.points, pixels))
    return images


@pytest.mark.parametrize("points", ["board", "room"])
@pytest.mark.parametrize("lasting", [0.1, 0.3, 0.0])
def test_a_film_that_follows_a_smooth_orientation_is_known_by_its_rows(lasting, points):
    images = smoothed(lasting, points)
    assert is_turned(replace(CAMERA, readout_time=0.02), images) == (lasting > 0.0)


def test_nothing_fits_the_times_of_images_that_a_stabilizer_turned():
    """That took minutes, and found what no camera does: 5 ms rms."""
    found = calibrate(CAMERA, smoothed(0.3, seconds=2.0))
    assert found.jitter == 0.0
    assert found.processed.startswith("parts of the recording disagree (")
    assert "rows rotate otherwise than images: is image stabilization on" in found.processed


def test_a_film_that_is_known_by_its_rows_is_refused(board):
    found = replace(board, turned=True)
    assert "rows rotate otherwise than images: is image stabilization on" in found.disbelief


@pytest.mark.parametrize("model", ["equidistant", "plumb_bob"])
def test_the_distortion_model_is_that_of_the_lens(model):
    """A fisheye of 150 degrees that shows a board in every direction; and an ordinary lens."""
    rng, flat = np.random.default_rng(2), projector.board(8, 6, 0.05, 0.0)
    camera = CAMERA
    if model == "equidistant":
        K, D = np.diag([240.0, 241.0, 1.0]), np.array([0.02, -0.01, 0.003, 0.0])
        K[:2, 2] = 321.0, 238.0
        camera = replace(camera, K=K, D=D, distortion_model=model)
    images = []
    while len(images) < 16:
        aside = rng.uniform(-1.0, 1.0, 2) * (1.1 if model == "equidistant" else 0.4)
        turn = Rotation.from_rotvec([*rng.normal(0.0, 0.4, 2), rng.uniform(-1.0, 1.0)])
        there = Rotation.from_rotvec([-aside[1], aside[0], 0.0]).apply([0.0, 0.0, 0.45])
        pixels = camera.project(turn.apply(flat) + there) + rng.normal(0.0, 0.1, (len(flat), 2))
        if np.all(camera.inside(pixels)):
            images.append(ImagePoints(10**9 + 10**8 * len(images), flat, pixels))
    found = first_lens(camera.size, images)
    assert found.distortion_model == model
    corner = np.array([[0.8, 0.6]]) if model == "equidistant" else np.array([[0.5, 0.4]])
    np.testing.assert_allclose(found.distort(corner)[0], camera.distort(corner)[0], atol=1.0)


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
    assert all(mount.determined)
    assert abs(mount.time_offset - OFFSET) < 1e-4
    assert abs(mount.time_offset - OFFSET) < 4.0 * mount.time_offset_deviation < 2e-4
    turned = Rotation.from_matrix(CAMERA_FROM_IMU.T @ mount.mount.camera_from_imu).magnitude()
    assert turned < min(4.0 * np.linalg.norm(mount.rotation_deviations), np.radians(0.3))
    assert np.all(np.abs(mount.mount.bias - BIAS) < 4.0 * mount.bias_deviations)
    truth = shape[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]]
    of_shape = np.sqrt(np.diag(found.fit.border_covariance))[-6:]
    assert np.all(np.abs(mount.mount.shape - truth) < 5.0 * of_shape)
    assert mount.noise == pytest.approx(0.01, rel=0.2)
    assert abs(found.readout_time - readout) < 4.0 * found.deviation < 2.5e-4
