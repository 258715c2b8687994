# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The gyroscope after a frame, for who tells of it: this loads no kernels."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from rs_localizer.core.arrays import Array


class Alone(StrEnum):
    """Why the camera goes without its gyroscope."""

    NONE = "none"  # it does not
    NO_SAMPLES = "no_samples"
    NOT_COVERED = "not_covered"  # not the whole exposure
    DOUBTED = "doubted"  # in this frame the points fit better without it
    DISAGREES = "disagrees"  # in many frames, and no other time offset or mounting explains it
    TURNED = "turned"  # in many frames, as if camera_from_imu were turned


@dataclass(frozen=True, slots=True, eq=False)
class InertialStatus:
    """The gyroscope after a frame; what is not known is NaN."""

    alone: Alone
    bias: Array = field(default_factory=lambda: np.full(3, math.nan))  # (3,) rad/s, camera axes
    bias_deviation: float = math.nan  # rad/s, of an axis
    time_offset: float = math.nan  # s, to be added to the times of the samples
    time_offset_deviation: float = math.nan  # s
    extrinsic_angle: float = 0.0  # rad by which camera_from_imu seems to be turned

    @property
    def used(self) -> bool:
        return self.alone is Alone.NONE
