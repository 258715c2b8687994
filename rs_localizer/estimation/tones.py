"""A camera that shakes at one frequency, however far and fast.

Large swings leave the search with the rows of one phase; the others are beyond the gate, but not
far. So tones are looked for among all points that are near (:mod:`.spectrum`), and the gate closes
while motion, swing and frequency are fitted together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.shake import shake_at
from rs_localizer.core.state import ANGULAR, PARAMETERS, TURN
from rs_localizer.core.tones import MOST_CYCLES, degrees_for, tone_coefficients, tone_slopes
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.posterior import GATE, WIDEST_GATE, noise_deviation
from rs_localizer.estimation.prior_kernels import add_prior
from rs_localizer.estimation.prior_terms import PriorTerms
from rs_localizer.estimation.refine import apply_step, inverted
from rs_localizer.estimation.residuals import linearized

FEWEST = 20
"""Points that a tone could be told from."""
PARAMETERS_OF_TONE = 7
_SWINGS = slice(PARAMETERS, PARAMETERS + 6)
_CYCLES = PARAMETERS + 6
_LEAST_SIZE = 1e-6  # rad
_SLOWEST, _FASTEST = 0.5, MOST_CYCLES + 0.5  # cycles per readout
# A tone found on a grid of frequencies is no farther from one of its lines (deviation), and no step
# moves it farther.
_OFF_GRID, _FARTHEST = 0.25, 0.15
_CLOSING = 0.6  # of the gate, from step to step
_STEPS = 20
_CLOSE = 0.01  # squared length of the last step, in standard deviations


class Start(NamedTuple):
    """Where a tone is looked for."""

    state: Array  # (24,) the motion
    cycles: float
    size: float  # rad
    gate: float  # px
    noise: float  # px


@dataclass(frozen=True, slots=True, eq=False)
class Tone:
    """A motion and a tone beside it: ``swings[0] cos(w tau) + swings[1] sin(w tau)``.

    Errors are of the motion (18), the swings (6) and the cycles.
    """

    beside: Array  # (24,) the motion without the tone
    swings: Array  # (2,3) rad
    cycles: float  # per readout
    size: float  # rad, of the swings' coordinates
    noise: float  # px
    covariance: Array  # (25,25)
    squared_errors: Array  # (n,) px^2
    inliers: BoolArray  # (n,)
    errors: Array  # (n,2) px
    prior_cost: float  # of the motion, noise variances

    @property
    def state(self) -> Array:
        """The motion (24,) together with the tone at the middle row."""
        step = np.zeros(PARAMETERS)
        step[TURN] = self.swings[0]
        step[ANGULAR] = 2.0 * math.pi * self.cycles * self.swings[1]
        moved: Array = apply_step(self.beside, step)
        return moved

    def coefficients(self, degrees: int) -> Array:
        """The rest of the tone (k,3), as shaking (:mod:`rs_localizer.core.shake`)."""
        rest: Array = tone_coefficients(self.cycles, degrees) @ self.swings
        return rest

    def by_parameters(self, degrees: int) -> Array:
        """Derivatives (18 + 3 k, 25) of :attr:`state` and :meth:`coefficients`."""
        jacobian = np.zeros((PARAMETERS + 3 * (degrees - 1), PARAMETERS + PARAMETERS_OF_TONE))
        jacobian[:PARAMETERS, :PARAMETERS] = np.eye(PARAMETERS)
        cosine, sine = _SWINGS.start, _SWINGS.start + 3
        jacobian[TURN, cosine:sine] = np.eye(3)
        jacobian[ANGULAR, sine:_CYCLES] = 2.0 * math.pi * self.cycles * np.eye(3)
        jacobian[ANGULAR, _CYCLES] = 2.0 * math.pi * self.swings[1]
        by_swings = tone_coefficients(self.cycles, degrees)
        jacobian[PARAMETERS:, _SWINGS] = np.kron(by_swings, np.eye(3))
        jacobian[PARAMETERS:, _CYCLES] = (tone_slopes(self.cycles, degrees) @ self.swings).ravel()
        return jacobian


class _Linear(NamedTuple):
    """The points at a motion and a tone."""

    errors: Array  # (n,2)
    squared_errors: Array  # (n,)
    columns: Array  # (n,2,25)


def fitted(
    observations: Observations, start: Start, terms: PriorTerms, threshold: float
) -> Tone | None:
    """The tone near another one, with the motion beside it and the points that it explains.

    Args:
        start: its gate closes to that of inliers, as the noise decides it.
        terms: of the motion without the tone.
        threshold: px, least gate of inliers.

    None where the fit leaves what can be computed, or nearly all points.
    """
    nothing = np.zeros(len(observations), dtype=np.bool_)
    tone = Tone(
        start.state, np.zeros((2, 3)), start.cycles, start.size, start.noise, np.empty((0, 0)),
        np.empty(0), nothing, np.empty((0, 2)), 0.0,
    )  # fmt: skip
    gate, last, chosen = start.gate, start.gate, nothing
    for index in range(_STEPS):
        linear = _linear(observations, tone)
        if index > 0:
            noise = noise_deviation(linear.squared_errors, gate, PARAMETERS + PARAMETERS_OF_TONE)
            tone = replace(tone, noise=noise)
            last = min(max(threshold, GATE * noise), WIDEST_GATE * threshold)
            gate = max(_CLOSING * gate, last)
        before, chosen = chosen, linear.squared_errors < gate * gate
        if np.count_nonzero(chosen) < FEWEST:
            return None
        found = _step(tone, linear, chosen, terms)
        if found is None:
            return None
        step, tone, length = found
        if length < _CLOSE and gate == last and np.array_equal(before, chosen):
            break
        tone = _moved(tone, step)
    else:
        linear = _linear(observations, tone)
        found = _step(tone, linear, chosen, terms)
        if found is None:
            return None
        _, tone, _ = found
    return tone


def _linear(observations: Observations, tone: Tone) -> _Linear:
    state, count = tone.state, len(observations)
    shake = shake_at(observations.tau, tone.coefficients(degrees_for(tone.cycles)))
    errors, by_motion, by_turn, tau = linearized(
        observations.packed, count, state, observations.row_time_gradient, shake
    )
    behind = np.isinf(observations.squared_errors(tone.beside))
    errors[behind] = 1e150
    squared = np.where(behind, np.inf, np.einsum("ni,ni->n", errors, errors))
    angle = 2.0 * math.pi * tone.cycles * tau
    cosine, sine = np.cos(angle), np.sin(angle)
    by_cycles = np.outer(cosine, tone.swings[1]) - np.outer(sine, tone.swings[0])
    by_cycles *= 2.0 * math.pi * tau[:, None]
    columns = np.concatenate(
        [
            by_motion,
            cosine[:, None, None] * by_turn,
            sine[:, None, None] * by_turn,
            np.einsum("nij,nj->ni", by_turn, by_cycles)[..., None],
        ],
        axis=2,
    )
    return _Linear(errors, squared, columns)


def _step(
    tone: Tone, linear: _Linear, chosen: BoolArray, terms: PriorTerms
) -> tuple[Array, Tone, float] | None:
    """Step (25,) from a tone, the tone with what is known of it, and how far (variances)."""
    columns = linear.columns[chosen].reshape(-1, PARAMETERS + PARAMETERS_OF_TONE)
    information, slope = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    cost = add_prior(*terms, tone.beside, 1.0, information, slope)
    weight = 1.0 / tone.noise**2
    matrix, right = weight * (columns.T @ columns), -weight * (
        columns.T @ linear.errors[chosen].ravel()
    )
    matrix[:PARAMETERS, :PARAMETERS] += information
    right[:PARAMETERS] -= slope
    matrix[_SWINGS, _SWINGS] += np.eye(6) / tone.size**2
    right[_SWINGS] -= tone.swings.ravel() / tone.size**2
    matrix[_CYCLES, _CYCLES] += _OFF_GRID**-2
    covariance = inverted(matrix) if np.all(np.isfinite(matrix)) else matrix
    if not np.all(np.isfinite(covariance)):
        return None
    step = covariance @ right
    known = replace(
        tone,
        covariance=covariance,
        squared_errors=linear.squared_errors,
        inliers=chosen,
        errors=linear.errors,
        prior_cost=cost,
    )
    return step, known, float(step @ right)


def _moved(tone: Tone, step: Array) -> Tone:
    """A step (25,) farther, with the size that goes with the new swings."""
    swings = tone.swings + step[_SWINGS].reshape(2, 3)
    # Without a swing, no direction is better than the other.
    move = float(np.clip(step[_CYCLES], -_FARTHEST, _FARTHEST)) if np.any(tone.swings) else 0.0
    square = (np.sum(swings**2) + np.trace(tone.covariance[_SWINGS, _SWINGS])) / 6.0
    return replace(
        tone,
        beside=apply_step(tone.beside, step[:PARAMETERS]),
        swings=swings,
        cycles=min(max(tone.cycles + move, _SLOWEST), _FASTEST),
        size=max(math.sqrt(square), _LEAST_SIZE),
    )
