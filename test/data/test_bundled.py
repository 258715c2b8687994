# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What comes with the package can be read and is what its attribution says."""

import cv2
import numpy as np
import pytest

from benchmarks.data import GLOBAL_SHUTTER_TAGS
from rs_localizer import data
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.io.trajectories import read_tum, split_at_gaps
from rs_localizer.settings import build, load_params_file


def test_webcam_recording():
    with open_bag(data.path(data.WEBCAM)) as bag:
        (info, *_) = (message for _, _, message in bag.messages(["/camera_info"]))
        clouds = [read_correspondences(m) for _, _, m in bag.messages(["/correspondences"])]
        images = [message for _, _, message in bag.messages(["/image/compressed"])]
    assert len(clouds) == len(images) == 121
    camera = read_camera_info(info).camera(0.011, "top_to_bottom")
    assert (camera.width, camera.height) == (640, 480)
    first = cv2.imdecode(np.frombuffer(images[0].data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert first.shape == (480, 640)

    residuals = []
    for cloud in clouds:
        assert len(cloud.points) == 24
        _, rotation, translation = cv2.solvePnP(cloud.points, cloud.pixels, camera.K, camera.D)
        seen = cv2.projectPoints(cloud.points, rotation, translation, camera.K, camera.D)[0][:, 0]
        residuals.append(np.sqrt(np.mean(np.sum((seen - cloud.pixels) ** 2, axis=1))))
        assert translation[2, 0] > 0.0
    # A static pose leaves what the rolling shutter bends, about a tenth of a pixel.
    assert 0.10 < np.median(residuals) < 0.125
    assert max(residuals) < 0.35
    # From image to image no corner jumps: the order is the same all along.
    pixels = np.array([cloud.pixels for cloud in clouds])
    assert np.abs(np.diff(pixels, axis=0)).max() < 20.0

    parameters = load_params_file(data.path(data.WEBCAM) / "parameters.yaml")
    assert build(parameters).readout_time == pytest.approx(0.33 / 30, rel=0.01)


def test_hand_motion():
    trajectory = read_tum(data.path(data.HAND_MOTION))
    assert len(trajectory) == 16999
    assert trajectory.stamps_ns[0] == 1_520_531_467_575_280_000
    assert len(split_at_gaps(trajectory)) == 14


def test_global_shutter_tags():
    with open_bag(GLOBAL_SHUTTER_TAGS) as bag:
        (info, *_) = (message for _, _, message in bag.messages(["/camera/camera_info"]))
        clouds = [read_correspondences(m) for _, _, m in bag.messages(["/camera/correspondences"])]
    assert len(clouds) == 450
    camera = read_camera_info(info).camera(0.0, "top_to_bottom")
    assert (camera.width, camera.height, camera.distortion_model) == (1280, 1024, "equidistant")
    residuals = []
    for cloud in clouds[::10]:
        rays = camera.rays(cloud.pixels)
        _, rotation, translation = cv2.solvePnP(cloud.points, rays, np.eye(3), None)
        seen = camera.project(cloud.points @ cv2.Rodrigues(rotation)[0].T + translation.T)
        residuals.append(np.sqrt(np.mean((seen - cloud.pixels) ** 2)))
    # Of each coordinate: all images fit a pose of one instant.
    assert np.median(residuals) < 0.4


def test_everything_is_attributed_and_small():
    root = data.path(".")
    files = [file for file in root.rglob("*") if file.is_file() and file.suffix != ".pyc"]
    assert sum(file.stat().st_size for file in files) < 6_000_000
    for folder in (child for child in root.iterdir() if child.is_dir()):
        if folder.name != "__pycache__":
            text = (folder / "ATTRIBUTION.md").read_text()
            licences = ("CC BY 4.0", "CC0", "Apache License, Version 2.0")
            assert any(licence in text for licence in licences)
