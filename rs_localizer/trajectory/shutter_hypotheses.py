# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Odds of a global shutter, and of a reversed one, against what is set, from few frames.

A measured readout time needs a scatter, and so a second and more of motion. Sooner told is which of
three values fits: the one that is set, none, or the one that is set with the other sign. Errors of
map and lens look like velocities many times as large as noise makes them, but alike in neighbouring
frames: what changes from triple to triple (see :mod:`rs_localizer.trajectory.online_readout`) is
left to compare, and its own scatter is the measure. Of a global shutter nothing may be left beside
noise: a shaken camera turns otherwise between its frames than within them, whatever its shutter. No
triple counts for more than a few: a camera that is elsewhere all at once changes two of them.
"""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core.simd.jit import kernel
from rs_localizer.estimation.refine import inverted
from rs_localizer.trajectory.readout_equations import SIDE, Equations

# What a triple says fades by this from triple to triple.
_MEMORY = 0.95
# Neighbouring triples share two frames, and the six numbers of each their errors: of what
# independent ones would say, this part.
_INDEPENDENT = 1.0 / 6.0
# Of the least mean square that any value leaves, what one triple may say: four of twenty are not
# enough to be certain, but one is to doubt.
_MOST = np.array([[3.9], [10.0]])
# Mean square of what changes at no readout time, in variances of its noise, that noise alone makes.
_MOST_SCATTER = 1.5
_CERTAIN = math.log(100.0)
# A camera that moves so much that the odds should be this (logarithm), if the setting were right,
# has to show at least a part of it.
_TELLING, _LEAST_SHOWN = 0.7, 0.5
# Odds (logarithm) of another value that are enough to doubt; at rest, chance makes less.
_DOUBT = 2.0
# Of the variance of the way's noise, what is taken from its square: it may be wrong, and scatters.
_WAY_NOISE = 2.0

# Places in sums of squares: what is left at no readout time, at that which is set, at its reverse;
# and how far the first two are from each other.
_NONE, _SET, _REVERSED, _APART = range(4)


class ShutterHypotheses:
    """Compares the newest triples with those before them."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all triples."""
        self._count = 0.0
        self._left = np.zeros((2, 4))  # to be certain, and to doubt

    def add(self, of: Equations, readout_time: float) -> None:
        """Compare the last two triples, one frame apart.

        Args:
            of: two or more.
            readout_time: s, that is set.
        """
        none, rolling = changed(of, 0.0), changed(of, readout_time)
        left = np.array([none[0], rolling[0], changed(of, -readout_time)[0], rolling[1]])
        if np.all(np.isfinite(left)):
            # Neighbouring triples share their noise: less changes than it would of others.
            usual = (np.min(self._left[0, :_APART]) + SIDE) / (self._count + 1.0)
            most = _MOST * max(np.min(left[:_APART]), usual)
            self._count = _MEMORY * self._count + 1.0
            self._left = _MEMORY * self._left + np.minimum(left, most)

    def _odds(self, one: int, other: int, to_doubt: bool = False) -> float:
        """Logarithm of the odds for one value against another."""
        left = self._left[int(to_doubt)]
        return self._logarithm(float(left[one]), float(left[other]))

    def _logarithm(self, ours: float, theirs: float) -> float:
        if not min(ours, theirs) > 0.0:
            return 0.0
        return 0.5 * SIDE * _INDEPENDENT * self._count * math.log(theirs / ours)

    @property
    def logarithm(self) -> float:
        """Logarithm of the odds for a global shutter; negative where nothing else than a rolling
        one can be, 0 where nothing is known.
        """
        return self._odds(_NONE, _SET)

    @property
    def certain(self) -> bool:
        """Whether the shutter is a global one rather than one of the readout time that is set."""
        scatter = float(self._left[0, _NONE]) / (SIDE * max(self._count, 1.0))
        against = min(self.logarithm, self._odds(_NONE, _REVERSED))
        return scatter < _MOST_SCATTER and against > _CERTAIN

    @property
    def rolling(self) -> float:
        """Logarithm of the odds for the readout time that is set, either way, against none."""
        return max(self._odds(_SET, _NONE), self._odds(_REVERSED, _NONE))

    @property
    def may_be_reversed(self) -> bool:
        """Whether that fits better than what is set."""
        return self._odds(_REVERSED, _SET, to_doubt=True) > 0.0

    @property
    def doubtful(self) -> bool:
        """Whether the camera moves, and what is set does not show, or another value fits better."""
        least, apart = float(np.min(self._left[1, :_APART])), float(self._left[1, _APART])
        should = self._logarithm(least, least + apart)
        shown = self._odds(_SET, _NONE, to_doubt=True)
        silent = should > _TELLING and shown < _LEAST_SHOWN * should
        return silent or max(-shown, self._odds(_REVERSED, _SET, to_doubt=True)) > _DOUBT


@kernel
def changed(of: Equations, readout_time: float) -> tuple[float, float]:
    """Square of what changes between the last two triples at a readout time, in variances of the
    newer one's noise; and how far that readout time is from none, beyond the noise of the way.
    """
    last = len(of.x) - 1
    change, way, spread = np.empty(SIDE), np.empty(SIDE), np.empty((SIDE, SIDE))
    for i in range(SIDE):
        change[i] = of.y[last, i] - of.y[last - 1, i]
        way[i] = readout_time * (of.x[last, i] - of.x[last - 1, i])
        change[i] -= way[i]
        for j in range(SIDE):
            both = of.yx[last, i, j] + of.yx[last, j, i]
            spread[i, j] = of.yy[last, i, j] - readout_time * both
            spread[i, j] += readout_time * readout_time * of.xx[last, i, j]
    weights = inverted(spread)
    squared, apart = 0.0, 0.0
    for i in range(SIDE):
        for j in range(SIDE):
            squared += change[i] * weights[i, j] * change[j]
            noise = of.xx[last, i, j] + of.xx[last - 1, i, j]
            noise *= _WAY_NOISE * readout_time * readout_time
            apart += weights[i, j] * (way[i] * way[j] - noise)
    return squared, max(apart, 0.0)
