# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What is known of how much a camera shakes and how fast it moves: it goes from frame to frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.shake import CYCLES

SPEEDS = (0.0, 0.03, 0.1, 0.3, 1.0)
"""Typical speeds, as parts of the configured one; 0 is a camera at rest."""
SCALES = len(CYCLES) + 1
"""One per frequency of the in-frame turn (rad), and that of the smooth error (px) behind them."""


class Scales(NamedTuple):
    """Of one frame, or of many: Gaussians of logarithms, and logarithms of odds."""

    means: Array  # (15,) of the logarithm of each scale
    precisions: Array  # (15,) of these; 0: nothing is known
    excess: Array  # (15,) by how much more than chance each would explain, standard normal
    speeds: Array  # (5,) logarithms of the odds of the typical speeds

    @classmethod
    def nothing(cls) -> Scales:
        """Of no frame."""
        zeros = np.zeros(SCALES)
        return cls(zeros, zeros, zeros, np.zeros(len(SPEEDS)))


# A frame remembers the one before it by this: scales of shaking hold for about a second of video,
# what a speed was holds for a third of one.
_MEMORY, SPEED_MEMORY = 0.95, 0.9
# Frames of one second show much the same: what they say together is less than their sum.
INDEPENDENT = 0.3


def joined(before: Scales, newest: Scales) -> Scales:
    """What the frames so far say together, the newest the most."""
    old, new = _MEMORY * before.precisions, INDEPENDENT * newest.precisions
    both = old + new
    means = (old * before.means + new * newest.means) / np.maximum(both, 1e-12)
    # The logarithm of a scale that itself wanders: never known to more than a tenth.
    return Scales(
        means,
        np.minimum(both, 100.0),
        _MEMORY * before.excess + np.sqrt(1.0 - _MEMORY**2) * newest.excess,
        SPEED_MEMORY * before.speeds + INDEPENDENT * newest.speeds,
    )
