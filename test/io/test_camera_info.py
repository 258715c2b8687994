# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""CameraInfo becomes a Camera; what is not a calibration is refused with what was found."""

from types import SimpleNamespace

import numpy as np
import pytest

from rs_localizer.core.camera import Roi
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.messages import MessageError


def roi(x: int, y: int, width: int, height: int) -> SimpleNamespace:
    return SimpleNamespace(x_offset=x, y_offset=y, width=width, height=height, do_rectify=True)


def test_a_plain_camera(make_camera_info):
    calibration = read_camera_info(make_camera_info(d=np.array([0.1, -0.2, 0.01, 0.02, 0.3])))
    camera = calibration.camera(0.03, "bottom_to_top")
    assert calibration.frame == "camera"
    assert (camera.width, camera.height, camera.distortion_model) == (640, 480, "plumb_bob")
    assert np.array_equal(camera.K, [[500.0, 0.0, 319.5], [0.0, 510.0, 239.5], [0.0, 0.0, 1.0]])
    assert camera.D.tolist() == [0.1, -0.2, 0.01, 0.02, 0.3]
    assert (camera.readout_time, camera.scan_direction) == (0.03, "bottom_to_top")
    assert (camera.binning, camera.roi) == ((1, 1), None)


@pytest.mark.parametrize("coefficients", [[], [0.0] * 5])
def test_no_model_and_no_distortion_is_plumb_bob(make_camera_info, coefficients):
    message = make_camera_info(distortion_model="", d=np.array(coefficients))
    assert read_camera_info(message).distortion_model == "plumb_bob"


def test_binning_and_region(make_camera_info):
    message = make_camera_info(binning_x=2, binning_y=4, roi=roi(8, 16, 600, 400))
    camera = read_camera_info(message).camera(0.0, "top_to_bottom")
    assert camera.binning == (2, 4)
    assert camera.roi == Roi(8, 16, 600, 400)
    # Delivered row 0 is row 16 of the sensor, row 1 is row 20.
    pixels = np.array([[0.0, 0.0], [0.0, 1.0]])
    assert camera.row_time(pixels) == pytest.approx([16 / 479 - 0.5, 20 / 479 - 0.5])


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"k": np.zeros(9)}, r"not calibrated: K\[0\] is 0"),
        ({"distortion_model": "fisheye624"}, "must be one of plumb_bob, .*; found 'fisheye624'"),
        ({"roi": roi(600, 0, 100, 480)}, r"100 x 480 at \(600, 0\), does not lie in .*640 x 480"),
        ({"header": SimpleNamespace(frame_id="")}, "must name the camera's optical frame"),
    ],
)
def test_what_is_no_calibration_is_said(make_camera_info, changes, text):
    with pytest.raises(MessageError, match=text):
        read_camera_info(make_camera_info(**changes)).camera(0.0, "top_to_bottom")


EIGHT = [0.1, -0.2, 0.01, 0.02, 0.3, 0.4, 0.5, 0.6]


@pytest.mark.parametrize(
    ("said", "D", "model", "kept"),
    [
        ("plumb_bob", [*EIGHT[:5], 0.0, 0.0, 0.0], "plumb_bob", EIGHT[:5]),  # of Orbbec
        ("plumb_bob", [0.0] * 8, "plumb_bob", [0.0] * 5),
        ("plumb_bob", EIGHT, "rational_polynomial", EIGHT),
        ("plumb_bob", [*EIGHT[:5], *[0.0] * 9], "plumb_bob", EIGHT[:5]),
        ("fisheye", EIGHT[:4], "equidistant", EIGHT[:4]),
        ("equidistant", [*EIGHT[:4], 0.0], "equidistant", EIGHT[:4]),
        ("", EIGHT[:5], "plumb_bob", EIGHT[:5]),
        ("", EIGHT, "rational_polynomial", EIGHT),
        ("Plumb Bob", EIGHT[:5], "plumb_bob", EIGHT[:5]),
        ("none", [], "plumb_bob", []),
    ],
)
def test_where_one_lens_only_can_be_meant(make_camera_info, said, D, model, kept):
    camera = read_camera_info(make_camera_info(distortion_model=said, d=np.array(D))).camera(
        0.0, "top_to_bottom"
    )
    assert (camera.distortion_model, camera.D.tolist()) == (model, kept)


def test_where_two_lenses_can_be_meant(make_camera_info):
    message = make_camera_info(distortion_model="", d=np.array(EIGHT[:4]))
    with pytest.raises(MessageError, match="4 coefficients may be of plumb_bob or of equidistant"):
        read_camera_info(message)


@pytest.mark.parametrize(
    "told",
    [
        {"binning_x": 2, "binning_y": 2},
        {"roi": roi(0, 0, 640, 480)},
        {"roi": roi(640, 480, 640, 480)},
    ],
)
def test_a_K_of_the_delivered_image_is_named(make_camera_info, told):
    """Of a sensor of 1280x960; its binning, or its region, would count twice."""
    sensor = {"width": 1280, "height": 960} | told
    with pytest.raises(
        MessageError, match=r"K is of the delivered image of 640x480: its principal"
    ):
        read_camera_info(make_camera_info(**sensor))
    K = np.array([1000.0, 0.0, 639.5, 0.0, 1020.0, 479.5, 0.0, 0.0, 1.0])
    assert tuple(K) == read_camera_info(make_camera_info(k=K, **sensor)).K
