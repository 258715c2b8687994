# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A gyroscope's settings, and its state after a frame, for who tells of it: without kernels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.reasons import Unused


@dataclass(frozen=True, slots=True)
class InertialSettings:
    """Prior of the IMU before any frame.

    Data sheets say 1 to 3 % of consumer gyroscopes' scales; a mount is drawn or measured to 2 deg;
    drivers stamp images and readings some milliseconds off.
    """

    gyroscope_noise: float  # rad/s/sqrt(Hz)
    gyroscope_bias_walk: float  # rad/s^2/sqrt(Hz)
    scale_deviation: float = 0.03  # of each axis
    mount_deviation: float = 0.035  # rad, about each axis
    time_offset_deviation: float = 0.02  # s
    gravity_in_map: Array | None = None  # (3,) along gravity; None: not used


@dataclass(frozen=True, slots=True, eq=False)
class InertialStatus:
    """The gyroscope after a frame; what is not known is NaN."""

    unused: Unused | None  # None: it was used
    bias: Array = field(default_factory=lambda: np.full(3, math.nan))  # (3,) rad/s, camera axes
    bias_deviation: float = math.nan  # rad/s, of an axis
    time_offset: float = math.nan  # s, to be added to the times of the samples
    time_offset_deviation: float = math.nan  # s
    oddity: str = ""  # what it has that the settings do not allow for, in words
