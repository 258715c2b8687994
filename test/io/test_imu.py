# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/Imu of rosbags and of rclpy are read alike; what no IMU measures is refused."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rs_localizer.io.imu import make_reading, read_imu
from rs_localizer.io.messages import MessageError
from rs_localizer.io.telemetry import TelemetryError, read_log

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


BOOT = 81_234.5  # s on the phone's clock when the first image began
EXPOSURE, READOUT = 0.01, 0.0187
TIMES = np.arange(-0.5, 1.5, 0.005)  # s after that
# An upright phone turns to its left: about its y axis, which is up. The table pushes along it.
RATES = np.stack([0.0 * TIMES, 0.3 + 0.1 * TIMES, 0.0 * TIMES], axis=1)
FORCE = np.array([0.0, 9.81, 0.0])


def csv(path: Path, heading: str, rows: object) -> None:
    path.parent.mkdir(exist_ok=True)
    text = "".join(",".join(map(repr, np.array(row).tolist())) + "\n" for row in rows)
    path.write_text(heading + text)


def mars(folder: Path) -> None:
    """As its Android app writes it."""
    heading = (
        "Timestamp[nanosec],gx[rad/s],gy[rad/s],gz[rad/s],ax[m/s^2],ay[m/s^2],az[m/s^2],"
        "Unix time[nanosec]\n"
    )
    rows = [[1e9 * (BOOT + t), *rate, *FORCE, 0.0] for t, rate in zip(TIMES, RATES, strict=True)]
    csv(folder / "gyro_accel.csv", heading, rows)
    heading = (
        "Timestamp[nanosec],fx[px],fy[px],Frame No.,Exposure time[nanosec],Sensor frame duration"
        "[nanosec],Frame readout time[nanosec],ISO\n"
    )
    frame = [1500.0, 1500.0, 0.0, 1e9 * EXPOSURE, 33e6, 1e9 * READOUT, 100.0]
    rows = [[1e9 * (BOOT + k / 30), *frame] for k in range(30)]
    csv(folder / "movie_metadata.csv", heading, rows)


def opencamera(folder: Path) -> None:
    """Without headings, in a folder of its own; the accelerometer has its own times."""
    place = folder / "20260101_120000"
    rows = [[*rate, round(1e9 * (BOOT + t))] for t, rate in zip(TIMES, RATES, strict=True)]
    csv(place / "VID_20260101_120000_gyro.csv", "", rows)
    rows = [[*FORCE, round(1e9 * (BOOT + t))] for t in TIMES[::2] + 0.001]
    csv(place / "VID_20260101_120000_accel.csv", "", rows)
    rows = [[round(1e9 * (BOOT + k / 30))] for k in range(30)]
    csv(place / "VID_20260101_120000_timestamps.csv", "", rows)


def stray(folder: Path) -> None:
    """Seconds, and Core Motion's g, which has the sign of gravity."""
    rows = [[BOOT + t, *(-FORCE / 9.80665), *rate] for t, rate in zip(TIMES, RATES, strict=True)]
    csv(folder / "imu.csv", "timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n", rows)
    rows = [[BOOT + k / 60, k, 0, 0, 0, 0, 0, 0, 1] for k in range(60)]
    csv(folder / "odometry.csv", "timestamp, frame, x, y, z, qx, qy, qz, qw\n", rows)


@pytest.mark.parametrize(
    ("write", "app", "exposure", "readout"),
    [
        (mars, "MARS Logger (gyro_accel.csv)", EXPOSURE, READOUT),
        (opencamera, "OpenCamera Sensors (VID_20260101_120000_gyro.csv)", None, None),
        (stray, "Stray Scanner (imu.csv)", None, None),
    ],
)
def test_readings_are_those_of_the_camera_behind_the_screen(
    write, app, exposure, readout, tmp_path
):
    video = tmp_path / "VID_20260101_120000.mp4"
    assert read_log(video) is None
    write(tmp_path)
    found = read_log(video)
    assert (found.camera, found.readout_time, found.exposure) == (app, readout, exposure)
    assert found.rate == pytest.approx(200.0, rel=1e-4)
    # Times are those since the middle of the first image's exposure.
    np.testing.assert_allclose(found.times, TIMES - 0.5 * (exposure or 0.0), atol=1e-6)
    # The image's x axis points to the phone's bottom: what is up is along -x of the camera.
    up = np.array([-1.0, 0.0, 0.0])
    np.testing.assert_allclose(found.forces, np.tile(9.81 * up, (len(TIMES), 1)), atol=1e-9)
    np.testing.assert_allclose(found.rates, RATES[:, 1:2] * up, atol=1e-12)


HEADING = "timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n"
READINGS = [[BOOT + 0.01 * k, 0.0, 0.0, -1.0, 0.1 * k, 0.0, 0.0] for k in range(5)]


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ([], r"imu\.csv has no readings"),
        ([row[:3] for row in READINGS], "5 lines of 3 numbers, 7 or more are needed"),
        ([*READINGS, [BOOT + 1.0, math.nan, *READINGS[0][2:]]],
         r"1 lines without a number, as 81235\.5, ?nan"),
        ([[row[0] - 100.0, *row[1:]] for row in READINGS],
         r"not of one time: 81134\.5 to 81134\.5 s, 81234\.5"),
    ],
)  # fmt: skip
def test_a_log_that_is_broken_is_named(tmp_path, rows, said):
    stray(tmp_path)
    csv(tmp_path / "imu.csv", HEADING, rows)
    with pytest.raises(TelemetryError, match=said):
        read_log(tmp_path / "rgb.mp4")


def test_the_order_of_lines_does_not_matter(tmp_path):
    """Backwards was once -100 Hz."""
    stray(tmp_path)
    csv(tmp_path / "imu.csv", HEADING, READINGS[::-1])
    found = read_log(tmp_path / "rgb.mp4")
    assert found.rate == pytest.approx(100.0)
    np.testing.assert_allclose(found.rates[:, 1], -0.1 * np.arange(5))
