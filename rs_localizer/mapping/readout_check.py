# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The readout time that the images show: a wrong one bends a map that still fits them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rs_localizer.mapping.adjustment import MapProblem, Reduced
from rs_localizer.trajectory.model import State

# So far from what was given is another time: in its own deviations, and s.
_DEVIATIONS, _LEAST = 6.0, 0.001


@dataclass(frozen=True, slots=True)
class ReadoutCheck:
    """The readout time that keypoints show, beside the one that was given."""

    given: float  # s
    estimated: float  # s; negative: against the scan direction
    deviation: float  # s

    @property
    def differs(self) -> bool:
        """Whether noise does not explain the difference."""
        apart = abs(self.estimated - self.given)
        return apart > max(_DEVIATIONS * self.deviation, _LEAST)

    @property
    def message(self) -> str:
        """What to say of it."""
        reverse = " in the reverse direction" if self.estimated < 0.0 else ""
        return (
            f"estimated readout time is {1e3 * abs(self.estimated):.1f} ms{reverse}, but "
            f"{1e3 * self.given:.1f} ms was given; a wrong value distorts the map"
        )


def readout_checks(problem: MapProblem, state: State, deviation: float) -> list[ReadoutCheck]:
    """The readout time of each camera at the minimum of a problem.

    Args:
        problem: with the readout times free.
        state: the minimum of the same problem with the readout times held.
        deviation: px, of the noise.

    Raises:
        Undetermined: when the images leave it open.
    """
    reduced = Reduced(problem.normal(state, deviation)[1])
    changes, checks = reduced.step()[1], []
    for columns, one in zip(problem.motion.columns, problem.motion.states(state), strict=True):
        place = reduced.size - problem.motion.border + columns[0]
        unit = np.zeros((reduced.size, 1))
        unit[place] = 1.0
        variance = reduced.solve(unit, np.zeros((*state.landmarks.shape, 1)))[0][place, 0]
        given, change = float(one.readout_time), float(changes[columns[0]])
        checks.append(ReadoutCheck(given, given + change, float(np.sqrt(variance))))
    return checks
