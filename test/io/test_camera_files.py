# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Calibration files of other programs, and what is none."""

import cv2
import numpy as np
import pytest

from rs_localizer.core.camera import Camera
from rs_localizer.io.camera_files import (
    CalibrationError,
    lens_camera,
    lens_parameters,
    read_calibration,
)

ROS = """
image_width: 640
image_height: 480
camera_name: webcam
camera_matrix: {rows: 3, cols: 3, data: [500.0, 0, 320.5, 0, 510.0, 240.5, 0, 0, 1]}
distortion_model: rational_polynomial
distortion_coefficients: {rows: 1, cols: 8, data: [1, 2, 3, 4, 5, 6, 7, 8]}
"""
GYROFLOW = """{"calib_dimension": {"w": 640, "h": 480}, "orig_dimension": {"w": 64, "h": 48},
 "fisheye_params": {"camera_matrix": [[500, 0, 320.5], [0, 510, 240.5], [0, 0, 1]],
 "distortion_coeffs": [0.1, 0.2, 0.3, 0.4]}, "frame_readout_time": 9.6}"""

KALIBR = """
cam0:
  camera_model: pinhole
  intrinsics: [500.0, 510.0, 320.5, 240.5]
  distortion_model: equidistant
  distortion_coeffs: [0.1, 0.2, 0.3, 0.4]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
"""
COLMAP = """# Camera list with one line of data per camera:
#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]
1 {} 640 480 {}
"""
JSON = '{"K": [[500, 0, 320.5], [0, 510, 240.5], [0, 0, 1]], "D": [[0.1, 0.2, 0, 0]], %s}'
FIVE = [0.1, -0.2, 1e-3, 2e-3, 0.3]


@pytest.mark.parametrize(
    ("text", "model", "D"),
    [
        (KALIBR, "equidistant", [0.1, 0.2, 0.3, 0.4]),
        (KALIBR.replace("equidistant", "radtan"), "plumb_bob", [0.1, 0.2, 0.3, 0.4]),
        (ROS, "rational_polynomial", [1, 2, 3, 4, 5, 6, 7, 8]),
        (GYROFLOW, "equidistant", [0.1, 0.2, 0.3, 0.4]),
        (COLMAP.format("SIMPLE_RADIAL_FISHEYE", "500 321 241 .1"), "equidistant", [0.1, 0, 0, 0]),
        # COLMAP's first pixel has its corner at 0, 0; its order has the tangential ones third.
        (COLMAP.format("OPENCV", "500 510 321 241 .1 .2 .3 .4"), "plumb_bob",
         [0.1, 0.2, 0.3, 0.4, 0]),
        (COLMAP.format("PINHOLE", "500 510 321 241"), "plumb_bob", []),
        (COLMAP.format("OPENCV_FISHEYE", "500 510 321 241 .1 .2 .3 .4"), "equidistant",
         [0.1, 0.2, 0.3, 0.4]),
        (COLMAP.format("FULL_OPENCV", "500 510 321 241 1 2 3 4 5 6 7 8"), "rational_polynomial",
         [1, 2, 3, 4, 5, 6, 7, 8]),
        (JSON % '"width": 640, "height": 480', "plumb_bob", [0.1, 0.2, 0, 0]),
        (JSON % '"image_size": [640, 480], "distortion_model": "fisheye"', "equidistant",
         [0.1, 0.2, 0, 0]),
    ],
)  # fmt: skip
def test_other_programs(tmp_path, text, model, D):
    (tmp_path / "camera").write_text(text)
    camera = read_calibration(tmp_path / "camera")
    assert (camera.width, camera.height, camera.distortion_model) == (640, 480, model)
    fy = 500 if "SIMPLE" in text else 510
    np.testing.assert_allclose(camera.K, [[500, 0, 320.5], [0, fy, 240.5], [0, 0, 1]])
    np.testing.assert_allclose(camera.D, D)
    # Gyroflow counts all rows.
    assert camera.readout_time == pytest.approx(0.0096 * 479 / 480 if text == GYROFLOW else 0.0)


@pytest.mark.parametrize("ending", ["yaml", "json"])
@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_what_opencv_writes(tmp_path, ending, model):
    path = tmp_path / f"camera.{ending}"
    D = FIVE if model == "plumb_bob" else FIVE[:4]
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 640)
    file.write("image_height", 480)
    file.write("fisheye_model", int(model == "equidistant"))  # as its calibration example does
    file.write("camera_matrix", np.array([[500.25, 0, 320.5], [0, 510, 240.5], [0, 0, 1]]))
    file.write("distortion_coefficients", np.array([D]))
    file.release()
    camera = read_calibration(path)
    assert (camera.K[0, 0], camera.width, camera.distortion_model) == (500.25, 640, model)
    np.testing.assert_allclose(camera.D, D)


def test_one_of_several_cameras(tmp_path):
    other = KALIBR.replace("cam0", "cam1").replace("500.0", "600.0")
    (tmp_path / "chain.yaml").write_text(KALIBR + other)
    assert read_calibration(f"{tmp_path}/chain.yaml#cam1").K[0, 0] == 600.0
    with pytest.raises(CalibrationError, match="the cameras cam0, cam1: choose one with #cam0"):
        read_calibration(tmp_path / "chain.yaml")
    with pytest.raises(CalibrationError, match="the cameras cam0, cam1"):
        read_calibration(f"{tmp_path}/chain.yaml#cam2")
    lines = "7 PINHOLE 640 480 500 510 321 241\n9 PINHOLE 640 480 700 510 321 241\n"
    (tmp_path / "cameras.txt").write_text(lines)
    assert read_calibration(f"{tmp_path}/cameras.txt#9").K[0, 0] == 700.0
    with pytest.raises(CalibrationError, match="the cameras 7, 9: choose one with #7"):
        read_calibration(tmp_path / "cameras.txt")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a: [", r"camera.yaml is not a YAML or JSON file"),
        ("width: 3\nname: x", r"not a usable calibration: .* found name, width"),
        (ROS.replace("rational_polynomial", "fov"), r"distortion_model must be .* found 'fov'"),
        (ROS[: ROS.index("distortion_model")], r"no distortion coefficients: is it cut off"),
        (COLMAP.format("FOV", "500 510 321 241 1"), r"model must be one of .* found FOV"),
        ("1 PINHOLE 640", "PINHOLE has width, height, fx fy cx cy; found 640"),
        (JSON % '"width": 300, "height": 480', r"principal point \(320.5, 240.5\) lies outside"),
        ('<?xml version="1.0"?><opencv_storage/>', "it is XML, which OpenCV's FileStorage writes"),
    ],
)
def test_faults_are_named(tmp_path, text, expected):
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(CalibrationError, match=expected):
        read_calibration(tmp_path / "camera.yaml")


@pytest.mark.parametrize("model", ["plumb_bob", "rational_polynomial", "equidistant"])
def test_a_lens_without_coefficients_is_read_as_it_was_written(model):
    camera = Camera(640, 480, [[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]], distortion_model=model)
    read = lens_camera(lens_parameters(camera))
    assert read.distortion_model == model
    np.testing.assert_array_equal(read.project(np.eye(3)[2:]), camera.project(np.eye(3)[2:]))
