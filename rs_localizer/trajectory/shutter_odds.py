"""Odds of a global shutter against the readout time that is set, from few frames.

A measured readout time needs a scatter, and so a second and more of motion. Sooner told is which of
two values fits: the one that is set, or none. Errors of map and lens look like velocities many
times as large as noise makes them, but alike in neighbouring frames: what changes from triple to
triple (see :mod:`rs_localizer.trajectory.online`) is left to compare, and its own scatter is the
measure. Of a global shutter nothing may be left beside noise: a shaken camera turns otherwise
between its frames than within them, whatever its shutter.
"""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core.lanes.jit import kernel
from rs_localizer.estimation.refine import inverted
from rs_localizer.trajectory.online_kernels import SIDE, Equations

# What a triple says fades by this from triple to triple.
_MEMORY = 0.95
# Neighbouring triples share two frames, and the six numbers of each their errors: of what
# independent ones would say, this part.
_INDEPENDENT = 1.0 / 6.0
# Mean square of what changes at no readout time, in variances of its noise, that noise alone makes.
_MOST_SCATTER = 1.5
_CERTAIN = math.log(100.0)


class ShutterOdds:
    """Compares the newest triples with those before them."""

    def __init__(self) -> None:
        self._count = 0.0
        self._left = np.zeros(2)  # sums of squares at no readout time and at that which is set

    def reset(self) -> None:
        """Forget all triples."""
        self._count, self._left = 0.0, np.zeros(2)

    def add(self, of: Equations, readout_time: float) -> None:
        """Compare the last two triples, one frame apart.

        Args:
            of: two or more.
            readout_time: s, that is set.
        """
        left = np.array([changed(of, 0.0), changed(of, readout_time)])
        if np.all(np.isfinite(left)):
            self._count = _MEMORY * self._count + 1.0
            self._left = _MEMORY * self._left + left

    @property
    def logarithm(self) -> float:
        """Logarithm of the odds for a global shutter; negative where nothing else than a rolling
        one can be, 0 where nothing is known.
        """
        still, rolling = self._left.tolist()
        if not min(still, rolling) > 0.0:
            return 0.0
        return 0.5 * SIDE * _INDEPENDENT * self._count * math.log(rolling / still)

    @property
    def certain(self) -> bool:
        """Whether the shutter is a global one rather than one of the readout time that is set."""
        scatter = float(self._left[0]) / (SIDE * max(self._count, 1.0))
        return scatter < _MOST_SCATTER and self.logarithm > _CERTAIN


@kernel
def changed(of: Equations, readout_time: float) -> float:
    """Square of what changes between the last two triples at a readout time, in variances of the
    newer one's noise.
    """
    last = len(of.x) - 1
    change, spread = np.empty(SIDE), np.empty((SIDE, SIDE))
    for i in range(SIDE):
        change[i] = of.y[last, i] - of.y[last - 1, i]
        change[i] -= readout_time * (of.x[last, i] - of.x[last - 1, i])
        for j in range(SIDE):
            both = of.yx[last, i, j] + of.yx[last, j, i]
            spread[i, j] = of.yy[last, i, j] - readout_time * both
            spread[i, j] += readout_time * readout_time * of.xx[last, i, j]
    weights = inverted(spread)
    squared = 0.0
    for i in range(SIDE):
        for j in range(SIDE):
            squared += change[i] * weights[i, j] * change[j]
    return squared
