"""From the best motion of a frame to the whole of what its points leave possible.

The best motion is one point of a posterior that need not look like a Gaussian about it:

* the camera may shake, and map and lens may be a little off (:mod:`.model_error`);
* the points may hardly tell a slow camera from a resting one, and before a plane motions of
  very different speed fit alike, along a curved valley: the typical speed is an unknown of its own;
* a plane may lean the other way (:mod:`rs_localizer.estimation.mirror`).

Every combination that is possible is fitted, becomes one Gaussian, and counts by its probability;
what goes out is one Gaussian with the mean and the covariance of them all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.state import LINEAR, PARAMETERS, VELOCITIES
from rs_localizer.estimation.evidence import Sizes
from rs_localizer.estimation.mirror import mirrored
from rs_localizer.estimation.model_error import Examined, examine
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.posterior import Mirror, Posterior, fit, maximum_a_posteriori
from rs_localizer.estimation.prior import PriorTerms, held_beside, slower_terms
from rs_localizer.estimation.refine import apply_step, inverted, step_between
from rs_localizer.estimation.shaking import AGREEMENT, follow

# Typical speeds to try, as parts of the configured one; 0 is a camera at rest.
_SPEEDS = (0.0, 0.03, 0.1, 0.3, 1.0)
# Odds by which motion must explain the points better than rest, to count in the estimate. Where a
# map or a lens is seen to be wrong, what looks like motion mostly is more of that, and the odds
# grow by the second factor. The covariance allows for motion at even odds.
_ODDS_AGAINST_MOTION = 100.0
_DISTRUST = 1e9
# Of Occam's factor in the covariance: what is simpler is more probable, but who moves is not served
# by that.
_GENEROSITY = 0.5
# Velocities beyond doubt, in squared standard deviations (four times the 99 % quantile of six), of
# which the prior knows less than this part.
_CLEARLY_MOVING = 67.0
_LITTLE_OF_THE_PRIOR = 0.05
# Degree of the polynomials of the shaking that are looked for in every frame: a cycle in one
# readout. What they find, or what neighbouring rows agree on beside them, is followed closer.
_SHAKE_DEGREE = 6
_SHAKING = 0.05
# Sizes to try, as multiples of the least, and their probabilities.
_SHAKE_SIZES = 10.0 ** np.arange(0.0, 5.1)
_SHAKE_PRIOR = np.array([0.6, 0.15, 0.12, 0.09, 0.03, 0.01])
_FIELD_SIZES = 10.0 ** np.arange(0.0, 2.1, 0.5)
# Lenses and maps are never better than this, px: a hundredth; whose errors are a pixel, are rare.
_LEAST_FIELD = 0.01
_FIELD_PRIOR = np.array([0.5, 0.25, 0.2, 0.048, 0.002])
# More points than this only take time.
_MOST_POINTS = 2500
# Points nearer than this (m) would make any map useless.
_NEAREST = 1e-6
# Logarithm of the odds of a typical speed beside a better one, beyond which none is tried.
_FAR_LESS_PROBABLE = 7.0
# A pose that fits worse by this many noise variances is out of the question: odds of 100 to 1.
_CLEARLY_WORSE = 9.2
_MOST_SHARED = 0.9  # correlation of neighbours
# The covariance speaks for poses within so many standard deviations of the orientation.
_COVERED = 4.0


SHAKE_SIZES, FIELD_SIZES = len(_SHAKE_SIZES), len(_FIELD_SIZES)


@dataclass(frozen=True, slots=True)
class TurnSeen:
    """What a gyroscope says of the speed of a motion."""

    squared_rate: float  # (rad per readout)^2
    variance: float  # of each axis, if the camera is at rest
    typical_variance: float  # of each axis, by the prior of the motion

    def evidence(self, speed: float) -> float:
        """Logarithm of the likelihood of a typical speed, but for a constant."""
        variance = self.variance + speed**2 * self.typical_variance
        return -0.5 * (self.squared_rate / variance + 3.0 * math.log(variance))


@dataclass(frozen=True, slots=True, eq=False)
class Assumed:
    """What is assumed of a camera and its map, beside the prior of the motion."""

    shake: float  # rad, of each polynomial: as much as the jerk of an ordinary motion
    map_deviation: float  # m
    focal_length: float  # px
    # Logarithms of the odds of each size beside those of any camera: what its last frames said.
    of_shake_sizes: Array
    of_field_sizes: Array
    may_rest: bool  # nothing speaks for a motion but the points
    rolling: bool  # velocities are estimated
    turn: TurnSeen | None = None  # by a gyroscope

    def field_sizes(self, depth: float) -> Array:
        """Standard deviations (k,) of the field to try, px, of points so far away (m)."""
        least = math.hypot(_LEAST_FIELD, self.map_deviation * self.focal_length / depth)
        sizes: Array = least * _FIELD_SIZES
        return sizes


@dataclass(frozen=True, slots=True, eq=False)
class _Mode:
    """One combination: a Gaussian and the logarithm of its probability, but for a constant."""

    state: Array  # (24,)
    covariance: Array  # (18,18)
    evidence: float
    volume: float  # the part of the evidence that speaks for few possibilities (Occam's factor)
    cost: float  # of its fit, noise variances
    speed: float
    field: float  # px


class _Frame:
    """The inliers of one frame and what is the same for all combinations."""

    def __init__(
        self, observations: Observations, best: Posterior, terms: PriorTerms, assumed: Assumed
    ) -> None:
        self.observations, self.terms, self.assumed = observations, terms, assumed
        self.inliers, self.noise, self.inflation = best.inliers, best.noise, best.inflation
        depths = (observations.points @ best.state[6:9] + best.state[11])[best.inliers]
        count = len(depths)
        depth = float(np.partition(depths, count // 2)[count // 2]) if count else 1.0
        self.field_sizes = assumed.field_sizes(max(depth, _NEAREST))
        self.freedom = max(2.0 * count - 6.0, 1.0)
        # What a point is worth beside one whose error is its own (an effective number of points).
        self.worth = 1.0
        self.odds = math.log(_ODDS_AGAINST_MOTION)  # logarithm
        self.shake_prior = _more_probable(_SHAKE_PRIOR, assumed.of_shake_sizes)
        self.field_prior = _more_probable(_FIELD_PRIOR, assumed.of_field_sizes)

    def fitted(self, start: Array, terms: PriorTerms) -> tuple[Array, float]:
        """State (24,) and cost of the best motion near a state."""
        found = fit(self.observations, start, self.inliers, terms, self.noise)
        return found[0], found[2]

    def examined(self, state: Array, terms: PriorTerms, degree: int) -> Examined:
        """Shaking, up to a degree (0: none), and field at the best motion."""
        observations = self.observations
        found: Examined = examine(
            observations.packed, state, observations.row_time_gradient, observations.rays,
            observations.tau, self.inliers, terms, degree, self.freedom, self.noise,
            self.assumed.shake * _SHAKE_SIZES, self.shake_prior,
            self.field_sizes, self.field_prior,
        )  # fmt: skip
        return found

    def mode(self, start: Array, terms: PriorTerms, speed: float) -> _Mode:
        """The Gaussian about the best motion of a typical speed."""
        state, cost = self.fitted(start, terms)
        examined = self.examined(state, terms, 0)
        volume = _volume(terms, examined)
        evidence = self.worth * (examined.sizes.evidence + volume)
        if self.assumed.turn is not None:
            evidence += self.assumed.turn.evidence(speed)
        return _Mode(
            state,
            self.inflation / self.worth * examined.covariance,
            evidence,
            self.worth * volume,
            cost / self.noise**2,
            speed,
            examined.sizes.field,
        )


def settle(
    observations: Observations,
    start: Array,
    terms: PriorTerms,
    threshold: float,
    assumed: Assumed,
) -> Posterior:
    """What the points leave possible, near a first motion.

    Of very many points a part is enough, evenly taken.

    Args:
        start: state (24,).
        terms: what is known of the motion beside the points.
        threshold: px, of inliers.
        assumed: of the camera.
    """
    every = -(-len(observations) // _MOST_POINTS)
    if every <= 1:
        return _settled(observations, start, terms, threshold, assumed)
    found = _settled(observations.thinned(every), start, terms, threshold, assumed)
    gate = np.sqrt(found.squared_errors[found.inliers].max(initial=0.0))
    errors = observations.squared_errors(found.state)
    return replace(found, squared_errors=errors, inliers=errors <= gate**2)


def _settled(
    observations: Observations,
    start: Array,
    terms: PriorTerms,
    threshold: float,
    assumed: Assumed,
) -> Posterior:
    best = maximum_a_posteriori(observations, start, terms, threshold)
    if not best.determined:
        return best
    frame = _Frame(observations, best, terms, assumed)
    other = mirrored(observations.points, best.inliers, best.state)
    mirrored_fits = False
    if other is not None:
        state, cost = frame.fitted(other, terms)
        better = frame.fitted(best.state, terms)[1] - cost
        mirrored_fits = abs(better) < _CLEARLY_WORSE * best.noise**2
        if better > best.noise**2:
            best = maximum_a_posteriori(observations, state, terms, threshold)
            if not best.determined:
                return best
            frame = _Frame(observations, best, terms, assumed)
    examined = frame.examined(best.state, terms, _SHAKE_DEGREE if assumed.rolling else 0)
    sizes = examined.sizes
    seems_to_shake = sizes.no_shake < _SHAKING or examined.agreement > AGREEMENT
    if (
        assumed.rolling
        and seems_to_shake
        and not mirrored_fits
        and not _rather_rests(frame, best, examined)
    ):
        shaken = _followed(frame, best, sizes, threshold)
        if shaken and (sizes.no_shake < _SHAKING or shaken.noise < best.noise):
            return shaken
    frame.worth = _worth(examined.shared)
    # What the frame says of it: where it says nothing, the probability is the one assumed.
    seen = max(1.0 - sizes.no_field / _FIELD_PRIOR[0], 0.0)
    frame.odds += seen * math.log(_DISTRUST)
    found = replace(
        best,
        state=apply_step(best.state, examined.step[:PARAMETERS]),
        covariance=best.inflation / frame.worth * examined.covariance,
        shake=examined.step[PARAMETERS:].reshape(-1, 3),
        model_error=sizes.field,
        of_shake_sizes=sizes.of_shake_sizes,
        of_field_sizes=sizes.of_field_sizes,
        agreement=examined.agreement,
    )
    planar = other is not None
    turn_known = assumed.turn is not None
    if planar or (assumed.may_rest and not _clearly_moving(found, terms, turn_known)):
        return _weighed(frame, found, planar)
    return found


def _rather_rests(frame: _Frame, best: Posterior, examined: Examined) -> bool:
    """Whether a camera at rest, with a map or a lens that is a little off, explains as much."""
    if not frame.assumed.may_rest:
        return False
    still = np.concatenate([best.state[:12], np.zeros(12)])
    turn = frame.assumed.turn
    rest = frame.mode(still, held_beside(frame.terms, turn is not None), 0.0)
    moving = examined.sizes.evidence + _volume(frame.terms, examined)
    if turn is not None:
        moving += turn.evidence(1.0)
    return rest.evidence + frame.odds > moving


def _volume(terms: PriorTerms, examined: Examined) -> float:
    """The part of the evidence that speaks for few possibilities of the motion."""
    known = np.diag(terms.informations[0])
    return float(0.5 * (np.log(known[known > 0.0]).sum() - examined.determined))


def _followed(frame: _Frame, best: Posterior, sizes: Sizes, threshold: float) -> Posterior | None:
    """The posterior of a camera that shakes; None if it cannot be followed."""
    observations = frame.observations
    shaken = follow(
        observations, best.state, best.inliers, frame.terms, sizes.noise, sizes.shake,
        frame.assumed.shake, threshold,
    )  # fmt: skip
    if shaken is None:
        return None
    correlation = max(shaken.agreement, 0.0) / math.sqrt(2.0 * max(shaken.inliers.sum(), 1))
    worth = _worth(min(correlation, _MOST_SHARED))
    return replace(
        best,
        state=shaken.state,
        covariance=best.inflation / worth * shaken.covariance,
        noise=shaken.noise,
        squared_errors=shaken.squared_errors,
        inliers=shaken.inliers,
        shake=shaken.coefficients,
        agreement=shaken.agreement,
        of_shake_sizes=sizes.of_shake_sizes,
        of_field_sizes=sizes.of_field_sizes,
    )


def _clearly_moving(found: Posterior, terms: PriorTerms, turn_known: bool) -> bool:
    """Whether neither rest nor another typical speed would change anything."""
    chosen = LINEAR if turn_known else VELOCITIES  # of the others the gyroscope knows
    spread = found.covariance[chosen, chosen]
    information = inverted(np.ascontiguousarray(spread))
    velocities = found.state[6:][chosen]  # behind the pose a state is longer by six
    # The trace is as much as the largest eigenvalue could be.
    part = float(np.diag(terms.informations[0])[chosen] @ np.diag(spread))
    return bool(
        part < _LITTLE_OF_THE_PRIOR and velocities @ information @ velocities > _CLEARLY_MOVING
    )


def _weighed(frame: _Frame, found: Posterior, planar: bool) -> Posterior:
    """The average of all combinations, and the mirrored pose if it cannot be ruled out."""
    modes = _modes(frame, found, planar)
    evidence = np.array([mode.evidence for mode in modes])
    at_rest = np.array([mode.speed == 0.0 for mode in modes])
    possible = _normalized(evidence - _GENEROSITY * np.array([mode.volume for mode in modes]))
    counting = _normalized(evidence + frame.odds * at_rest)
    best = int(np.argmax(counting))
    steps = np.array([step_between(modes[best].state, mode.state) for mode in modes])
    mean = counting @ steps
    state = apply_step(modes[best].state, mean)
    offsets = steps - mean
    covariance = np.einsum("k,ki,kj->ij", possible, offsets, offsets)
    for probability, mode in zip(possible, modes, strict=True):
        covariance += probability * mode.covariance
    # Shaking that was not seen may be there all the same.
    joint = found.covariance.copy()
    joint[:PARAMETERS, :PARAMETERS] = covariance
    joint[:PARAMETERS, PARAMETERS:] = 0.0
    joint[PARAMETERS:, :PARAMETERS] = 0.0
    return replace(
        found,
        state=state,
        covariance=joint,
        squared_errors=frame.observations.squared_errors(state),
        model_error=float(possible @ [mode.field for mode in modes]),
        mirror=_mirror(modes, evidence, steps, covariance) if planar else None,
    )


def _modes(frame: _Frame, found: Posterior, planar: bool) -> list[_Mode]:
    """A Gaussian for each speed and, before a plane, for either way that it may lean."""
    terms, may_rest = frame.terms, frame.assumed.may_rest
    turn_known = frame.assumed.turn is not None
    modes: list[_Mode] = []
    near = np.concatenate([found.state[:12], np.zeros(12)]) if may_rest else found.state
    other = mirrored(frame.observations.points, frame.inliers, near) if planar else None
    for speed in _SPEEDS if may_rest else (1.0,):
        if speed == 0.0:
            chosen = held_beside(terms, turn_known)
        else:
            chosen = terms if speed == 1.0 else slower_terms(terms, speed, turn_known)
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


def _worth(correlation: float) -> float:
    """What a point is worth whose error is correlated with its neighbour's (first order)."""
    return (1.0 - correlation) / (1.0 + correlation)


def _more_probable(prior: Array, odds: Array) -> Array:
    return _normalized(np.log(prior) + odds)


def _normalized(evidence: Array) -> Array:
    weights = np.exp(evidence - evidence.max())
    normalized: Array = weights / weights.sum()
    return normalized


def _mirror(modes: list[_Mode], evidence: Array, steps: Array, covariance: Array) -> Mirror | None:
    """The farthest pose that is not out of the question: neither unlikely nor of a bad fit."""
    costs = np.array([mode.cost for mode in modes])
    best = int(np.argmax(evidence))
    worse = np.maximum(2.0 * (evidence[best] - evidence), costs - costs[best])
    turns = np.where(worse < _CLEARLY_WORSE, np.linalg.norm(steps[:, :3], axis=1), 0.0)
    far = int(np.argmax(turns))
    if turns[far] == 0.0:
        return None
    # Curved valleys leave the ellipsoid early; the longest axis tells how far they go.
    deviation = math.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1])
    return Mirror(steps[far], float(worse[far]), bool(turns[far] < _COVERED * deviation))
