# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Assumptions on a gyroscope."""

from __future__ import annotations

import math
from dataclasses import dataclass

from rs_localizer.core.arrays import Array

# What consumer gyroscopes are off by beside noise and bias (scale, axes, mounting), as a part of
# the turn: data sheets say 1 to 3 %.
SCALE_DEVIATION = 0.01
# Biases of gyroscopes that were never calibrated.
BIAS_DEVIATION = math.radians(3.0)  # rad/s, of each axis
# Stamps of cameras and IMUs are off by some milliseconds in the driver.
OFFSET_DEVIATION = 0.01  # s
# Once estimated, the offset changes by clocks that drift apart, s/sqrt(s).
OFFSET_WALK = 5e-6
# What stamps of single frames and samples are off by beside it, at best, s.
JITTER = 4e-5


@dataclass(frozen=True, slots=True)
class InertialSettings:
    """The user's settings of the IMU."""

    gyroscope_noise: float  # rad/s/sqrt(Hz)
    gyroscope_bias_walk: float  # rad/s^2/sqrt(Hz)
    estimate_time_offset: bool
    gravity_in_map: Array | None = None  # (3,) along gravity; None: not used
