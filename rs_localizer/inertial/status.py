# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The gyroscope after a frame, for who tells of it: this loads no kernels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.reasons import ImuReason


@dataclass(frozen=True, slots=True)
class Unused:
    """A reason for which a frame goes without its IMU, and what was found."""

    reason: ImuReason
    detail: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class InertialStatus:
    """The gyroscope after a frame; what is not known is NaN."""

    unused: Unused | None  # None: it was used
    bias: Array = field(default_factory=lambda: np.full(3, math.nan))  # (3,) rad/s, camera axes
    bias_deviation: float = math.nan  # rad/s, of an axis
    time_offset: float = math.nan  # s, to be added to the times of the samples
    time_offset_deviation: float = math.nan  # s
