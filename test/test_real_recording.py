# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The bundled webcam recording: does a real shutter do what the model says, sign and all?"""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import rs_localizer as rsl
from benchmarks.frames.conditions import REST, TRACKED, Condition
from benchmarks.frames.judged import judge
from benchmarks.independent.scenes import Rich
from rs_localizer import data
from rs_localizer.core.rig import Mounts
from rs_localizer.estimation.points import Observations
from rs_localizer.estimation.prior import state_in
from rs_localizer.estimation.projection import linearized
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.tracking import Tracker

# 0.33 of the assumed frame time; the video has no time stamps.
READOUT = 0.33 / 30
MIDDLE_NS = round(0.5e9 * READOUT)
NEIGHBOURS = 0.09  # s between the frames before and after, none left out


@pytest.fixture(scope="module")
def recording():
    """Calibration and clouds."""
    clouds, calibration = [], None
    with open_bag(data.path("webcam_chessboard/recording")) as bag:
        for topic, _, message in bag.messages(("/camera_info", "/correspondences")):
            if topic == "/camera_info":
                calibration = read_camera_info(message)
            else:
                clouds.append(read_correspondences(message))
    return calibration, clouds


def turn_rates(rotations, clouds):
    """Central differences (n-2,3) of rotations (n,3,3), rad/s; NaN where an image was lost."""
    stamps = np.array([cloud.stamp_ns for cloud in clouds])
    seconds = 1e-9 * (stamps[2:] - stamps[:-2])
    turns = Rotation.from_matrix(rotations[:-2] @ np.swapaxes(rotations[2:], 1, 2)).as_rotvec()
    return np.where(seconds < NEIGHBOURS, turns.T / seconds, np.nan).T


def test_the_tracked_twist_is_that_of_the_poses(recording):
    calibration, clouds = recording
    tracker = Tracker(rsl.Localizer(calibration.camera(READOUT, "top_to_bottom")))
    results = [tracker.localize(it.stamp_ns + MIDDLE_NS, it.points, it.pixels) for it in clouds]
    assert all(results)
    assert np.mean([result.tracked for result in results]) > 0.95
    expected = turn_rates(np.array([result.rotation for result in results]), clouds)
    speeds = np.linalg.norm(expected, axis=1)
    fast = speeds > np.nanmedian(speeds)
    x = expected[fast].ravel()
    y = np.array([result.angular_velocity for result in results])[1:-1][fast].ravel() / READOUT
    assert np.corrcoef(x, y)[0, 1] > 0.8
    assert 0.7 < x @ y / (x @ x) < 1.3


def test_corners_lie_where_those_of_other_rows_say(recording):
    calibration, clouds = recording
    camera = calibration.camera(READOUT, "top_to_bottom")
    tracker, squared = Tracker(rsl.Localizer(camera)), []
    for frame, cloud in enumerate(clouds):
        rows = np.arange(len(cloud.points)) // 6  # of the board
        used = (rows + frame) % 2 == 0
        found = tracker.localize(cloud.stamp_ns + MIDDLE_NS, cloud.points[used], cloud.pixels[used])
        points, pixels = cloud.points[~used], cloud.pixels[~used]
        rays, still = camera.rays(pixels), np.zeros((len(pixels), 6))
        observations = Observations.of(
            points, rays, camera.row_time(pixels), camera.pixel_jacobian(rays),
            Mounts.one(camera.row_time_gradient),
        )  # fmt: skip
        errors, by_motion, *_ = linearized(
            observations.packed, len(points), state_in(found, np.zeros(3)), still
        )
        motion = found.joint_covariance[:18, :18]
        spread = by_motion @ motion @ np.swapaxes(by_motion, 1, 2)
        # Twelve corners leave some 14 of their 24 coordinates to the noise.
        noise = 0.5 * 24 / 14 * found.residual_rms**2 + found.model_error**2
        weighed = np.linalg.solve(spread + noise * np.eye(2), errors[..., None])[..., 0]
        squared.append(np.sum(errors * weighed, axis=-1))
    squared = np.concatenate(squared)
    assert np.mean(squared < chi2.ppf(0.95, 2)) > 0.93
    assert 0.9 < np.mean(squared) < 2.4  # 2 are expected, and fx, fy may be off by 0.3 %


def test_a_twist_that_is_a_mean_of_rest_and_motion_is_unknown(recording):
    """OpenCV's poses of the neighbours say how the camera turns; a track begins every 15 images."""
    calibration, clouds = recording
    camera = calibration.camera(READOUT, "top_to_bottom")
    tracker, ratios, alone = Tracker(rsl.Localizer(camera)), [], []
    vectors = [cv2.solvePnP(one.points, one.pixels, camera.K, camera.D)[1] for one in clouds]
    turned = Rotation.from_rotvec(np.squeeze(vectors)).as_matrix()
    for k, true in enumerate(turn_rates(turned, clouds), 1):
        if k % 15 == 1:
            tracker.reset()
        found = tracker.localize(clouds[k].stamp_ns, clouds[k].points, clouds[k].pixels)
        if not found or not np.linalg.norm(true) >= np.radians(10.0):
            continue
        if found.twist_known:
            ratios.append(found.angular_velocity / READOUT @ true / (true @ true))
        else:
            alone.append(not found.tracked)
    assert len(alone) > 1
    assert all(alone)
    assert len(ratios) > 20
    assert min(ratios) > 0.3
    assert np.quantile(ratios, 0.05) > 0.5
    assert np.quantile(ratios, 0.95) < 1.5


def test_at_rest_a_tracked_twist_is_none():
    rest = judge(Condition("x", "rest", REST, Rich(100), 0.3, sequence=TRACKED), 2, 1, {})
    assert rest.localized.all()
    assert np.median(rest.of("deg/s")) < 0.6
    assert rest.of("deg/s").max() < 1.0
