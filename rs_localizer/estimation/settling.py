"""From the best motion of a frame to the whole of what its points leave possible.

The best motion is one point of a posterior that need not look like a Gaussian about it:

* the camera may shake (:mod:`.hearing`, :mod:`.shaking`), and map and lens may be a little off
  (:mod:`.model_error`);
* the points may hardly tell a slow camera from a resting one, and before a plane motions of
  very different speed fit alike, along a curved valley: the typical speed is an unknown of its own;
* a plane may lean the other way (:mod:`rs_localizer.estimation.mirror`).

What is possible is averaged (:mod:`rs_localizer.estimation.mixture`).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.state import LINEAR, PARAMETERS, STATE_TRANSLATION, VELOCITIES, at_rest
from rs_localizer.estimation.assumptions import FIELD_PRIOR, Assumed
from rs_localizer.estimation.averaging import alike, volume_of
from rs_localizer.estimation.curvature import along_arcs
from rs_localizer.estimation.evidence import Sizes
from rs_localizer.estimation.mirror import CLEARLY_WORSE, mirrored
from rs_localizer.estimation.mixture import weighed
from rs_localizer.estimation.model_error import Examined
from rs_localizer.estimation.modes import DISTRUST, Inliers
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.posterior import Posterior, maximum_a_posteriori
from rs_localizer.estimation.prior_terms import PriorTerms, held_beside
from rs_localizer.estimation.refine import apply_step, inverted
from rs_localizer.estimation.shaking import AGREEMENT, DEGREES, Scales, follow
from rs_localizer.estimation.tone_mixture import ToneMixture, averaged
from rs_localizer.estimation.tone_search import FEW, find_tones, strangers_of

# Velocities beyond doubt, in squared standard deviations (four times the 99 % quantile of six), of
# which the prior knows less than this part.
_CLEARLY_MOVING = 67.0
_LITTLE_OF_THE_PRIOR = 0.05
# Degree of the polynomials of the shaking that are looked for in every frame: a cycle in one
# readout. What they find, or what neighbouring rows agree on beside them, is followed closer.
_SHAKE_DEGREE = 6
_SHAKING = 0.05
# Logarithm of the odds that shaking of any degree must gain where only neighbouring rows agree; and
# agreement, by chance in one frame of 700, that neither rest nor a wrong map explains.
_GAIN, _CERTAIN = 0.1, 3.0
# Where points are fewer, two for each of the coefficients, such a gain hides in their noise.
_ENOUGH_POINTS = 2 * 3 * (DEGREES[-1] - 1)
# More points than this only take time.
_MOST_POINTS = 2500
_MOST_SHARED = 0.9  # correlation of neighbours
# Beside few inliers: so many points just beyond the gate, and such a part of them, are no chance;
# nor are they the corners of one marker that is not where the map has it.
_STRANGERS, _PART = 5, 0.2


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
    if len(observations) <= _MOST_POINTS:
        found = _settled(observations, start, terms, threshold, assumed)
        shakes = assumed.rolling and assumed.turn is None
        return replace(found, strangers=_strangers(found, threshold)) if shakes else found
    found = _settled(observations.thinned(_MOST_POINTS), start, terms, threshold, assumed)
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
    frame = Inliers(observations, best, terms, assumed)
    other = mirrored(observations.points, best.inliers, best.state)
    mirrored_fits = False
    if other is not None:
        nearer, _ = frame.fitted_to_some(other, terms)
        rough = frame.fitted_roughly(nearer, terms)
        again = frame.fitted(best.state, terms)
        only = frame.leads_to(rough, again, best.covariance)
        state, cost = again if only else frame.fitted(nearer, terms)
        better = again[1] - cost
        mirrored_fits = abs(better) < CLEARLY_WORSE * best.noise**2
        if only or alike(again[0], state, best.covariance):
            frame.only = again
        if better > best.noise**2:
            best = maximum_a_posteriori(observations, state, terms, threshold)
            if not best.determined:
                return best
            frame = Inliers(observations, best, terms, assumed)
    examined = frame.examined(best.state, terms, _SHAKE_DEGREE if assumed.rolling else 0)
    if not examined.finite:
        return replace(best, smallest_eigenvalue=0.0)
    sizes = examined.sizes
    may_shake = assumed.rolling and not mirrored_fits
    # A gyroscope sees tones; what it leaves of them tells the offset of its stamps.
    may_be_tonal = may_shake and assumed.turn is None
    best = replace(
        best,
        of_shake_sizes=sizes.of_shake_sizes,
        of_field_sizes=sizes.of_field_sizes,
        of_tones=examined.tones.likelihood if may_be_tonal else best.of_tones,
    )
    tones, frame.unheard = (
        find_tones(frame, best, examined, threshold) if may_be_tonal else (None, None)
    )
    toned = _toned(best, tones) if tones and tones.certain else None
    if tones and toned and tones.tonal and toned.agreement < AGREEMENT:
        return toned
    seems_to_shake = may_shake and _seems_to_shake(frame, best, examined)
    certain = examined.agreement > _CERTAIN
    if seems_to_shake and (certain or not _rather_rests(frame, best, examined)):
        shaken = _followed(frame, best, sizes, threshold)
        if shaken and (sizes.no_shake < _SHAKING or shaken.noise < best.noise):
            return _either(tones, toned, shaken)
    if toned:
        return toned
    shared = examined.shared
    if may_shake and not seems_to_shake and examined.agreement > AGREEMENT:
        shared = max(shared, _correlation(examined.agreement, best.inliers))
    frame.worth = _worth(shared)
    # What the frame says of it: where it says nothing, the probability is the one assumed.
    seen = max(1.0 - sizes.no_field / FIELD_PRIOR[0], 0.0)
    frame.odds += seen * math.log(DISTRUST)
    found = replace(
        best,
        state=apply_step(best.state, examined.step[:PARAMETERS]),
        covariance=best.inflation / frame.worth * examined.covariance,
        shake=examined.step[PARAMETERS:].reshape(-1, 3),
        model_error=sizes.field,
        agreement=examined.agreement,
    )
    planar = other is not None
    if not planar:
        frame.linear = best.state, examined.columns
    turn_known = assumed.turn is not None
    still = assumed.of_rest > 0.0 or not _clearly_moving(found, terms, turn_known)
    if planar or (assumed.may_rest and still):
        found = weighed(frame, found, planar)
    elif frame.unheard is not None:
        found.covariance[:PARAMETERS, :PARAMETERS] += frame.unheard
    return averaged(tones, found) if tones else found


def _strangers(found: Posterior, threshold: float) -> int:
    """Points that few inliers swing by, and no shaking explains; 0 where they may be chance."""
    inliers = np.count_nonzero(found.inliers)
    strangers = strangers_of(found.squared_errors, found.inliers, threshold)
    return strangers if inliers < FEW and strangers >= max(_STRANGERS, _PART * inliers) else 0


def _seems_to_shake(frame: Inliers, best: Posterior, examined: Examined) -> bool:
    """Whether the camera may shake by so much that it has to be followed.

    One frame in twenty has neighbours that agree by chance. To follow it takes several times as
    long as all the rest and finds nothing, as one linear solve tells.
    """
    agree = examined.agreement > AGREEMENT
    if agree and best.inliers.sum() >= _ENOUGH_POINTS:
        gain = frame.gain_of_shaking(best.state, frame.terms, DEGREES[-1])
        agree = gain > _GAIN or examined.agreement > _CERTAIN
    return agree or examined.sizes.no_shake < _SHAKING


def _correlation(agreement: float, inliers: BoolArray) -> float:
    """Correlation of neighbours among so many inliers (n,) that agree by standard deviations."""
    correlation = max(agreement, 0.0) / math.sqrt(2.0 * max(inliers.sum(), 1))
    return min(correlation, _MOST_SHARED)


def _rather_rests(frame: Inliers, best: Posterior, examined: Examined) -> bool:
    """Whether a camera at rest, with a map or a lens that is a little off, explains as much."""
    if not frame.assumed.may_rest:
        return False
    still = at_rest(best.state)
    turn = frame.assumed.turn
    rest = frame.mode(still, held_beside(frame.terms, turn is not None), 0.0)
    moving = examined.sizes.evidence + volume_of(frame.terms, examined)
    if turn is not None:
        moving += turn.evidence(1.0)
    return rest.evidence + frame.odds > moving


def _followed(frame: Inliers, best: Posterior, sizes: Sizes, threshold: float) -> Posterior | None:
    """The posterior of a camera that shakes; None if it cannot be followed."""
    observations = frame.observations
    scales = Scales(sizes.noise, sizes.shake, frame.assumed.shake, threshold)
    shaken = follow(observations, best.state, best.inliers, frame.terms, scales)
    if shaken is None:
        return None
    worth = _worth(_correlation(shaken.agreement, shaken.inliers))
    covariance = best.inflation / worth * shaken.covariance
    return replace(
        best,
        state=shaken.state,
        covariance=along_arcs(covariance, shaken.state[STATE_TRANSLATION]),
        noise=shaken.noise,
        squared_errors=shaken.squared_errors,
        inliers=shaken.inliers,
        shake=shaken.coefficients,
        agreement=shaken.agreement,
    )


def _toned(best: Posterior, tones: ToneMixture) -> Posterior:
    """The posterior of a camera that tones shake."""
    found = averaged(tones, best)
    worth = _worth(_correlation(tones.agreement, found.inliers))
    return replace(
        found,
        covariance=found.covariance / worth,
        exhausted=tones.exhausted,
    )


def _either(tones: ToneMixture | None, toned: Posterior | None, shaken: Posterior) -> Posterior:
    """What tones and polynomials make of a shaking together: neither is known to be right."""
    if tones is None or (toned is None and tones.agreement > AGREEMENT):
        return shaken
    if toned is None:
        return averaged(tones, shaken)
    if max(toned.agreement, shaken.agreement) > AGREEMENT:
        return min(toned, shaken, key=lambda found: found.agreement)
    return averaged(replace(tones, none=0.5, probabilities=0.5 * tones.probabilities), shaken)


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


def _worth(correlation: float) -> float:
    """What a point is worth whose error is correlated with its neighbour's (first order)."""
    return (1.0 - correlation) / (1.0 + correlation)
