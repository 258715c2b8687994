# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Scales that go from frame to frame: of shaking, speed, and errors of the map."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.shake import CYCLES, TYPICAL_SIZES

SPEEDS = (0.0, 0.1, 1.0)
"""Typical speeds, as parts of the configured one; 0 is a camera at rest."""
_CENTRES, _WIDTH, _FLOOR = (0.75, 1.5, 3.0, 5.0), 0.4, 0.03
_BANDS = np.exp(-0.5 * (np.log(CYCLES[None] / np.array(_CENTRES)[:, None]) / _WIDTH) ** 2) + _FLOOR
SPECTRA = np.concatenate([
    TYPICAL_SIZES[None],
    _BANDS * np.sqrt((TYPICAL_SIZES**2).sum() / (_BANDS**2).sum(axis=1))[:, None],
])  # fmt: skip
"""(s,14) rad, deviations of the frequencies of the in-frame turn: of an ordinary vibration, and of
bands about some cycles per readout, all of the same mean square."""
FACTORS = np.exp(1.15 * np.arange(-2.0, 5.0))
"""Vibration is so many times the ordinary one: three in a decade, up to a degree."""
VIBRATIONS = len(SPECTRA) * len(FACTORS) + 1
"""None, and all spectra of all sizes."""


class Scales(NamedTuple):
    """Scales by one frame, or many: a Gaussian of a logarithm, and logarithms of odds."""

    size: Array  # (2,) of the logarithm of the smooth error (px): mean, and precision; 0: unknown
    vibrations: Array  # (v,) logarithms of the odds of none and of each vibration
    speeds: Array  # (s,) logarithms of the odds of the typical speeds

    @classmethod
    def nothing(cls) -> Scales:
        """Scales by no frame."""
        return cls(np.zeros(2), np.zeros(VIBRATIONS), np.zeros(len(SPEEDS)))


# A frame remembers the one before it by this: what is said of map, lens and shaking holds for about
# a second of video, of a speed for a third of one.
_MEMORY, SPEED_MEMORY = 0.95, 0.9
# However many calm frames leave shaking possible, logarithm of the odds: cameras begin to.
_LEAST_ODDS = -9.0
# Frames of one second show much the same: what they say together is less than their sum.
INDEPENDENT = 0.3


def joined(before: Scales, newest: Scales) -> Scales:
    """Scales by all frames so far, the newest the most."""
    old, new = _MEMORY * before.size[1], INDEPENDENT * newest.size[1]
    mean = (old * before.size[0] + new * newest.size[0]) / max(old + new, 1e-12)
    vibrations = _MEMORY * before.vibrations + INDEPENDENT * newest.vibrations
    # The logarithm of a size that itself wanders: never known to more than a tenth.
    return Scales(
        np.array([mean, min(old + new, 100.0)]),
        np.maximum(vibrations - vibrations.max(), _LEAST_ODDS),
        SPEED_MEMORY * before.speeds + INDEPENDENT * newest.speeds,
    )
