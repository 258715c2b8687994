"""Which tones shake a camera, by its frames so far.

A tone that hides in the noise of one frame is heard in many: the forward algorithm of a hidden
Markov model (Rabiner, "A tutorial on hidden Markov models", 1989), whose states are no tone and one
of each frequency and size. The phase is another in each frame.
"""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.assumptions import FIELD_PRIOR, SHAKE_PRIOR
from rs_localizer.estimation.spectrum import CYCLES, SWINGS

# Probability that from frame to frame the shaking becomes another, or none.
_CHANGES = 0.02
# Beforehand, a tone is as probable as none.
_EACH = 0.5 / (len(CYCLES) * (len(SWINGS) - 1))


def with_frame(odds: Array | None, newest: Estimate) -> Array | None:
    """Logarithm of the odds (m,s-1) of each tone against none, for the next frame.

    Args:
        odds: the same for the newest frame; None: there was none before.
        newest: what it says. Map and lens, or slow shaking, that explain its errors are no tones.
    """
    if newest.of_tones.size == 0:
        return odds
    others = max(
        np.logaddexp.reduce(np.log(FIELD_PRIOR) + newest.of_field_sizes),
        np.logaddexp.reduce(np.log(SHAKE_PRIOR) + newest.of_shake_sizes),
        0.0,
    )
    likely = newest.of_tones - others + (math.log(2.0 * _EACH) if odds is None else odds)
    highest = max(float(likely.max()), 0.0)
    probabilities, none = np.exp(likely - highest), math.exp(-highest)
    total = float(probabilities.sum()) + none
    stays = (1.0 - _CHANGES) / total
    found: Array = np.log(stays * probabilities + _CHANGES * _EACH)
    return found - math.log(stays * none + 0.5 * _CHANGES)


def leaning(odds: Array) -> Array:
    """Logarithm of the probability (m,s-1) of each tone, if there is one, in parts of the mean."""
    lean: Array = odds - np.logaddexp.reduce(odds, axis=None) + math.log(odds.size)
    return lean
