# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages of cameras, IMUs and detectors: what is read of them, and what is refused."""

import math
import time
from types import SimpleNamespace
from types import SimpleNamespace as Made
from typing import Any

import numpy as np
import pytest

from rs_localizer.core.camera import Roi
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.detections import read_detections
from rs_localizer.io.imu import make_reading, read_imu
from rs_localizer.io.messages import MessageError
from rs_localizer.io.reading import YamlError, load_yaml

# Nine lines for 9^9 values.
LAUGHS = "\n".join(f"k{n}: &a{n} [{', '.join([f'*a{n - 1}' if n else 'x'] * 9)}]" for n in range(9))

# Each merges the one before it twice.
MERGES = "k0: &a0 {x: 1}\n" + "".join(
    f"k{n}: &a{n} {{<<: [*a{n - 1}, *a{n - 1}]}}\n" for n in range(1, 40)
)


def test_what_people_write():
    assert load_yaml("a: &x {b: 1}\nc: *x\nd: [1, 2.5, yes, text]\n") == {
        "a": {"b": 1}, "c": {"b": 1}, "d": [1, 2.5, True, "text"],
    }  # fmt: skip
    assert load_yaml("") is None


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("a: [1", "expected ',' or ']'"),
        ("a: &x {b: *x}", "nests deeper than 50, or holds itself"),
        ("[" * 60 + "]" * 60, "nests deeper than 50"),
        ("[" * 5000, "nests deeper than 50|expected|nesting depth"),
        (LAUGHS, "more than 100000 values"),
        ("2026-99-99", "month must be in 1..12"),
        ("9" * 5000, "a number of 5000 characters"),
        (":".join(["1"] * 200_000), "a number of 399999 characters"),
        (MERGES, "it merges mappings"),
        ("a" * 5_000_000, "5000000 characters"),
        ("a: [" + "1, " * 400_000 + "1]", "more than 100000 values"),
        ("!!python/object/apply:os.system [ls]", "could not determine a constructor"),
    ],
)
def test_traps(text, fault):
    started = time.process_time()
    with pytest.raises(YamlError, match=fault):
        load_yaml(text)
    assert time.process_time() - started < 5.0


# apriltag: from the lower left on, counter-clockwise; the first pixel's middle is at 0.5.
CORNERS = [(10.5, 40.5), (40.5, 40.5), (40.5, 10.5), (10.5, 10.5)]


def message(corners=CORNERS, **changed):
    points = [Made(x=x, y=y) for x, y in corners]
    tag = Made(**({"family": "36h11", "id": 7, "corners": points} | changed))
    header = Made(stamp=Made(sec=3, nanosec=5))
    return Made(header=header, detections=[tag])


def test_a_tag():
    found = read_detections(message())
    assert found.stamp_ns == 3_000_000_005
    assert found.names == [("tag36h11", 7)]
    expected = [(10, 10), (40, 10), (40, 40), (10, 40)]
    np.testing.assert_array_equal(found.corners[0], expected)


@pytest.mark.parametrize("family", ["tag36h11", "tag_36h11", "36h11"])
def test_families_have_one_name(family):
    assert read_detections(message(family=family)).names == [("tag36h11", 7)]


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (message(CORNERS[:3]), "a detection has 3 corners, not 4"),
        (message([(np.nan, 0.0), *CORNERS[1:]]), "corners of a detection are not finite"),
        (Made(header=message().header, detections=[Made()]), "a detection has no field corners"),
        (Made(detections=range(10_001)), "10001 detections are no tags of one image"),
    ],
)
def test_what_was_found_is_said(wrong, said):
    with pytest.raises(MessageError, match=said):
        read_detections(wrong)


ABSENT = np.array([-1.0, *[0.0] * 8])


def make(**changed: Any) -> Any:
    turn, push = changed.get("turn", (0.1, -0.2, 0.3)), changed.get("push", (0.5, 0.0, 9.8))
    frame = changed.get("frame", "imu_link")
    message = make_reading(12_345_678_901, np.array(turn), np.zeros(3), frame, (1e-4, 0.0))
    message.linear_acceleration.x, message.linear_acceleration.y, message.linear_acceleration.z = (
        push
    )
    message.angular_velocity_covariance = changed.get("turn_covariance", np.zeros(9))
    message.linear_acceleration_covariance = changed.get("push_covariance", np.zeros(9))
    return message


@pytest.mark.parametrize("of_rclpy", [False, True])
def test_a_message(of_rclpy):
    message = make()
    if of_rclpy:
        pytest.importorskip("rclpy")
        from rs_localizer.ros.node.conversion import copy_message

        message = copy_message(message, message.__msgtype__)
    found = read_imu(message)
    assert (found.stamp_ns, found.frame) == (12_345_678_901, "imu_link")
    assert found.angular_velocity == (0.1, -0.2, 0.3)
    assert found.linear_acceleration == (0.5, 0.0, 9.8)


@pytest.mark.parametrize(
    "changed",
    [
        {"push_covariance": ABSENT}, {"push": (0.0, math.inf, 0.0)}, {"push": (0.0, 0.0, 0.0)},
        {"push": (math.nan,) * 3, "push_covariance": ABSENT},
    ],
)  # fmt: skip
def test_a_gyroscope_alone(changed):
    found = read_imu(make(**changed))
    assert (found.angular_velocity, found.linear_acceleration) == ((0.1, -0.2, 0.3), None)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"turn_covariance": ABSENT}, "has no angular velocity"),
        ({"turn": (0.0, math.nan, 0.0)}, "angular_velocity is not finite: .*nan"),
        ({"turn": (0.0, 250.0, 0.0)}, r"\(0.0, 250.0, 0.0\) rad/s.*is it in rad/s"),
        ({"push": (0.0, 0.0, 9810.0)}, "9810.0.*is it in m/s"),
        ({"frame": ""}, "header.frame_id is empty"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_told(changed, said):
    with pytest.raises(MessageError, match=said):
        read_imu(make(**changed))


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
