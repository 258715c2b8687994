"""Motions of one typical speed that the inliers of an image leave possible, each a Gaussian."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.estimation.assumptions import FIELD_PRIOR, SHAKE_PRIOR, SHAKE_SIZES, Assumed
from rs_localizer.estimation.averaging import more_probable, on_the_way, volume_of
from rs_localizer.estimation.columns import Columns
from rs_localizer.estimation.curvature import along_arcs
from rs_localizer.estimation.linear import foreseen
from rs_localizer.estimation.medians import median_depth
from rs_localizer.estimation.model_error import Examined, examine, gain_of_shaking
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.packing import thin, weighted
from rs_localizer.estimation.posterior import Posterior, fit
from rs_localizer.estimation.prior_terms import PriorTerms

# Along the flat valleys of small planes a fit may end before its steps do.
_FITS = 4
# Gain of the last step, noise variances: of a fit, which may be on its way along such a valley; of
# one that only tells where it leads; and of one to a part of the points, whose best is not theirs.
_FINE, _ROUGH, _NEARER = 1e-6, 0.1, 1.0
# A fit that costs so little more than another one (noise variances), and is on the way there, ends
# there.
_HARDLY_WORSE = 1.0
# So many points lead a fit to where all of them end it.
_ENOUGH = 48
# Odds by which motion must explain the points better than rest, to count in the estimate. Where a
# map or a lens is seen to be wrong, what looks like motion mostly is more of that, and the odds
# grow by the second factor. The covariance allows for motion at even odds.
_ODDS_AGAINST_MOTION = 100.0
DISTRUST = 1e9
# Of Occam's factor in the covariance: what is simpler is more probable, but who moves is not served
# by that.
_GENEROSITY = 0.5
# Points nearer than this (m) would make any map useless.
_NEAREST = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Mode:
    """One combination: a Gaussian and the logarithm of its probability, but for a constant."""

    state: Array  # (24,)
    covariance: Array  # (18,18)
    evidence: float
    volume: float  # the part of the evidence that speaks for few possibilities (Occam's factor)
    cost: float  # of its fit, noise variances
    speed: float
    field: float  # px

    @property
    def support(self) -> float:
        """Logarithm of what it counts in the covariance, but for a constant."""
        return self.evidence - _GENEROSITY * self.volume


class Inliers:
    """The inliers of one frame and what is the same for all combinations."""

    def __init__(
        self, observations: Observations, best: Posterior, terms: PriorTerms, assumed: Assumed
    ) -> None:
        self.observations, self.terms, self.assumed = observations, terms, assumed
        self.inliers, self.noise, self.inflation = best.inliers, best.noise, best.inflation
        self._data = weighted(observations.packed, best.inliers)
        count = int(np.count_nonzero(best.inliers))
        depth = median_depth(best.state, observations.points, best.inliers) if count else 1.0
        self._depth = max(depth, _NEAREST)
        self.field_sizes = assumed.field_sizes(self._depth)
        # Where the points are linearized, and their columns, if these foresee other speeds.
        self.linear: tuple[Array, Columns] | None = None
        self.freedom = max(2.0 * count - 6.0, 1.0)
        # What a point is worth beside one whose error is its own (an effective number of points).
        self.worth = 1.0
        self.odds = math.log(_ODDS_AGAINST_MOTION) + assumed.of_rest  # logarithm
        # The best motion and its cost if the mirrored pose leads back to it.
        self.only: tuple[Array, float] | None = None
        # What tones that hide in the noise add to the covariance of a camera that moves.
        self.unheard: Array | None = None
        self.shake_prior = more_probable(SHAKE_PRIOR, assumed.of_shake_sizes)
        self.field_prior = more_probable(FIELD_PRIOR, assumed.of_field_sizes)

    def fitted(self, start: Array, terms: PriorTerms) -> tuple[Array, float]:
        """State (24,) and cost of the best motion near a state."""
        for _ in range(_FITS):
            start, cost, converged = fit(
                self._data, start, self.observations.row_time_gradient, terms, self.noise, _FINE
            )
            if converged:
                break
        return start, cost

    def fitted_to_some(self, start: Array, terms: PriorTerms) -> tuple[Array, float]:
        """State (24,) to which some of the points lead from afar, perhaps along a valley.

        And its cost, as if the others had as much of it. Few points lead nowhere, at no cost.
        """
        chosen = np.flatnonzero(self.inliers)
        apart = max(len(chosen) // _ENOUGH, 1)
        part = chosen[::apart].copy()
        if len(part) == len(chosen):
            return start, 0.0
        share = len(part) / len(chosen)
        state, cost, _ = fit(
            thin(self._data, part), start, self.observations.row_time_gradient, terms,
            self.noise * math.sqrt(share), _NEARER,
        )  # fmt: skip
        return state, cost / share

    def fitted_roughly(self, start: Array, terms: PriorTerms) -> tuple[Array, float]:
        """State (24,) and cost of a motion that is on its way to the best one near a state."""
        state, cost, _ = fit(
            self._data, start, self.observations.row_time_gradient, terms, self.noise, _ROUGH
        )
        return state, cost

    def leads_to(
        self, rough: tuple[Array, float], best: tuple[Array, float], covariance: Array
    ) -> bool:
        """Whether a rough fit is on its way to a motion, of these costs, whose covariance it is."""
        near: bool = on_the_way(rough[0], best[0], covariance)
        return near and abs(rough[1] - best[1]) < _HARDLY_WORSE * self.noise**2

    def examined(
        self, state: Array, terms: PriorTerms, degree: int, neighbours: bool = True
    ) -> Examined:
        """Shaking, up to a degree (0: none), and field at the best motion."""
        observations = self.observations
        found: Examined = examine(
            observations.packed, state, observations.row_time_gradient, observations.rays,
            observations.tau, self.inliers, terms, degree, self.freedom, self.noise,
            self.assumed.shake * SHAKE_SIZES, self.shake_prior,
            self.field_sizes, self.field_prior, neighbours,
        )  # fmt: skip
        return found

    def gain_of_shaking(self, state: Array, terms: PriorTerms, degree: int) -> float:
        """Logarithm of how much better shaking, up to a degree, explains the errors than none."""
        observations = self.observations
        gain: float = gain_of_shaking(
            observations.packed, state, observations.row_time_gradient, self.inliers, terms, degree,
            self.freedom, self.noise,
        )  # fmt: skip
        return gain

    def mode(self, start: Array, terms: PriorTerms, speed: float) -> Mode:
        """The Gaussian about the best motion of a typical speed, which may foresee the next one."""
        if self.linear is not None:
            near, state, cost, examined = foreseen(
                *self.linear, start, terms, self.freedom, self.noise, SHAKE_SIZES, self.shake_prior,
                self.field_sizes, self.field_prior, self.assumed.focal_length, self._depth,
            )  # fmt: skip
            if near:
                return self._gaussian((state, cost), examined, terms, speed, start)
            start = state
        fitted = self.fitted(start, terms)
        examined = self.examined(fitted[0], terms, 0, neighbours=False)
        self.linear = (fitted[0], examined.columns) if examined.finite else None
        return self._gaussian(fitted, examined, terms, speed, start)

    def gaussian(
        self, fitted: tuple[Array, float], terms: PriorTerms, speed: float, start: Array
    ) -> Mode:
        """The same about a motion that has been fitted from there, of this cost."""
        examined = self.examined(fitted[0], terms, 0, neighbours=False)
        return self._gaussian(fitted, examined, terms, speed, start)

    def _gaussian(
        self, fitted: tuple[Array, float], examined: Examined, terms: PriorTerms, speed: float,
        start: Array,
    ) -> Mode:  # fmt: skip
        state, cost = fitted
        volume = volume_of(terms, examined)
        evidence = self.worth * (examined.sizes.evidence + volume)
        if self.assumed.turn is not None:
            evidence += self.assumed.turn.evidence(speed)
        if not (math.isfinite(evidence) and examined.finite):
            # It has left what can be computed: the camera would stand behind the points.
            return Mode(
                start, np.zeros_like(examined.covariance), -math.inf, 0.0, math.inf, speed, 0.0
            )
        return Mode(
            state,
            along_arcs(self.inflation / self.worth * examined.covariance, state[9:12]),
            evidence,
            self.worth * volume,
            cost / self.noise**2,
            speed,
            examined.sizes.field,
        )
