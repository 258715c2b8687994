"""A camera that shakes at a few frequencies, however far and fast.

Large swings leave the search with the rows of one phase; the others are beyond the gate, but not
far. So the gate closes slowly while motion, swings and frequencies are fitted together.
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
from rs_localizer.estimation.columns import Columns
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.posterior import GATE, WIDEST_GATE, noise_deviation
from rs_localizer.estimation.prior_kernels import add_prior
from rs_localizer.estimation.prior_terms import PriorTerms
from rs_localizer.estimation.refine import apply_step, inverted
from rs_localizer.estimation.residuals import linearized

FEWEST = 12
"""Points that a tone could be told from."""
_LEAST_SIZE = 1e-6  # rad
_SLOWEST, _FASTEST = 0.5, MOST_CYCLES + 0.5  # cycles per readout
# A tone found on a grid of frequencies is no farther from one of its lines (deviation), and no step
# moves it farther.
_OFF_GRID, _FARTHEST = 0.25, 0.15
_CLOSING = 0.6  # of the gate, from step to step
_STEPS = 20
_CLOSE = 0.01  # squared length of the last step, in standard deviations
_BEHIND = 1e150  # px
# Parameters that the points decide, and not the prior, before any fit has told.
_DECIDED_AT_FIRST = 12


@dataclass(frozen=True, slots=True, eq=False)
class Tones:
    """A motion and tones beside it, each ``swings[0] cos(w tau) + swings[1] sin(w tau)``.

    Parameters: motion (18), swings (6 of each tone), cycles (1 of each).
    """

    beside: Array  # (24,) the motion without the tones
    cycles: Array  # (q,) per readout
    swings: Array  # (q,2,3) rad
    sizes: Array  # (q,) rad, of the swings' coordinates

    @classmethod
    def none(cls, state: Array) -> Tones:
        """A motion (24,) alone."""
        return cls(state, np.zeros(0), np.zeros((0, 2, 3)), np.zeros(0))

    def with_one(self, cycles: float, size: float) -> Tones:
        """One tone more, of which only frequency and size are known."""
        return replace(
            self,
            cycles=np.append(self.cycles, cycles),
            swings=np.concatenate([self.swings, np.zeros((1, 2, 3))]),
            sizes=np.append(self.sizes, size),
        )

    @property
    def swung(self) -> slice:
        """Where the swings are among the parameters; the cycles are behind them."""
        return slice(PARAMETERS, PARAMETERS + 6 * len(self.cycles))

    @property
    def degrees(self) -> int:
        """Of the polynomials that follow them."""
        return max((degrees_for(cycles) for cycles in self.cycles), default=1)

    @property
    def state(self) -> Array:
        """The motion (24,) together with the tones at the middle row."""
        step = np.zeros(PARAMETERS)
        step[TURN] = self.swings[:, 0].sum(axis=0)
        step[ANGULAR] = 2.0 * math.pi * self.cycles @ self.swings[:, 1]
        moved: Array = apply_step(self.beside, step)
        return moved

    def coefficients(self, degrees: int) -> Array:
        """The rest of the tones (k,3), as shaking (:mod:`rs_localizer.core.shake`)."""
        total = np.zeros((degrees - 1, 3))
        for cycles, swings in zip(self.cycles, self.swings, strict=True):
            total += tone_coefficients(cycles, degrees) @ swings
        return total

    def by_parameters(self, degrees: int) -> Array:
        """Derivatives (18 + 3 k, 18 + 7 q) of :attr:`state` and :meth:`coefficients`."""
        count = len(self.cycles)
        jacobian = np.zeros((PARAMETERS + 3 * (degrees - 1), PARAMETERS + 7 * count))
        jacobian[:PARAMETERS, :PARAMETERS] = np.eye(PARAMETERS)
        for index, (cycles, swings) in enumerate(zip(self.cycles, self.swings, strict=True)):
            cosine = PARAMETERS + 6 * index
            sine, frequency = cosine + 3, PARAMETERS + 6 * count + index
            jacobian[TURN, cosine:sine] = np.eye(3)
            jacobian[ANGULAR, sine : sine + 3] = 2.0 * math.pi * cycles * np.eye(3)
            jacobian[ANGULAR, frequency] = 2.0 * math.pi * swings[1]
            by_swings = np.kron(tone_coefficients(cycles, degrees), np.eye(3))
            jacobian[PARAMETERS:, cosine : sine + 3] = by_swings
            jacobian[PARAMETERS:, frequency] = (tone_slopes(cycles, degrees) @ swings).ravel()
        return jacobian


class Seen(NamedTuple):
    """The points of a frame at a motion with tones."""

    errors: Array  # (n,2) px
    squared_errors: Array  # (n,)
    columns: Array  # (n,2,18 + 7 q) derivatives by the parameters
    by_turn: Array  # (n,2,3)
    tau: Array  # (n,)
    image: Array  # (n,2) where they are seen, as rays


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """The best motion with tones, and what the points say of it."""

    tones: Tones
    seen: Seen
    covariance: Array  # (18 + 7 q, 18 + 7 q)
    noise: float  # px
    inliers: BoolArray  # (n,)
    prior_cost: float  # of the motion, noise variances


def seen_at(observations: Observations, tones: Tones) -> Seen:
    """The errors that tones leave, and their derivatives."""
    shake = shake_at(observations.tau, tones.coefficients(tones.degrees))
    errors, by_motion, by_turn, tau, image = linearized(
        observations.packed,
        len(observations),
        tones.state,
        observations.row_time_gradient,
        shake,
    )
    behind = np.isinf(observations.squared_errors(tones.beside))
    errors[behind] = _BEHIND
    squared = np.where(behind, np.inf, np.einsum("ni,ni->n", errors, errors))
    if len(tones.cycles) == 0:
        return Seen(errors, squared, by_motion, by_turn, tau, image)
    angle = 2.0 * math.pi * np.outer(tau, tones.cycles)
    waves = np.stack([np.cos(angle), np.sin(angle)], axis=2)  # (n,q,2)
    by_swings = np.einsum("nqw,nia->niqwa", waves, by_turn).reshape(*errors.shape, -1)
    slopes = np.stack([-waves[..., 1], waves[..., 0]], axis=2) * (
        2.0 * math.pi * tau[:, None, None]
    )
    by_cycles = np.einsum("nqw,qwa,nia->niq", slopes, tones.swings, by_turn)
    columns = np.concatenate([by_motion, by_swings, by_cycles], axis=2)
    return Seen(errors, squared, columns, by_turn, tau, image)


def products_of(
    tones: Tones, seen: Seen, chosen: BoolArray, terms: PriorTerms, noise: float
) -> tuple[Columns, Array, float]:
    """Products of the columns of the chosen points (n,), with all that is known beforehand, px^2;
    without it; and the cost of the motion's prior, in noise variances."""
    columns = seen.columns[chosen].reshape(-1, seen.columns.shape[2])
    errors = seen.errors[chosen].ravel()
    products, with_errors = columns.T @ columns, -columns.T @ errors
    by_points = products.copy()
    information, slope = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    cost = float(add_prior(*terms, tones.beside, 1.0, information, slope))
    known = np.zeros(len(products))
    known[tones.swung] = np.repeat(tones.sizes**-2, 6)
    known[tones.swung.stop :] = _OFF_GRID**-2
    variance = noise * noise
    products[:PARAMETERS, :PARAMETERS] += variance * information
    with_errors[:PARAMETERS] -= variance * slope
    products[np.diag_indices_from(products)] += variance * known
    with_errors[tones.swung] -= variance * known[tones.swung] * tones.swings.ravel()
    found = Columns(products, with_errors, float(errors @ errors) + variance * cost, 0)
    return found, by_points, cost


def fitted(
    observations: Observations, start: Tones, gate: float, terms: PriorTerms, threshold: float
) -> Fit | None:
    """The best motion with tones near others, and the points that it explains.

    Args:
        gate: px, of the points that count at first; it closes to that of inliers, as the noise
            decides it.
        terms: of the motion without the tones.
        threshold: px, least gate of inliers.

    None where the fit leaves what can be computed, or nearly all points.
    """
    tones, last, decided = start, gate, float(_DECIDED_AT_FIRST)
    chosen = np.zeros(len(observations), dtype=np.bool_)
    for index in range(_STEPS):
        seen = seen_at(observations, tones)
        noise = noise_deviation(seen.squared_errors, gate, decided)
        if index > 0:
            last = min(max(threshold, GATE * noise), WIDEST_GATE * threshold)
            gate = max(_CLOSING * gate, last)
        before, chosen = chosen, seen.squared_errors < gate * gate
        if np.count_nonzero(chosen) < FEWEST:
            return None
        products, by_points, cost = products_of(tones, seen, chosen, terms, noise)
        if not np.all(np.isfinite(products.products)):
            return None
        inverse = inverted(products.products)
        if not np.all(np.isfinite(inverse)):
            return None
        step, covariance = inverse @ products.with_errors, noise * noise * inverse
        decided = float(np.sum(inverse * by_points))
        small = step @ products.with_errors < _CLOSE * noise * noise
        settled = small and gate == last and np.array_equal(before, chosen)
        if settled or index == _STEPS - 1:
            break
        tones = _moved(tones, step, covariance)
    return Fit(tones, seen, covariance, noise, chosen, cost)


def _moved(tones: Tones, step: Array, covariance: Array) -> Tones:
    """A step (18 + 7 q,) farther, with the sizes that go with the new swings."""
    swings = tones.swings + step[tones.swung].reshape(tones.swings.shape)
    # Without a swing, no direction is better than the other.
    swung = np.any(tones.swings, axis=(1, 2))
    move = swung * np.clip(step[tones.swung.stop :], -_FARTHEST, _FARTHEST)
    variances = np.diag(covariance)[tones.swung].reshape(-1, 6).sum(axis=1)
    squares = (np.sum(swings**2, axis=(1, 2)) + variances) / 6.0
    return Tones(
        apply_step(tones.beside, step[:PARAMETERS]),
        np.clip(tones.cycles + move, _SLOWEST, _FASTEST),
        swings,
        np.maximum(np.sqrt(squares), _LEAST_SIZE),
    )
