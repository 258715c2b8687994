"""The root of the estimating equation of the readout time (see :mod:`.online`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from rs_localizer.trajectory.online_kernels import Equations, Score, score

_LAGS = 6  # neighbouring triples share frames, and errors of the map
_ROUNDS, _SETTLED = 12, 1e-4
# Covariances of frames may be wrong by this share; so is the correction for noise at slow motion.
_COVARIANCE_ERROR = 0.5
_MODEL_ERROR = 0.005  # of Simpson's rule and of constant velocities in a frame
# Contradicted is a value that chance puts so far away as seldom as four deviations of a Gaussian,
# one-sided, and that is off by more than this share.
_CHANCE, _LEAST_DIFFERENCE = 3.2e-5, 0.06


@dataclass(frozen=True, slots=True)
class MeasuredReadout:
    """A readout time that the frames of the last seconds show."""

    readout_time: float  # s; negative: against the scan direction that was assumed
    deviation: float  # s
    triples: int  # frames with two neighbours
    telling: float  # effective number of them: those of one jolt alone make about 2

    def contradicts(self, readout_time: float) -> bool:
        """Whether this readout time (s, of the assumed direction) must be wrong."""
        off = abs(self.readout_time - readout_time)
        largest = max(abs(self.readout_time), readout_time)
        # Of few triples the deviation itself is uncertain: Student's t.
        deviations = float(stdtrit(min(self.triples, 4.0 * self.telling) / _LAGS, 1.0 - _CHANCE))
        return off > max(deviations * self.deviation, _LEAST_DIFFERENCE * largest)

    @property
    def relative_deviation(self) -> float:
        """Deviation by value."""
        return self.deviation / max(abs(self.readout_time), 1e-12)


class Measurement:
    """Finds the readout time that some equations show, in rounds that may be taken one by one."""

    def __init__(self, of: Equations) -> None:
        self._of = of
        self._value, self._step, self._rounds = 0.0, math.inf, 0
        self.done = False
        self.found: MeasuredReadout | None = None  # None: the motion is not more than its noise

    def advance(self, triples: int) -> None:
        """Compute one round, or as many as look at so many triples together.

        Raises:
            LinAlgError: a frame has no covariance.
        """
        for _ in range(max(triples // len(self._of.x), 1)):
            if not self.done:
                self._next_round()

    def finish(self) -> MeasuredReadout | None:
        """Compute all that is left; raises as :meth:`advance`."""
        while not self.done:
            self._next_round()
        return self.found

    def _next_round(self) -> None:
        now: Score = score(self._of, self._value)
        if math.isnan(now.slope):
            raise np.linalg.LinAlgError("the covariance of a frame is none")
        if abs(self._step) < _SETTLED * abs(self._value) or self._rounds == _ROUNDS:
            self.found, self.done = _measured(now, self._value), True
        elif not now.slope > max(now.noise, 1.0):
            self.done = True
        else:
            self._step = float(np.sum(now.terms)) / now.slope
            self._value += self._step
            self._rounds += 1


def _measured(at: Score, value: float) -> MeasuredReadout:
    """The value with its deviation, from the equation there."""
    variance = float(at.terms @ at.terms)
    for lag in range(1, _LAGS):
        share = 2.0 * (1.0 - lag / _LAGS)
        variance += share * float(at.terms[lag:] @ at.terms[:-lag])
    systematic = _COVARIANCE_ERROR * at.noise / at.slope
    deviation = math.sqrt(
        max(variance / at.slope**2, 1.0 / at.slope) + value**2 * (systematic**2 + _MODEL_ERROR**2)
    )
    return MeasuredReadout(value, deviation, len(at.terms), at.telling)
