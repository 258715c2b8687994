"""An adjusted map where it belongs, with the covariances of its landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.mapping.adjustment import MapProblem
from rs_localizer.mapping.gauge import as_held, generators, laid_over
from rs_localizer.mapping.reduced import Reduced
from rs_localizer.trajectory.model import State
from rs_localizer.trajectory.spline import Spline


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Map and motion in the frame of the map as it was given."""

    points: Array  # (p,3) m
    covariances: Array  # (p,3,3) m^2, inverse of the normal matrix
    shared: Array  # (s,s) covariance of readout time and lens, likewise
    spline: Spline


def laid_down(problem: MapProblem, state: State, deviation: float, usable: BoolArray) -> Placed:
    """Lay the map over the given one, unless landmarks of known place hold it.

    Args:
        problem: whose minimum the state is.
        state: map and motion.
        deviation: px, of the noise.
        usable: (p,) which landmarks may hold the whole.

    Raises:
        Undetermined: when the images leave something open.
    """
    reduced = Reduced(problem.normal(state, deviation)[1])
    if not problem.floating:
        return Placed(state.landmarks, *reduced.covariances(), state.spline)
    given = problem.observations.landmarks
    whole, kept = laid_over(state.landmarks, given, usable)
    every = generators(state.landmarks, state.landmarks[kept].mean(axis=0))
    of_kept = np.where(kept[:, None, None], every, 0.0)
    spread = reduced.solve(np.zeros((reduced.size, 7)), of_kept)[1]
    covariances, shared = reduced.covariances()
    held = as_held(covariances, spread, every, of_kept)
    return Placed(
        whole(state.landmarks), whole.covariances(held), shared, whole.moved(state.spline)
    )
