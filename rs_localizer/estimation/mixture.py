"""The average of all motions that the inliers of an image leave possible.

The points may hardly tell a slow camera from a resting one, and before a plane motions of very
different speed fit alike, along a curved valley: the typical speed is an unknown of its own. Each
speed, and either way that a plane may lean, is fitted, becomes one Gaussian, and counts by its
probability; what goes out is one Gaussian with the mean and the covariance of them all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.state import PARAMETERS, at_rest
from rs_localizer.estimation.assumptions import FIELD_PRIOR, SHAKE_PRIOR, SHAKE_SIZES, Assumed
from rs_localizer.estimation.averaging import (
    alike,
    averaged,
    more_probable,
    normalized,
    volume_of,
)
from rs_localizer.estimation.columns import Columns
from rs_localizer.estimation.curvature import along_arcs
from rs_localizer.estimation.doubt import may_face, pieces_of
from rs_localizer.estimation.face_on import reaching
from rs_localizer.estimation.linear import foreseen
from rs_localizer.estimation.medians import median_depth
from rs_localizer.estimation.mirror import farthest, mirrored
from rs_localizer.estimation.model_error import Examined, examine, gain_of_shaking
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.packing import thin, weighted
from rs_localizer.estimation.posterior import Posterior, fit
from rs_localizer.estimation.prior_terms import PriorTerms, terms_at

# Typical speeds to try, as parts of the configured one; 0 is a camera at rest.
_SPEEDS = (0.0, 0.03, 0.1, 0.3, 1.0)
# Along the flat valleys of small planes a fit may end before its steps do.
_FITS = 4
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
# Probability of one combination, beside which there is no other.
_ALONE = 0.99
# Points nearer than this (m) would make any map useless.
_NEAREST = 1e-6
# Logarithm of the odds of a typical speed beside a better one, beyond which none is tried.
_FAR_LESS_PROBABLE = 7.0
# Likewise, beyond which a typical speed hardly counts in the covariance.
_HARDLY_COUNTS = 3.0
# Likewise, beyond which a mirrored pose at rest is not there at any speed.
_OUT_OF_QUESTION = 20.0


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
        # Cost (noise variances) of the best motion if the mirrored pose leads back to it.
        self.only_cost = -math.inf
        self.shake_prior = more_probable(SHAKE_PRIOR, assumed.of_shake_sizes)
        self.field_prior = more_probable(FIELD_PRIOR, assumed.of_field_sizes)

    def fitted(self, start: Array, terms: PriorTerms) -> tuple[Array, float]:
        """State (24,) and cost of the best motion near a state."""
        for _ in range(_FITS):
            start, cost, converged = fit(
                self._data, start, self.observations.row_time_gradient, terms, self.noise
            )
            if converged:
                break
        return start, cost

    def fitted_from_afar(self, start: Array, terms: PriorTerms) -> tuple[Array, float]:
        """The same from a start that may lead along a valley: a part of the points goes first."""
        chosen = np.flatnonzero(self.inliers)
        part = chosen[:: len(chosen) // _ENOUGH] if len(chosen) >= 2 * _ENOUGH else chosen
        if len(part) < len(chosen):
            start, _, _ = fit(
                thin(self._data, part), start, self.observations.row_time_gradient, terms,
                self.noise * math.sqrt(len(part) / len(chosen)),
            )  # fmt: skip
        return self.fitted(start, terms)

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
            observations.packed, state, observations.row_time_gradient, observations.rays,
            self.inliers, terms, degree, self.freedom, self.noise,
        )  # fmt: skip
        return gain

    def mode(self, start: Array, terms: PriorTerms, speed: float) -> Mode:
        """The Gaussian about the best motion of a typical speed."""
        if self.linear is not None:
            near, state, cost, examined = foreseen(
                *self.linear, terms, self.freedom, self.noise, SHAKE_SIZES, self.shake_prior,
                self.field_sizes, self.field_prior, self.assumed.focal_length, self._depth,
            )  # fmt: skip
            if near:
                return self._gaussian((state, cost), examined, terms, speed, start)
        return self.gaussian(self.fitted(start, terms), terms, speed, start)

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


def weighed(frame: Inliers, found: Posterior, planar: bool) -> Posterior:
    """The average of all combinations, and the mirrored pose if it cannot be ruled out."""
    modes = _modes(frame, found, planar)
    if planar:
        modes = _in_pieces(frame, modes)
    evidence = np.array([mode.evidence for mode in modes])
    if not np.any(evidence > -math.inf):
        return replace(found, smallest_eigenvalue=0.0)
    at_rest = np.array([mode.speed == 0.0 for mode in modes])
    possible = normalized(np.array([mode.support for mode in modes]))
    counting = normalized(evidence + frame.odds * at_rest)
    best = int(np.argmax(counting))
    state, covariance, steps = averaged(
        np.array([mode.state for mode in modes]),
        np.array([mode.covariance for mode in modes]),
        best, counting, possible,
    )  # fmt: skip
    faces = may_face(frame, modes, state, covariance) if planar else None
    if faces is not None:
        covariance = reaching(covariance, faces.step, faces.evidence)
    costs = np.array([mode.cost for mode in modes])
    same = [alike(modes[best].state, mode.state, modes[best].covariance) for mode in modes]
    if not frame.assumed.may_rest and possible @ same > _ALONE:
        # Nothing but what was found, with its shaking.
        covariance = along_arcs(found.covariance, found.state[9:12])
        mirror = farthest(costs, evidence, steps, covariance) if planar else None
        return replace(found, covariance=covariance, mirror=mirror)
    # Shaking that was not seen may be there all the same, unless the camera rests.
    joint = max(1.0 - possible @ at_rest, 0.0) * found.covariance
    joint[:PARAMETERS, :PARAMETERS] = covariance
    joint[:PARAMETERS, PARAMETERS:] = 0.0
    joint[PARAMETERS:, :PARAMETERS] = 0.0
    return replace(
        found,
        state=state,
        covariance=joint,
        shake=np.zeros_like(found.shake),  # it was that beside another motion
        squared_errors=frame.observations.squared_errors(state),
        model_error=float(possible @ [mode.field for mode in modes]),
        mirror=farthest(costs, evidence, steps, covariance) if planar else None,
        facing=faces,
    )


def _modes(frame: Inliers, found: Posterior, planar: bool) -> list[Mode]:
    """A Gaussian for each speed and, before a plane, for either way that it may lean."""
    may_rest, turn_known = frame.assumed.may_rest, frame.assumed.turn is not None
    modes: list[Mode] = []
    near = at_rest(found.state) if may_rest else found.state
    points = frame.observations.points
    other, one = mirrored(points, frame.inliers, near) if planar else None, False
    for speed in _SPEEDS if may_rest else (1.0,):
        chosen = terms_at(frame.terms, speed, turn_known)
        mode = frame.mode(near, chosen, speed)
        modes.append(mode)
        near = mode.state
        if planar and other is None:
            other = mirrored(points, frame.inliers, near)
        if other is not None:
            twin = mode if one else _twin(frame, mode, other, chosen)
            modes.append(twin)
            other, one = twin.state, twin is mode or _out_of_question(frame, mode, twin)
        if max(mode.evidence for mode in modes if mode.speed == speed) < (
            max(mode.evidence for mode in modes) - _FAR_LESS_PROBABLE
        ):
            break  # what moves faster explains even less
    return modes


def _twin(frame: Inliers, mode: Mode, other: Array, terms: PriorTerms) -> Mode:
    """The Gaussian that a mirrored start (24,) leads to; the mode itself where they meet."""
    fitted = frame.fitted_from_afar(other, terms)
    if alike(mode.state, fitted[0], mode.covariance):
        return mode
    return frame.gaussian(fitted, terms, mode.speed, other)


def _out_of_question(frame: Inliers, mode: Mode, twin: Mode) -> bool:
    """Whether a mirrored pose is so far off that it need not be followed to where it ends.

    At full speed there is none but the best one, and this mode explains the points nearly as well.
    """
    return (
        mode.cost < frame.only_cost + 2.0 * _OUT_OF_QUESTION
        and twin.cost > mode.cost + 2.0 * _OUT_OF_QUESTION
        and twin.evidence < mode.evidence - _OUT_OF_QUESTION
    )


def _in_pieces(frame: Inliers, modes: list[Mode]) -> list[Mode]:
    """The modes, and in place of those of planes that nearly face the camera pieces of them."""
    supports = {mode.speed: -math.inf for mode in modes}
    for mode in modes:
        supports[mode.speed] = max(supports[mode.speed], mode.support)
    pieces: list[Mode] = []
    for speed, support in supports.items():
        here = [mode for mode in modes if mode.speed == speed]
        counts = support > max(supports.values()) - _HARDLY_COUNTS
        pieces += (pieces_of(frame, here, _FAR_LESS_PROBABLE) if counts else []) or here
    return pieces
