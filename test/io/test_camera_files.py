# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Files of cameras and rigs: what is written is read, other programs' files too; faults named."""

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
from rs_localizer.io.rigs import read_camchain

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


# cam1 stands 0.2 m to the right of cam0 and looks to the right (its z is the x of cam0); cam2 hangs
# 0.1 m below cam1, turned upside down.
CHAIN = """cam0:
  camera_model: pinhole
  distortion_coeffs: [0.1, -0.2, 0.001, 0.002]
  distortion_model: radtan
  intrinsics: [500.0, 510.0, 320.5, 240.5]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1: [[0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, -0.2], [0, 0, 0, 1]]
  camera_model: ds
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [-0.2, 0.59, 300.0, 301.0, 310.0, 230.0]
  resolution: [640, 480]
  readout_time: 0.02
cam2:
  T_cn_cnm1: [[-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.1], [0.0, 0.0, 1.0, 0.0], [0, 0, 0, 1]]
  camera_model: eucm
  distortion_coeffs: []
  distortion_model: none
  intrinsics: [0.6, 1.1, 280.0, 281.0, 311.0, 231.0]
  resolution: [640, 480]
  readout_time: 0.03
  scan_direction: bottom_to_top
"""
# The IMU stands 0.3 m behind cam0; stamps of cam1 are late by 4 ms.
IMU = """  T_cam_imu: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, -0.3], [0, 0, 0, 1]]
  timeshift_cam_imu: {}
"""


def seen(parts, name, point):
    rotation, translation = parts.camera_from_rig[name]
    return rotation @ point + translation


def test_transforms_of_a_camchain_lead_from_one_camera_to_the_next(tmp_path):
    (tmp_path / "chain.yaml").write_text(CHAIN)
    parts = read_camchain(tmp_path / "chain.yaml")
    assert list(parts.cameras) == ["cam0", "cam1", "cam2"]
    assert parts.time_offset == dict.fromkeys(parts.cameras, 0.0)
    # 2 m ahead of cam0, 1.2 m to its right: 1 m ahead of cam1, and 2 m to its left.
    point = np.array([1.2, 0.0, 2.0])
    np.testing.assert_allclose(seen(parts, "cam0", point), point)
    np.testing.assert_allclose(seen(parts, "cam1", point), [-2.0, 0.0, 1.0])
    # For cam2, upside down and below, that is to the right and below: its y points up.
    np.testing.assert_allclose(seen(parts, "cam2", point), [2.0, 0.1, 1.0])
    first, second, third = parts.cameras.values()
    assert (str(first.distortion_model), first.readout_time) == ("plumb_bob", 0.0)
    assert (str(second.distortion_model), second.readout_time) == ("ds", 0.02)
    assert (second.D.tolist(), third.D.tolist()) == ([-0.2, 0.59], [0.6, 1.1])
    assert third.K.tolist() == [[280, 0, 311], [0, 281, 231], [0, 0, 1]]
    assert third.scan_direction == "bottom_to_top"
    np.testing.assert_array_equal(read_calibration(f"{tmp_path}/chain.yaml#cam2").D, third.D)


def test_with_an_imu_the_rig_has_its_axes_and_its_clock(tmp_path):
    first, second = CHAIN.split("cam1:\n")[0], CHAIN.split("cam1:\n")[1].split("cam2:\n")[0]
    text = first + IMU.format(0.001) + "cam1:\n" + second + IMU.format(-0.004)
    (tmp_path / "chain.yaml").write_text(text)
    parts = read_camchain(tmp_path / "chain.yaml")
    # What the IMU has 1 m ahead, its camera has 0.7 m ahead.
    np.testing.assert_allclose(seen(parts, "cam0", np.array([0.0, 0.0, 1.0])), [0, 0, 0.7])
    # t_imu = t_cam + shift: of cam1, 4 ms earlier than its stamps say.
    assert parts.time_offset == {"cam0": 0.001, "cam1": -0.004}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (CHAIN.replace("T_cn_cnm1", "T"), "no usable rig: cam1 has no 'T_cn_cnm1'"),
        (CHAIN.replace("[0.0, 1.0, 0.0, 0.0]", "[0.0, -1.0, 0.0, 0.0]"),
         "cam1: T_cn_cnm1 is no rigid transform"),
        (CHAIN.replace("camera_model: ds", "camera_model: omni"),
         "cam1: camera_model must be pinhole, eucm or ds, found 'omni'"),
        ("[1, 2]", "a camchain has a mapping for each camera"),
        ("cam0: 640", "cam0: expected a mapping, found 640"),
    ],
)  # fmt: skip
def test_faults_of_rigs_are_named(tmp_path, text, expected):
    (tmp_path / "rig").write_text(text)
    with pytest.raises(CalibrationError, match=expected):
        read_camchain(tmp_path / "rig")
