# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What is said of the IMU: numbers where they are known, and a warning where it is not used."""

import math
from dataclasses import replace

import numpy as np

from rs_localizer.core.reasons import ImuReason
from rs_localizer.inertial.watch import Alone, InertialStatus
from rs_localizer.pipeline.imu import ImuState, Unused
from rs_localizer.ros.localizer.health import imu_oddity, imu_values

STATUS = InertialStatus(
    Alone.NONE, np.radians([0.5, -0.25, 1.0]), math.radians(0.01), 0.0049, 0.0002
)
USED = ImuState(200, 190, 0.97, None, None, {"imu_gap": 10}, 400.04, -0.0051, STATUS)
LATE = Unused(ImuReason.LATE, "the last reading is 97.5 ms older than the last row")
UNUSED = ImuState(200, 0, 0.0, LATE, LATE, {"imu_late": 200}, math.nan, math.nan, None)


def test_an_imu_in_use():
    assert imu_values(USED) == {
        "IMU": "used",
        "IMU used (share of the last frames)": "97%",
        "IMU rate (Hz)": "400.0",
        "IMU bias (deg/s, camera axes)": "0.500 -0.250 1.000 +- 0.010",
        "IMU time offset (ms)": "-5.10 +- 0.20",
        "IMU not used: imu_gap": "10",
    }
    assert imu_oddity(USED) == {}


def test_an_imu_that_is_not_used():
    assert imu_values(UNUSED) == {
        "IMU": f"not used: {LATE}",
        "IMU used (share of the last frames)": "0%",
        "IMU not used: imu_late": "200",
    }
    said = imu_oddity(UNUSED)["imu"]
    assert "later than imu.wait" in said
    assert "97.5 ms older than the last row" in said
    assert "a larger imu.wait" in said  # what to do


def test_the_most_frequent_reason_is_said_and_not_the_last_one():
    slow = Unused(ImuReason.TOO_SLOW, "a reading comes every 20.0 ms")
    state = replace(UNUSED, mostly=slow)
    assert imu_values(state)["IMU"] == f"not used: {slow}"
    assert "every 20.0 ms" in imu_oddity(state)["imu"]


def test_gravity_that_contradicts_the_map_is_a_warning():
    assert "imu.gravity" not in imu_oddity(USED)
    assert imu_oddity(replace(USED, gravity=math.radians(2.0))) == {}
    state = replace(USED, gravity=math.radians(88.0))
    assert "88 degrees off gravity_in_map" in imu_oddity(state)["imu.gravity"]
    assert imu_values(state)["IMU gravity off gravity_in_map (deg)"] == "88.0"
