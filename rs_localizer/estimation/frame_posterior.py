# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The posterior of a frame: one model, its modes, and one Gaussian of them all.

docs/estimator.md is the page. The discrete alternatives of a frame, {rest, typical speeds} and
{steady, vibrating}, become Gaussians with their evidence (:mod:`.modes`, :mod:`.turn`); the
mixture's mean and covariance go out.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2
from rs_localizer.core.shake import MIDDLE_RATES, shake_at
from rs_localizer.core.state import ANGULAR, MOTION_PARAMETERS, PARAMETERS, POSE, POSE_SIZE
from rs_localizer.estimation.correlated import (
    ORDINARY,
    Noise,
    SmoothError,
    bend_of,
    nothing_shared,
    smooth_error,
)
from rs_localizer.estimation.first_look import Look, first_look, near_outliers
from rs_localizer.estimation.modes import (
    REST_ODDS,
    TEMPER,
    Frame,
    Mixture,
    mixed,
    mixture_of,
)
from rs_localizer.estimation.observations import MOST_POINTS, NEAREST, Observations
from rs_localizer.estimation.posterior import GATE, WIDEST_GATE, Posterior
from rs_localizer.estimation.prior import SPEEDS, Assumed, PriorTerms, terms_at
from rs_localizer.estimation.refine import LEAST_NOISE, apply_step
from rs_localizer.estimation.residuals import linearized
from rs_localizer.estimation.turn import TurnFit, fit_turn, hidden_turn
from rs_localizer.native import entry

# Of the typical speeds.
_RESTS = np.array([speed == 0.0 for speed in SPEEDS], float)
# Shaking of up to this (rad, 2 deg) moves points out of the gate of a motion without it.
_LARGEST_SHAKE = 0.035
# A fit that loses more inliers than this part leaves is another group of points.
_KEPT = 0.9
# Probability that does not count.
_NO_PART = 1e-4
# Logarithm of the odds of none against an in-frame turn, before any frame: as for rest.
_STEADY_ODDS = REST_ODDS
# Of the cameras that do not show it, one in ten shakes.
_HIDDEN_ODDS = math.log(10.0)
# Logarithm of the evidence of an ordinary vibration against none from which it is fitted.
_ASKS = -0.5
_FEWEST = 6


class _Given(NamedTuple):
    """The points of a frame, and what is known of it."""

    observations: Observations
    terms: PriorTerms
    threshold: float  # px, of inliers
    assumed: Assumed
    slowest: int  # index of the first typical speed that is weighed


def frame_posterior(
    observations: Observations, start: Array, terms: PriorTerms, threshold: float, assumed: Assumed,
    one_lens: bool = True,
) -> Posterior:  # fmt: skip
    """Posterior of the motion by the points, near a first motion.

    Args:
        observations: the points; of very many a part is enough, evenly taken.
        start: state (24,).
        terms: what is known of the motion beside the points.
        threshold: px, of inliers.
        assumed: of the camera.
        one_lens: one camera sees them all; of two lenses a smooth error is not one polynomial.
    """
    if observations.count > MOST_POINTS:
        some = np.linspace(0, observations.count - 1, MOST_POINTS).astype(np.int64)
        part = _of_points(observations.only(some), start, terms, threshold, assumed, one_lens)
        lines = linearized(
            observations.packed, observations.count, part.state,
            shake_at(observations.tau, part.shake),
        )  # fmt: skip
        errors = np.sum(lines.errors**2, axis=1)
        # The farthest inlier of the part is one of all points: no rounding leaves it out.
        inliers = errors <= errors[some][part.inliers].max(initial=0.0)
        bend = part.bend
        if bend.shape[1]:
            depth = max(observations.median_depth(part.state, inliers), NEAREST)
            bend = bend_of(observations.points, inliers, depth / assumed.focal_length)
        return part._replace(squared_errors=errors, inliers=inliers, bend=bend)
    return _of_points(observations, start, terms, threshold, assumed, one_lens)


def _of_points(
    observations: Observations, start: Array, terms: PriorTerms, threshold: float, assumed: Assumed,
    one_lens: bool,
) -> Posterior:  # fmt: skip
    declares, turn_known = assumed.map_deviation > 0.0, assumed.turn is not None
    look = first_look(
        observations.packed, observations.points, start, terms, threshold, assumed.rolling,
        turn_known,
    )  # fmt: skip
    best = Posterior(*look.best)
    if not best.determined or np.count_nonzero(best.inliers) < _FEWEST:
        return best
    declared = assumed.map_deviation * assumed.focal_length / look.depth
    best = best._replace(near_outliers=look.near_outliers, declared=declared)
    moving = look.moving and not declares and not look.planar
    slowest = 0 if assumed.may_rest and not moving else len(SPEEDS) - 1
    bend = np.zeros((observations.count, 0))
    if declares and assumed.rolling:
        bend = bend_of(observations.points, best.inliers, look.depth / assumed.focal_length)
    odds = assumed.of_rest * _RESTS
    if assumed.turn is not None:
        odds = odds + [assumed.turn.evidence(speed) for speed in SPEEDS]
    if assumed.rolling and one_lens:
        log_size = math.log(declared if declared > 0.0 else ORDINARY)
        smooth = smooth_error(look.lines, best.inliers, bend, log_size)
    else:
        smooth = nothing_shared(int(np.count_nonzero(best.inliers)))
    found = _steady(
        observations.packed, observations.points, look, smooth, terms, odds, slowest, turn_known,
        assumed.focal_length,
    )  # fmt: skip
    if found.evidence == -math.inf:
        return best._replace(smallest_eigenvalue=0.0)
    noise, shared, freedom = found.errors.tolist()
    steady = best._replace(
        state=found.state,
        covariance=found.covariance,
        arched=found.arched,
        squared_errors=observations.squared_errors(found.state),
        noise=noise,
        freedom=freedom,
        model_error=shared,
        shared=shared,
        bend=bend,
        speeds=found.speeds,
    )
    if not assumed.rolling or (declares and look.planar):
        # What looks like vibration before a board that is bent is more of its bend.
        return steady
    evidence = found.evidence - math.log(len(SPEEDS) - slowest)
    # Points that are no inliers are anywhere in an image of a focal length squared.
    outside = observations.count - np.count_nonzero(best.inliers)
    evidence -= 2.0 * outside * math.log(assumed.focal_length)
    return _with_turn(
        _Given(observations, terms, threshold, assumed, slowest), look, smooth, steady, evidence
    )


@entry
def _steady(
    data: Array2, points: Array2, look: Look, smooth: SmoothError, terms: PriorTerms, odds: Array1,
    slowest: int, turn_known: bool, focal_length: float,
) -> Mixture:  # fmt: skip
    """The mixture of all modes of a camera that does not turn within its frame."""
    best = look.best
    raw = 0.0
    for i in range(len(best.inliers)):
        if best.inliers[i]:
            raw += best.squared_errors[i]
    equations = 2.0 * np.count_nonzero(best.inliers)
    raw = raw / max(best.freedom, 1.0)
    noise = Noise(
        best.noise, max(best.noise**2 / max(raw, LEAST_NOISE**2), 1.0),
        max(equations - best.freedom, 0.0),
    )  # fmt: skip
    frame = Frame(data, points, best.inliers, smooth, noise, focal_length, look.depth)
    return mixture_of(frame, best.state, terms, odds, slowest, turn_known, look.planar)


def _with_turn(
    given: _Given, look: Look, smooth: SmoothError, steady: Posterior, evidence: float
) -> Posterior:
    """The posterior of a camera that may turn within the frame."""
    observations, terms, threshold, assumed, slowest = given
    best, wide = look.best, look.near_outliers > 0
    if assumed.turn is not None and not wide:  # what a gyroscope leaves tells its offset
        return steady
    gain, moments = hidden_turn(
        look.lines, best.state, steady.inliers, smooth, steady.shared, terms, steady.noise,
        steady.freedom,
    )  # fmt: skip
    if wide or gain > _ASKS:
        gate, noise = min(max(threshold, GATE * best.noise), WIDEST_GATE * threshold), best.noise
        if wide:
            gate = max(2.0 * WIDEST_GATE * threshold, _LARGEST_SHAKE * assumed.focal_length)
            noise = threshold
        fit = fit_turn(
            observations.packed, observations.count, best.state, terms, threshold, gate, noise,
            steady.bend, smooth.log_size, assumed.focal_length,
        )  # fmt: skip
        kept, had = np.count_nonzero(fit.inliers), np.count_nonzero(best.inliers)
        if fit.finite and kept >= _KEPT * had and not (wide and fit.freedom < kept):
            shaken = _of_fit(observations, steady, fit, threshold, math.exp(smooth.log_size))
            shaken, ratio = _at_any_speed(shaken, fit, terms, assumed, slowest)
            # As if any speed left it, where vibration hardly shows.
            return _either(steady, evidence, max(fit.evidence + ratio, evidence + gain), shaken)
    weight = 1.0 / (1.0 + math.exp(min(_HIDDEN_ODDS - TEMPER * gain, 700.0)))
    undetected = weight * moments[:MOTION_PARAMETERS, :MOTION_PARAMETERS]
    return steady._replace(undetected=undetected)


def _of_fit(
    observations: Observations, steady: Posterior, fit: TurnFit, threshold: float, size: float
) -> Posterior:
    """The posterior of a camera that turns within the frame; ``size``: px, of the smooth error."""
    lines = linearized(
        observations.packed, observations.count, fit.state,
        shake_at(observations.tau, fit.turns),
    )  # fmt: skip
    return steady._replace(
        state=fit.state, covariance=fit.covariance, noise=fit.noise, freedom=fit.freedom,
        inliers=fit.inliers, squared_errors=fit.squared_errors, shake=fit.turns, arched=None,
        near_outliers=near_outliers(lines, fit.squared_errors, fit.inliers, threshold),
        speeds=np.zeros(0), shared=size,
    )  # fmt: skip


def _at_any_speed(
    shaken: Posterior, fit: TurnFit, terms: PriorTerms, assumed: Assumed, slowest: int
) -> tuple[Posterior, float]:
    """The mixture of all typical speeds, and by how much the logarithm of the evidence changes.

    Near the fit all is linear: of a slower motion without its vibration velocities and
    accelerations are known better to be zero (Kalman 1960), at unknown noise (Student's form).
    """
    last, turn_known = len(SPEEDS) - 1, assumed.turn is not None
    odds = assumed.of_rest * _RESTS
    rates = np.zeros((PARAMETERS, len(fit.covariance)))
    rates[:, :PARAMETERS] = np.eye(PARAMETERS)
    for axis in range(3):
        rates[ANGULAR.start + axis, PARAMETERS + axis :: 3] = -MIDDLE_RATES
    moving = rates[POSE.stop :]
    spread, turned = moving @ fit.covariance, fit.turns.ravel()
    values = fit.state[POSE_SIZE:] + moving[:, PARAMETERS:] @ turned
    before = np.diagonal(terms.informations[0])[POSE.stop :]
    parts, own = [(fit.state, fit.turns, fit.covariance)], [odds[last]]
    for speed in range(last - 1, slowest - 1, -1):
        after = np.diagonal(terms_at(terms, SPEEDS[speed], turn_known).informations[0])[POSE.stop :]
        known = np.flatnonzero((before > 0.0) & (after > before))
        more = after[known] - before[known]
        within = spread[known] @ moving[known].T + np.diag(1.0 / more)
        gain = np.linalg.solve(within, spread[known]).T
        step = -gain @ values[known]
        squared = values[known] @ np.linalg.solve(within, values[known])
        volume = np.linalg.slogdet(within)[1] + np.log(more * before[known] / after[known]).sum()
        ratio = -0.5 * (fit.freedom * math.log1p(squared / fit.freedom) + volume)
        parts.append((
            apply_step(fit.state, step[:PARAMETERS]),
            fit.turns + step[PARAMETERS:].reshape(fit.turns.shape),
            fit.covariance - gain @ spread[known],
        ))  # fmt: skip
        own.append(odds[speed] + ratio)
    evidences = np.array(own)
    total = float(np.logaddexp.reduce(evidences)) - math.log(len(own))
    rests = _RESTS[::-1][: len(own)]
    probable = np.exp(evidences + REST_ODDS * rests - (evidences + REST_ODDS * rests).max())
    possible = np.exp(TEMPER * (evidences - evidences.max()))
    state, turns, covariance = mixed(parts, probable / probable.sum(), possible / possible.sum())
    return shaken._replace(state=state, shake=turns, covariance=covariance), total


def _either(
    steady: Posterior, evidence: float, evidence_of_shaking: float, shaken: Posterior
) -> Posterior:
    """The mixture of a camera that does not turn within its frame, and of one that does."""
    better = evidence - evidence_of_shaking
    probable = 1.0 / (1.0 + math.exp(min(-better - _STEADY_ODDS, 700.0)))  # that it is steady
    weight = 1.0 / (1.0 + math.exp(min(-TEMPER * better, 700.0)))
    if weight < _NO_PART:
        return shaken
    if weight > 1.0 - _NO_PART:
        return steady
    whole = np.zeros_like(shaken.covariance)
    whole[:PARAMETERS, :PARAMETERS] = steady.covariance
    state, turns, covariance = mixed(
        [
            (steady.state, np.zeros_like(shaken.shake), whole),
            (shaken.state, shaken.shake, shaken.covariance),
        ],
        np.array([probable, 1.0 - probable]),
        np.array([weight, 1.0 - weight]),
    )
    likely = steady if probable > 0.5 else shaken
    return likely._replace(state=state, covariance=covariance, arched=None, shake=turns)
