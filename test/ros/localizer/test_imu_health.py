"""What is said of the IMU: numbers where they are known, and a warning where it is not used."""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core.reasons import ImuReason
from rs_localizer.inertial.status import Alone, InertialStatus
from rs_localizer.pipeline.imu import ImuState, Unused
from rs_localizer.ros.localizer.imu_health import imu_oddity, imu_values

STATUS = InertialStatus(
    Alone.NONE, np.radians([0.5, -0.25, 1.0]), math.radians(0.01), 0.0049, 0.0002
)
USED = ImuState(200, 190, 0.97, None, {"imu_gap": 10}, 400.04, -0.0051, STATUS)
LATE = Unused(ImuReason.LATE, "the last reading is 97.5 ms older than the last row")
UNUSED = ImuState(200, 0, 0.0, LATE, {"imu_late": 200}, math.nan, math.nan, None)


def test_an_imu_in_use() -> None:
    assert imu_values(USED) == {
        "IMU": "used",
        "IMU used (share of the last frames)": "97%",
        "IMU rate (Hz)": "400.0",
        "IMU bias (deg/s, camera axes)": "0.500 -0.250 1.000 +- 0.010",
        "IMU time offset (ms)": "-5.10 +- 0.20",
        "IMU not used: imu_gap": "10",
    }
    assert imu_oddity(USED) == {}


def test_an_imu_that_is_not_used() -> None:
    assert imu_values(UNUSED) == {
        "IMU": f"not used: {LATE}",
        "IMU used (share of the last frames)": "0%",
        "IMU not used: imu_late": "200",
    }
    said = imu_oddity(UNUSED)["imu"]
    assert "later than imu.wait" in said
    assert "97.5 ms older than the last row" in said
    assert "a larger imu.wait" in said  # what to do


def test_without_one_nothing_is_said() -> None:
    assert imu_oddity(None) == {}
