"""Which readout time the images ask for where one was given: a wrong one bends a map that still
fits them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rs_localizer.mapping.adjustment import MapProblem
from rs_localizer.mapping.reduced import Reduced
from rs_localizer.trajectory.model import State

# So far from what was given is another time: in its own deviations, and s.
_DEVIATIONS, _LEAST = 6.0, 0.001


@dataclass(frozen=True, slots=True)
class AskedReadout:
    """The readout time that keypoints ask for, beside the one that was given."""

    given: float  # s
    asked: float  # s; negative: against the scan direction
    deviation: float  # s

    @property
    def differs(self) -> bool:
        """Whether noise does not explain the difference."""
        apart = abs(self.asked - self.given)
        return apart > max(_DEVIATIONS * self.deviation, _LEAST)

    @property
    def told(self) -> str:
        """What to say of it."""
        reverse = " in the reverse direction" if self.asked < 0.0 else ""
        return (
            f"the images ask for a readout time of about {1e3 * abs(self.asked):.1f} ms"
            f"{reverse}, {1e3 * self.given:.1f} ms was given: if it is wrong, so is the map"
        )


def asked_readout(problem: MapProblem, state: State, deviation: float) -> AskedReadout:
    """What is asked for at the minimum of a problem.

    Args:
        problem: with the readout time free.
        state: the minimum of the same problem with the readout time held.
        deviation: px, of the noise.

    Raises:
        Undetermined: when the images leave it open.
    """
    reduced = Reduced(problem.normal(state, deviation)[1])
    change = float(reduced.step()[1][0])
    unit = np.zeros((reduced.size, 1))
    place = reduced.size - problem.motion.border
    unit[place] = 1.0
    variance = reduced.solve(unit, np.zeros((*state.landmarks.shape, 1)))[0][place, 0]
    given = float(state.readout_time)
    return AskedReadout(given, given + change, float(np.sqrt(variance)))
