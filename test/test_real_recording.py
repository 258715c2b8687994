# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Bundled recordings of a webcam, a phone and a global shutter, against what judges them."""

from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import rs_localizer as rsl
from benchmarks.data import GLOBAL_SHUTTER_TAGS, PHONE, PHONE_GYROSCOPE
from benchmarks.frames.conditions import REST, TRACKED, Condition
from benchmarks.frames.judged import judge
from benchmarks.independent.scenes import Rich
from rs_localizer import data
from rs_localizer.cli.commands import main
from rs_localizer.config import NodeConfig
from rs_localizer.core.rig import Mounts
from rs_localizer.estimation.points import Observations
from rs_localizer.estimation.prior import state_in
from rs_localizer.estimation.projection import linearized
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.io.trajectories import read_twists
from rs_localizer.offline.replay import find_topics, replay
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.pipeline.pose_at_time import twist_at
from rs_localizer.tracking import Tracker

from .moving import squared

# 0.33 of the assumed frame time; the video has no time stamps.
READOUT = 0.33 / 30
MIDDLE_NS = round(0.5e9 * READOUT)
NEIGHBOURS = 0.09  # s between the frames before and after, none left out


@pytest.fixture(scope="module")
def recording():
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


READOUT_TIME = 0.0318
IMAGES, PERIOD = 40, 1.0 / 30.02


def gyroscope_at(middle_rows):
    """Mean turn rates (n,3), deg/s, of images with these middle rows (n,), s."""
    table = np.loadtxt(PHONE_GYROSCOPE)
    during = np.abs(table[:, 0] - middle_rows[:, None]) < 0.5 * READOUT_TIME
    assert during.sum(axis=1).min() >= 12  # 412 Hz
    return np.rad2deg(during @ table[:, 1:] / during.sum(axis=1)[:, None])


def errors_of(found, shift=0.0):
    """Of rates (n,3) at times (n,), deg/s, before the gyroscope so much later."""
    times, rates = found
    return np.linalg.norm(rates - gyroscope_at(times + shift), axis=1)


def twists(out: Path, *settings):
    """Times (n,) s and turn rates (n,3) deg/s that ``replay`` writes."""
    assigned = [word for each in ("pose_time:=mid_frame", *settings) for word in ("-p", each)]
    parameters = str(PHONE / "parameters.yaml")
    assert main(["replay", str(PHONE), "--params", parameters, *assigned, "--out", str(out)]) == 0
    found = read_twists(out / "twists.txt")
    return 1e-9 * found.stamps_ns, np.rad2deg(found.angular)


def slopes(found, truth):
    """What the truth is multiplied with to give the rates about each axis (3,)."""
    return np.sum(found * truth, axis=0) / np.sum(truth**2, axis=0)


@pytest.fixture(scope="module")
def at_once(tmp_path_factory):
    return twists(tmp_path_factory.mktemp("phone") / "out")


def test_tracked_twists_are_those_of_the_gyroscope(at_once):
    times, _ = at_once
    assert len(times) == IMAGES - 1  # no frame before the first one tells its twist
    assert np.linalg.norm(gyroscope_at(times), axis=1).max() > 30.0  # there is something to tell
    assert np.median(errors_of(at_once)) < 3.5
    assert np.percentile(errors_of(at_once), 95) < 10.0


def test_one_image_later_they_are_twice_as_near(tmp_path, at_once):
    times, rates = later = twists(tmp_path / "out", "output_lag:=1")
    # The scale, and all of z, depend on the focal length, which the clip hardly tells.
    assert np.all(np.abs(slopes(rates, gyroscope_at(times)) - 1.0) < [0.2, 0.2, 0.4])
    assert np.median(errors_of(later)) < 0.6 * np.median(errors_of(at_once))


def test_stamps_of_another_image_and_a_reversed_shutter_are_told(tmp_path, at_once):
    """What the first test would miss if it could not fail."""
    for shift in (-PERIOD, PERIOD):
        assert np.median(errors_of(at_once, shift)) > 1.5 * np.median(errors_of(at_once))
    times, rates = twists(tmp_path / "out", "scan_direction:=bottom_to_top", "tracking:=false")
    assert slopes(rates, gyroscope_at(times))[0] < -0.5


# Of 6 dimensions: what 95 % of a chi-squared variable lie below.
REGION = 12.59


def replayed(count, **settings):
    """What the node would publish, a pose of each of so many frames, and what it would say."""
    notices = list[str]()
    localizer = CameraFrames(NodeConfig(**settings), lambda _, text: notices.append(text))
    with open_bag(GLOBAL_SHUTTER_TAGS) as bag:
        answers = replay(bag, find_topics(bag), localizer)
        frames = [found for _, (*_, found) in zip(range(count), answers, strict=False)]
    assert all(frames)
    return frames, notices


def jitter(frames):
    """Second differences of the orientation (deg)."""
    poses = [Rotation.from_matrix(frame.pose.rotation) for frame in frames]
    turns = [(a.inv() * b).as_rotvec() for a, b in pairwise(poses)]
    return np.degrees(np.linalg.norm(np.diff(turns, axis=0), axis=1))


def test_a_global_shutter_stays_one():
    frames, notices = replayed(100, readout_time=0.02)
    assert any("(a global shutter)" in text for text in notices)
    own, p3p = jitter(frames), jitter(replayed(100, solver="p3p")[0])
    # Frame by frame: medians of the same poses differ by a twentieth by chance.
    assert np.median(own / p3p) <= 1.05
    assert np.quantile(own, 0.95) <= 1.05 * np.quantile(p3p, 0.95)
    still = []
    for frame in frames:
        twist = twist_at(frame.estimate, 0.0, 1.0)  # per readout
        velocities = np.concatenate([twist.linear, twist.angular])
        still.append(not velocities.any() or squared(velocities, twist.covariance) < REGION)
    assert np.mean(still) >= 0.99
