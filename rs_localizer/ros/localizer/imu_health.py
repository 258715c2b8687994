"""What the diagnostics say of the IMU."""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.pipeline.imu import ImuState
from rs_localizer.pipeline.reasons import IMU_REASONS

# Share of the last frames below which it is worth a warning that the IMU is not used.
_FEW = 0.5


def imu_oddity(state: ImuState | None) -> dict[str, str]:
    """Why the camera goes on alone, and what to look at; nothing where it does not."""
    if state is None or state.unused is None or state.share >= _FEW:
        return {}
    look_at = IMU_REASONS[state.unused.reason].look_at
    return {"imu": f"the IMU is not used: {state.unused} ({look_at})"}


def imu_values(state: ImuState) -> dict[str, str]:
    """Values by readable names; what is not known is left out."""
    values = {
        "IMU": "used" if state.unused is None else f"not used: {state.unused}",
        "IMU used (share of the last frames)": f"{state.share:.0%}",
    }
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
