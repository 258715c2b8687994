"""What the diagnostics say of the IMU."""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.pipeline.imu import ImuState
from rs_localizer.pipeline.reasons import IMU_REASONS

# Share of the last frames below which it is worth a warning that the IMU is not used.
_FEW = 0.5
# Accelerometers and maps are upright to a few degrees; a wrong direction is off by 90 or 180.
_MOST_TILT = math.radians(10.0)


def imu_oddity(state: ImuState | None) -> dict[str, str]:
    """Why the camera goes on alone, and what to look at; what contradicts gravity."""
    if state is None:
        return {}
    oddities = {}
    if state.mostly is not None and state.share < _FEW:
        look_at = IMU_REASONS[state.mostly.reason].look_at
        oddities["imu"] = f"the IMU is not used: {state.mostly} ({look_at})"
    if state.gravity is not None and state.gravity > _MOST_TILT:
        oddities["imu.gravity"] = (
            f"the accelerometer shows gravity {math.degrees(state.gravity):.0f} degrees off "
            "gravity_in_map: is that the direction in which things fall in the map, and does TF "
            "know the IMU's axes?"
        )
    return oddities


def imu_values(state: ImuState) -> dict[str, str]:
    """Values by readable names; what is not known is left out."""
    mostly = f"not used: {state.mostly}" if state.share < _FEW else "used"
    values = {"IMU": mostly, "IMU used (share of the last frames)": f"{state.share:.0%}"}
    if state.gravity is not None:
        known = math.isfinite(state.gravity)
        values["IMU gravity off gravity_in_map (deg)"] = (
            f"{math.degrees(state.gravity):.1f}" if known else "not known yet"
        )
    if math.isfinite(state.rate):
        values["IMU rate (Hz)"] = f"{state.rate:.1f}"
    status = state.status
    if status is not None and np.all(np.isfinite(status.bias)):
        bias = " ".join(f"{value:.3f}" for value in np.degrees(status.bias))
        deviation = math.degrees(status.bias_deviation)
        values["IMU bias (deg/s, camera axes)"] = f"{bias} +- {deviation:.3f}"
    if status is not None and math.isfinite(state.time_offset):
        offset, deviation = 1e3 * state.time_offset, 1e3 * status.time_offset_deviation
        values["IMU time offset (ms)"] = f"{offset:.2f} +- {deviation:.2f}"
    return values | {f"IMU not used: {reason}": str(n) for reason, n in state.reasons.items()}
