"""Calibration files of ROS and of BoofCV, and what is none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rs_localizer.io.calibration import CalibrationError, read_calibration

ROS = """
image_width: 640
image_height: 480
camera_name: webcam
camera_matrix: {rows: 3, cols: 3, data: [500.0, 0, 320.5, 0, 510.0, 240.5, 0, 0, 1]}
distortion_model: rational_polynomial
distortion_coefficients: {rows: 1, cols: 8, data: [1, 2, 3, 4, 5, 6, 7, 8]}
"""
BOOFCV = """
pinhole: {fx: 500.0, fy: 510.0, cx: 320.5, cy: 240.5, width: 640, height: 480, skew: 0.0}
model: pinhole_radial_tangential
radial_tangential:
  radial: [0.05, -0.16]
  t1: 0.001
  t2: 0.002
"""


@pytest.mark.parametrize(
    ("text", "model", "D"),
    [
        (ROS, "rational_polynomial", [1, 2, 3, 4, 5, 6, 7, 8]),
        # OpenCV's order: two radial, two tangential, the third radial.
        (BOOFCV, "plumb_bob", [0.05, -0.16, 0.001, 0.002, 0.0]),
    ],
)
def test_both_kinds(tmp_path: Path, text: str, model: str, D: list[float]) -> None:
    (tmp_path / "camera.yaml").write_text(text)
    camera = read_calibration(tmp_path / "camera.yaml")
    assert (camera.width, camera.height, camera.distortion_model) == (640, 480, model)
    np.testing.assert_array_equal(camera.K, [[500, 0, 320.5], [0, 510, 240.5], [0, 0, 1]])
    np.testing.assert_array_equal(camera.D, D)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a: [", r"camera.yaml is no YAML file"),
        ("just text", r"is no calibration: expected a camera_matrix .* found neither"),
        ("width: 3\nname: x", r"is no calibration: .* found name, width"),
        (ROS.replace("image_width", "w"), r"no usable calibration: no 'image_width'"),
        (ROS.replace("500.0, 0, ", ""), r"no usable calibration: cannot reshape"),
        (ROS.replace("rational_polynomial", "fov"), r"distortion_model must be .* got 'fov'"),
        (BOOFCV.replace("skew: 0.0", "skew: 0.5"), r"skew must be 0, found 0.5"),
        (BOOFCV.replace("-0.16", "1, 2, 3"), r"at most 3 radial coefficients .* found 4"),
        (BOOFCV.replace("fx: 500.0", "fx: 0"), r"not calibrated"),
    ],
)
def test_faults_are_named(tmp_path: Path, text: str, expected: str) -> None:
    (tmp_path / "camera.yaml").write_text(text)
    with pytest.raises(CalibrationError, match=expected):
        read_calibration(tmp_path / "camera.yaml")


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(CalibrationError, match=r"absent.yaml cannot be read: No such file"):
        read_calibration(tmp_path / "absent.yaml")
