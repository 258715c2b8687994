# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rigs in files of other programs: signs and order by hand, and what is written comes back."""

import numpy as np
import pytest

from rs_localizer.core.camera import Camera
from rs_localizer.io.camera_files import CalibrationError, read_calibration
from rs_localizer.io.rigs import (
    RigParts,
    read_camchain,
    write_camchain,
)

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


def rig():
    rng = np.random.default_rng(2)
    cameras, poses = {}, {}
    K = np.array([[400.0, 0.0, 320.0], [0.0, 402.0, 241.0], [0.0, 0.0, 1.0]])
    lenses = {
        "front": ("equidistant", [0.01, -0.02, 0.003, 0.0]),
        "left": ("eucm", [0.6, 1.1]),
        "rear": ("ds", [-0.2, 0.6]),
        "right": ("plumb_bob", [0.1, 0.02, 1e-3, -1e-3]),
        "up": ("plumb_bob", []),
    }
    for name, (model, D) in lenses.items():
        cameras[name] = Camera(640, 480, K, D, model, 0.03, "left_to_right")
        turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        poses[name] = turn * np.linalg.det(turn), rng.normal(size=3)
    return RigParts(cameras, poses, {"front": 0.001, "rear": -0.02})


def test_a_written_camchain_comes_back(tmp_path):
    given = rig()
    write_camchain(tmp_path / "chain.yaml", given)
    parts = read_camchain(tmp_path / "chain.yaml")
    for name, camera in given.cameras.items():
        read = parts.cameras[name]
        for field in ("width", "height", "distortion_model", "readout_time", "scan_direction"):
            assert getattr(read, field) == getattr(camera, field)
        np.testing.assert_array_equal(read.K, camera.K)
        np.testing.assert_array_equal(read.D, camera.D)
        for a, b in zip(parts.camera_from_rig[name], given.camera_from_rig[name], strict=True):
            np.testing.assert_array_equal(a, b)
        assert parts.time_offset[name] == given.time_offset.get(name, 0.0)
    # Kalibr itself reads the chain, and not what stands beside it.
    text = (tmp_path / "chain.yaml").read_text().replace("T_cam_imu", "other")
    (tmp_path / "chain.yaml").write_text(text)
    chained = read_camchain(tmp_path / "chain.yaml")
    point = np.array([0.3, -0.2, 1.5])
    rotation, translation = given.camera_from_rig["front"]
    for name in given.cameras:
        of_front = rotation @ point + translation
        np.testing.assert_allclose(
            seen(chained, name, of_front), seen(given, name, point), atol=1e-12
        )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (CHAIN.replace("T_cn_cnm1", "T"), "no usable rig: cam1 has no 'T_cn_cnm1'"),
        (CHAIN.replace("[0.0, 1.0, 0.0, 0.0]", "[0.0, -1.0, 0.0, 0.0]"),
         "cam1: T_cn_cnm1 is no rigid transform"),
        (CHAIN.replace("camera_model: ds", "camera_model: omni"),
         "cam1: camera_model must be pinhole, eucm or ds, found 'omni'"),
        ("[1, 2]", "a camchain has a mapping for each camera"),
    ],
)  # fmt: skip
def test_faults_are_named(tmp_path, text, expected):
    (tmp_path / "rig").write_text(text)
    with pytest.raises(CalibrationError, match=expected):
        read_camchain(tmp_path / "rig")
