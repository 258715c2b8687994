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
from rs_localizer.core.state import PARAMETERS, TURN, at_rest, depths, step_between
from rs_localizer.estimation.assumptions import FIELD_PRIOR, SHAKE_PRIOR, SHAKE_SIZES, Assumed
from rs_localizer.estimation.curvature import along_arcs, told_from
from rs_localizer.estimation.face_on import (
    DENIED,
    NEARBY,
    OVERLAP,
    RULED_OUT,
    held_facing,
    reaching,
    squared_deviations,
    windows,
)
from rs_localizer.estimation.mirror import mirrored
from rs_localizer.estimation.model_error import Examined, examine, gain_of_shaking
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.posterior import Mirror, Posterior, fit
from rs_localizer.estimation.prior_terms import PriorTerms, held_beside, slower_terms
from rs_localizer.estimation.refine import apply_step

# Typical speeds to try, as parts of the configured one; 0 is a camera at rest.
_SPEEDS = (0.0, 0.03, 0.1, 0.3, 1.0)
# Along the flat valleys of small planes a fit may end before its steps do.
_FITS = 4
# Odds by which motion must explain the points better than rest, to count in the estimate. Where a
# map or a lens is seen to be wrong, what looks like motion mostly is more of that, and the odds
# grow by the second factor. The covariance allows for motion at even odds.
_ODDS_AGAINST_MOTION = 100.0
DISTRUST = 1e9
# Of Occam's factor in the covariance: what is simpler is more probable, but who moves is not served
# by that.
_GENEROSITY = 0.5
_LEAST_PROBABLE = 1e-200  # of which there still is a logarithm
# Probabilities that have no part in the covariance.
_NO_PART = 1e-5
# Points nearer than this (m) would make any map useless.
_NEAREST = 1e-6
# Logarithm of the odds of a typical speed beside a better one, beyond which none is tried.
_FAR_LESS_PROBABLE = 7.0
# Likewise, beyond which a typical speed hardly counts in the covariance.
_HARDLY_COUNTS = 3.0
# A pose that fits worse by this many noise variances is out of the question: odds of 100 to 1.
CLEARLY_WORSE = 9.2
# The covariance speaks for poses within so many standard deviations of the orientation.
_COVERED = 4.0


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
        before = depths(best.state, observations.points)[best.inliers]
        count = len(before)
        depth = float(np.partition(before, count // 2)[count // 2]) if count else 1.0
        self.field_sizes = assumed.field_sizes(max(depth, _NEAREST))
        self.freedom = max(2.0 * count - 6.0, 1.0)
        # What a point is worth beside one whose error is its own (an effective number of points).
        self.worth = 1.0
        self.odds = math.log(_ODDS_AGAINST_MOTION)  # logarithm
        self.shake_prior = _more_probable(SHAKE_PRIOR, assumed.of_shake_sizes)
        self.field_prior = _more_probable(FIELD_PRIOR, assumed.of_field_sizes)

    def fitted(self, start: Array, terms: PriorTerms) -> tuple[Array, float]:
        """State (24,) and cost of the best motion near a state."""
        for _ in range(_FITS):
            start, _, cost, converged = fit(
                self.observations, start, self.inliers, terms, self.noise
            )
            if converged:
                break
        return start, cost

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
        state, cost = self.fitted(start, terms)
        examined = self.examined(state, terms, 0, neighbours=False)
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


def volume_of(terms: PriorTerms, examined: Examined) -> float:
    """The part of the evidence that speaks for few possibilities of the motion."""
    known = np.diag(terms.informations[0])
    return float(0.5 * (np.log(known[known > 0.0]).sum() - examined.determined))


def weighed(frame: Inliers, found: Posterior, planar: bool) -> Posterior:
    """The average of all combinations, and the mirrored pose if it cannot be ruled out."""
    modes = _modes(frame, found, planar)
    if planar:
        modes = _in_pieces(frame, modes)
    evidence = np.array([mode.evidence for mode in modes])
    if not np.any(evidence > -math.inf):
        return replace(found, smallest_eigenvalue=0.0)
    at_rest = np.array([mode.speed == 0.0 for mode in modes])
    possible = _normalized(np.array([mode.support for mode in modes]))
    counting = _normalized(evidence + frame.odds * at_rest)
    best = int(np.argmax(counting))
    steps = np.array([step_between(modes[best].state, mode.state) for mode in modes])
    mean = counting @ steps
    state = apply_step(modes[best].state, mean)
    offsets = steps - mean
    covariance = np.einsum("k,ki,kj->ij", possible, offsets, offsets)
    for k in np.flatnonzero(possible > _NO_PART):
        covariance += possible[k] * told_from(modes[k].covariance, offsets[k, TURN])
    faces = _facing(frame, modes, state, covariance) if planar else None
    if faces is not None:
        covariance = reaching(covariance, faces.step, faces.evidence)
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
        mirror=_mirror(modes, evidence, steps, covariance) if planar else None,
        facing=faces,
    )


def _facing(frame: Inliers, modes: list[Mode], state: Array, covariance: Array) -> Mirror | None:
    """The pose of a plane that faces the camera, from a state, unless it is ruled out."""
    window = held_facing(frame.observations.points, frame.inliers, state, covariance)
    if window is None:
        return None
    most, found = max(mode.evidence for mode in modes), None
    near = float(np.linalg.norm(step_between(state, window.state)[TURN])) < NEARBY
    fastest = {mode.speed: mode for mode in sorted(modes, key=lambda mode: mode.evidence)}
    for mode in fastest.values():
        unlikely = 2.0 * (most - mode.evidence)
        if unlikely < RULED_OUT:
            terms = window.times(_terms_at(frame, mode.speed))
            there, cost = frame.fitted(window.state, terms)
            worse = max(cost / frame.noise**2 - mode.cost, 1.0)
            apart = squared_deviations(mode.covariance, step_between(mode.state, there))
            denied = apart > DENIED * worse
            if denied and unlikely + worse < (found.evidence if found else RULED_OUT):
                found = Mirror(step_between(state, there), unlikely + worse, covered=near)
    return found


def _modes(frame: Inliers, found: Posterior, planar: bool) -> list[Mode]:
    """A Gaussian for each speed and, before a plane, for either way that it may lean."""
    may_rest = frame.assumed.may_rest
    modes: list[Mode] = []
    near = at_rest(found.state) if may_rest else found.state
    other = mirrored(frame.observations.points, frame.inliers, near) if planar else None
    for speed in _SPEEDS if may_rest else (1.0,):
        chosen = _terms_at(frame, speed)
        modes.append(frame.mode(near, chosen, speed))
        near = modes[-1].state
        if planar and other is None:
            other = mirrored(frame.observations.points, frame.inliers, near)
        if other is not None:
            modes.append(frame.mode(other, chosen, speed))
            other = modes[-1].state
        if max(mode.evidence for mode in modes if mode.speed == speed) < (
            max(mode.evidence for mode in modes) - _FAR_LESS_PROBABLE
        ):
            break  # what moves faster explains even less
    return modes


def _terms_at(frame: Inliers, speed: float) -> PriorTerms:
    turn_known = frame.assumed.turn is not None
    if speed == 0.0:
        return held_beside(frame.terms, turn_known)
    return frame.terms if speed == 1.0 else slower_terms(frame.terms, speed, turn_known)


def _in_pieces(frame: Inliers, modes: list[Mode]) -> list[Mode]:
    """The modes, and in place of those of planes that nearly face the camera pieces of them."""
    supports = {mode.speed: -math.inf for mode in modes}
    for mode in modes:
        supports[mode.speed] = max(supports[mode.speed], mode.support)
    pieces: list[Mode] = []
    for speed, support in supports.items():
        here = [mode for mode in modes if mode.speed == speed]
        counts = support > max(supports.values()) - _HARDLY_COUNTS
        pieces += (_pieces(frame, here) if counts else []) or here
    return pieces


def _pieces(frame: Inliers, modes: list[Mode]) -> list[Mode]:
    best = min(modes, key=lambda mode: mode.cost)
    terms, pieces = _terms_at(frame, best.speed), list[Mode]()
    points = frame.observations.points
    for window in windows(points, frame.inliers, best.state, best.covariance):
        piece = frame.mode(window.state, window.times(terms), best.speed)
        pieces.append(replace(piece, evidence=piece.evidence - OVERLAP))
        if piece.evidence < max(one.evidence for one in pieces) - _FAR_LESS_PROBABLE:
            break
    return pieces


def _more_probable(prior: Array, odds: Array) -> Array:
    # Frames may be so sure together that the rest vanishes, but nothing is impossible.
    return np.maximum(_normalized(np.log(prior) + odds), _LEAST_PROBABLE)


def _normalized(evidence: Array) -> Array:
    weights = np.exp(evidence - evidence.max())
    normalized: Array = weights / weights.sum()
    return normalized


def _mirror(modes: list[Mode], evidence: Array, steps: Array, covariance: Array) -> Mirror | None:
    """The farthest pose that is not out of the question: neither unlikely nor of a bad fit."""
    costs = np.array([mode.cost for mode in modes])
    best = int(np.argmax(evidence))
    worse = np.maximum(2.0 * (evidence[best] - evidence), costs - costs[best])
    turns = np.where(worse < CLEARLY_WORSE, np.linalg.norm(steps[:, :3], axis=1), 0.0)
    far = int(np.argmax(turns))
    if turns[far] == 0.0:
        return None
    # Curved valleys leave the ellipsoid early; the longest axis tells how far they go.
    deviation = math.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    return Mirror(steps[far], float(worse[far]), bool(turns[far] < _COVERED * deviation))
