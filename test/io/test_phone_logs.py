# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Logs of phones beside a video: layouts, units, axes, clock."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from rs_localizer.io.telemetry import TelemetryError, read_log

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
    write: Callable[[Path], None],
    app: str,
    exposure: float | None,
    readout: float | None,
    tmp_path: Path,
) -> None:
    video = tmp_path / "VID_20260101_120000.mp4"
    assert read_log(video) is None
    write(tmp_path)
    found = read_log(video)
    assert found is not None
    assert (found.camera, found.readout_time, found.exposure) == (app, readout, exposure)
    assert found.rate == pytest.approx(200.0, rel=1e-4)
    # Times are those since the middle of the first image's exposure.
    np.testing.assert_allclose(found.times, TIMES - 0.5 * (exposure or 0.0), atol=1e-6)
    # The image's x axis points to the phone's bottom: what is up is along -x of the camera.
    up = np.array([-1.0, 0.0, 0.0])
    np.testing.assert_allclose(found.forces, np.tile(9.81 * up, (len(TIMES), 1)), atol=1e-9)
    np.testing.assert_allclose(found.rates, RATES[:, 1:2] * up, atol=1e-12)


def test_a_log_that_is_broken_is_named(tmp_path: Path) -> None:
    stray(tmp_path)
    (tmp_path / "imu.csv").write_text("timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z\n")
    with pytest.raises(TelemetryError, match=r"imu\.csv has no readings"):
        read_log(tmp_path / "rgb.mp4")
    csv(tmp_path / "imu.csv", "timestamp, a_x, a_y\n", [[k, 0.0, 9.8] for k in range(5)])
    with pytest.raises(TelemetryError, match="5 lines of 3 numbers, 7 or more are needed"):
        read_log(tmp_path / "rgb.mp4")
