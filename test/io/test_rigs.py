# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rigs in files of other programs: signs and order by hand."""

import numpy as np
import pytest

from rs_localizer.io.camera_files import CalibrationError, read_calibration
from rs_localizer.io.rigs import read_camchain

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
def test_faults_are_named(tmp_path, text, expected):
    (tmp_path / "rig").write_text(text)
    with pytest.raises(CalibrationError, match=expected):
        read_camchain(tmp_path / "rig")
