# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The posterior of a frame: one model, its modes, and one Gaussian of them all.

docs/estimator.md is the page. The discrete alternatives of a frame, {rest, typical speeds} x {this
lean of a plane, the mirrored one}, are starts of one fit (:mod:`.frame_fit`); each becomes a
Gaussian (Laplace approximation) with its evidence; the mixture's mean and covariance go out.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from rs_localizer.core.arrays import Array
from rs_localizer.core.scales import SPEEDS
from rs_localizer.core.shake import CYCLES
from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.first_look import Hyperprior, first_look, near_outliers
from rs_localizer.estimation.frame_fit import FrameFit, at_speed, bend_of, fit_frame
from rs_localizer.estimation.mirror import farthest
from rs_localizer.estimation.modes import (
    FAR_LESS_PROBABLE,
    LEAST_LIKELY,
    REST_ODDS,
    STEPS,
    TEMPER,
    Inliers,
    SmoothError,
    log_evidence,
    mixed,
    mixture_of,
)
from rs_localizer.estimation.observations import MOST_POINTS, NEAREST, Observations
from rs_localizer.estimation.posterior import GATE, WIDEST_GATE, Posterior
from rs_localizer.estimation.prior import Assumed, PriorTerms

# An in-frame turn is fitted where chance explains as much in three frames of ten, because one that
# hides in the noise spoils regions and a fit from near by is cheap; a smooth error in one of
# twenty. Standard normal, of 14 frequencies and of the smooth error.
_ASKS_TURNS, _ASKS_SMOOTH = float(-ndtri(0.3 / len(CYCLES))), float(-ndtri(0.05))
# What chance explains in one frame of ten thousand may have moved points out of the gate.
_WIDENS = float(-ndtri(1e-4 / len(CYCLES)))
# Likewise of the frames before (standard normal): one track in a thousand.
_ASKS_REMEMBERED = 3.3
# Of the typical speeds.
_RESTS, _NOTHING = np.array([speed == 0.0 for speed in SPEEDS], float), np.zeros(len(SPEEDS))
# Shaking of up to this (rad, 2 deg) moves points out of the gate of a motion without it.
_LARGEST_SHAKE = 0.035
# A mode that loses more inliers than this part leaves is another group of points.
_KEPT = 0.9
# Probability that does not count.
_NO_PART = 1e-4
# Logarithm of the odds of none against an in-frame turn, before any frame: as for rest.
_STEADY_ODDS = REST_ODDS
# Of the cameras that do not show it, one in ten shakes: with one in three, in ten, and in twenty
# the turn rates of hands are claimed to be 1.9, 1.5 and 1.35 times their actual deviation, 93.4,
# 92.3 and 90.8 % of the twists under one sine are inside, and 0.9, 1.4 and 1.7 % of the poses under
# bands are beyond five deviations (benchmarks.frames, hand, sine, bands, 24 frames each, seed 1).
_HIDDEN_ODDS = math.log(10.0)


class _Frame(NamedTuple):
    """The inliers of a frame and what is the same for all modes."""

    observations: Observations
    best: Posterior
    terms: PriorTerms
    threshold: float
    assumed: Assumed
    hyper: Hyperprior
    smooth: bool  # beside a smooth error
    planar: bool
    bend: Array  # (n,b) of a smooth error of the map (see frame_fit); (n,0): of the image


def frame_posterior(
    observations: Observations, start: Array, terms: PriorTerms, threshold: float, assumed: Assumed,
    one_lens: bool = True,
) -> Posterior:  # fmt: skip
    """What the points leave possible, near a first motion.

    Args:
        observations: the points; of very many a part is enough, evenly taken.
        start: state (24,).
        terms: what is known of the motion beside the points.
        threshold: px, of inliers.
        assumed: of the camera.
        one_lens: one camera sees them all; of two lenses a smooth error is not one polynomial.
    """
    if observations.count > MOST_POINTS:
        thinned = observations.thinned(MOST_POINTS)
        part = _of_points(thinned, start, terms, threshold, assumed, one_lens)
        gate = np.sqrt(part.squared_errors[part.inliers].max(initial=0.0))
        errors = observations.squared_errors(part.state)
        inliers = errors <= gate**2
        bend = part.bend
        if bend.shape[1]:
            depth = max(observations.median_depth(part.state, inliers), NEAREST)
            size = depth / assumed.focal_length
            bend = bend_of(observations.points, inliers, part.declared, size)
        return part._replace(squared_errors=errors, inliers=inliers, bend=bend)
    return _of_points(observations, start, terms, threshold, assumed, one_lens)


def _of_points(
    observations: Observations, start: Array, terms: PriorTerms, threshold: float, assumed: Assumed,
    one_lens: bool,
) -> Posterior:  # fmt: skip
    look = first_look(
        observations.packed, observations.points, start, terms, threshold, assumed.map_deviation,
        assumed.focal_length, assumed.rolling, assumed.turn is not None, assumed.scales,
    )  # fmt: skip
    best = Posterior(*look.best)
    if not best.determined:
        return best
    declared, excess, remembered = look.declared, look.excess, assumed.scales
    near, vibration = look.near_outliers, look.vibration
    best = best._replace(agreement=look.agreement, near_outliers=near, declared=declared)
    most = excess[:-1].max()
    known = remembered.excess[:-1].max() > _ASKS_REMEMBERED
    wide = assumed.rolling and bool(most > _WIDENS or near > 0)
    # What a gyroscope leaves of the turn tells the offset of its stamps.
    hidden = assumed.turn is None and bool(most > _ASKS_TURNS or known)
    turns = assumed.rolling and (wide or hidden)
    # What a gyroscope that comes too late leaves is smooth, too.
    shows = one_lens and (excess[-1] > _ASKS_SMOOTH or remembered.excess[-1] > _ASKS_REMEMBERED)
    smooth = bool(best.inliers.any() and (declared > 0.0 or (assumed.turn is None and shows)))
    # What turns within the frame would explain, errors of map and lens may explain as well.
    frame = _Frame(
        observations, best, terms, threshold, assumed, look.hyper, smooth, look.planar,
        np.zeros((observations.count, 0)),
    )  # fmt: skip
    if smooth:
        bend = bend_of(
            observations.points, best.inliers, declared, look.depth / assumed.focal_length
        )
        of_map = frame._replace(bend=bend)
        # Before a plane both explain alike. In depth a bent map leaves more open: it is left out
        # only where it is far less probable.
        if declared > 0.0 or (
            not frame.planar and _evidence_of(of_map) > _evidence_of(frame) - FAR_LESS_PROBABLE
        ):
            frame = of_map
    # A map that is known to be bent may look like motion.
    moving = declared == 0.0 and not frame.planar and look.moving
    slowest = 0 if assumed.may_rest and not moving else len(SPEEDS) - 1
    other = look.mirrored if look.is_mirrored else None
    shaken = _shaken(frame, wide, other, slowest) if turns else None
    if frame.smooth or frame.planar or slowest == 0:
        posterior, evidence = _merged(frame, slowest)
    else:
        posterior, evidence = best, -math.inf
        if shaken is not None:
            evidence = _evidence_of(frame)
    # A smooth error that is fitted explains the same errors: both together would count them twice.
    of_vibration = min(vibration.log_evidence, 0.0 if smooth else math.inf)
    if shaken is not None:
        fitted, evidence_of_shaking = shaken
        # Scales at their most probable values say less than those that are integrated.
        of_one = -math.inf if smooth else evidence + of_vibration
        posterior = _either(posterior, evidence, fitted, max(evidence_of_shaking, of_one))
    elif assumed.rolling and assumed.turn is None:
        odds = TEMPER * of_vibration - _HIDDEN_ODDS
        may_shake = 1.0 / (1.0 + math.exp(-min(odds, 700.0)))
        posterior = posterior._replace(undetected=may_shake * vibration.covariance)
    return posterior._replace(scales=posterior.scales._replace(excess=excess))


def _evidence_of(frame: _Frame) -> float:
    """Of the fastest motion."""
    return mixture_of(
        _inliers(frame), frame.best.state, frame.terms, _NOTHING, _NOTHING, len(SPEEDS) - 1, False,
        False, _smooth(frame),
    ).evidence  # fmt: skip


def _shaken(
    frame: _Frame, wide: bool, other: Array | None, slowest: int
) -> tuple[Posterior, float] | None:
    """The posterior of a camera that turns within the frame, and its evidence; None: no such.

    ``wide``: from a gate that is as wide as shaking moves points.
    """
    best, threshold, assumed = frame.best, frame.threshold, frame.assumed
    gate, noise = min(max(threshold, GATE * best.noise), WIDEST_GATE * threshold), best.noise
    if wide:
        gate = max(2.0 * WIDEST_GATE * threshold, _LARGEST_SHAKE * assumed.focal_length)
        noise = threshold
    starts = (best.state,) if other is None else (best.state, other)
    fits = [fit for one in starts if (fit := _fit(frame, one, gate, noise)).finite]
    if not fits:
        return None
    most = max(np.count_nonzero(fit.inliers) for fit in fits)
    fits = [fit for fit in fits if np.count_nonzero(fit.inliers) >= _KEPT * most]
    fit = max(fits, key=lambda one: one.evidence)
    inliers = np.count_nonzero(fit.inliers)
    if inliers < _KEPT * np.count_nonzero(best.inliers):
        return None
    if wide and fit.freedom < inliers:
        return None  # every second equation went into coefficients: wrong points would, too
    return _at_any_speed(frame, fit, slowest)


def _fit(frame: _Frame, start: Array, gate: float, noise: float) -> FrameFit:
    """Motion and in-frame turn, from a state (24,) and a gate and noise (px)."""
    return fit_frame(
        frame.observations.packed, frame.observations.count, start, frame.terms, frame.threshold,
        gate, noise, *frame.hyper, True, frame.smooth, frame.bend, STEPS,
    )  # fmt: skip


def _at_any_speed(frame: _Frame, fit: FrameFit, slowest: int) -> tuple[Posterior, float]:
    """The mixture of all typical speeds of a camera that turns within the frame; its evidence."""
    (odds, by_turn), last = _odds_of_speeds(frame), len(SPEEDS) - 1
    weighed = slowest < last or frame.smooth or frame.planar  # as those without a turn
    if not weighed:
        odds, by_turn = _NOTHING, _NOTHING
    evidence = log_evidence(
        fit.log_determinant, fit.left + fit.prior_cost, frame.terms, _inliers(frame), fit.inliers,
        fit.noise,
    )  # fmt: skip
    parts = [(fit.state, fit.turns, fit.covariance)]
    own = [odds[last] + by_turn[last] + evidence]
    turn_known = frame.assumed.turn is not None
    for speed in range(last - 1, slowest - 1, -1):
        if own[-1] < max(own) - FAR_LESS_PROBABLE / TEMPER:
            break
        state, turns, covariance, ratio = at_speed(
            *parts[0], fit.by_smooth, fit.freedom, frame.terms, SPEEDS[speed], turn_known
        )
        parts.append((state, turns, covariance))
        own.append(odds[speed] + by_turn[speed] + evidence + ratio)
    posterior, total = _of_fit(frame, fit), float(np.logaddexp.reduce(own))
    if weighed:
        total -= math.log(len(SPEEDS))
    if len(parts) == 1:
        return posterior, total
    evidences = np.full(len(SPEEDS), -math.inf)
    evidences[::-1][: len(own)] = own
    probable = np.exp(evidences + REST_ODDS * _RESTS - evidences.max())
    possible = np.exp(TEMPER * (evidences - evidences.max()))
    probable, possible = probable / probable.sum(), possible / possible.sum()
    used = slice(last, last - len(parts) if len(parts) <= last else None, -1)
    state, turns, covariance = mixed(parts, probable[used], possible[used])
    likelihoods = evidences - odds
    posterior = posterior._replace(
        state=state,
        covariance=covariance,
        shake=turns,
        speeds=possible,
        scales=posterior.scales._replace(
            speeds=np.maximum(likelihoods - likelihoods.max(), LEAST_LIKELY)
        ),
    )
    return posterior, total


def _of_fit(frame: _Frame, fit: FrameFit) -> Posterior:
    """The posterior of one fit with an in-frame turn."""
    _, mean, precision = frame.hyper
    own = 2.0 * fit.decided  # precision of the frame alone
    total = fit.log_scales * (own + precision)
    said = np.where(own > 0.1, (total - precision * mean) / np.maximum(own, 0.1), 0.0)
    near = near_outliers(fit.squared_errors, fit.inliers, frame.threshold)
    return frame.best._replace(
        state=fit.state, covariance=fit.covariance, noise=fit.noise,
        freedom=fit.freedom, inliers=fit.inliers, squared_errors=fit.squared_errors,
        shake=fit.turns, model_error=fit.smooth, shared=fit.smooth, bend=frame.bend,
        agreement=fit.agreement, near_outliers=near,
        scales=frame.best.scales._replace(means=said, precisions=np.where(own > 0.1, own, 0.0)),
    )  # fmt: skip


def _odds_of_speeds(frame: _Frame) -> tuple[Array, Array]:
    """Logarithms of the odds (5,) of the typical speeds, and of the likelihood by a gyroscope."""
    assumed, by_turn = frame.assumed, _NOTHING
    if assumed.turn is not None:
        by_turn = np.array([assumed.turn.evidence(speed) for speed in SPEEDS])
    return assumed.scales.speeds + assumed.of_rest * _RESTS, by_turn


def _merged(frame: _Frame, slowest: int) -> tuple[Posterior, float]:
    """The mixture of all modes as one Gaussian, and its evidence.

    ``slowest``: index of the first typical speed that is weighed.
    """
    best, assumed = frame.best, frame.assumed
    odds, by_turn = _odds_of_speeds(frame)
    found = mixture_of(
        _inliers(frame), best.state, frame.terms, odds, by_turn, slowest,
        assumed.turn is not None, frame.planar, _smooth(frame),
    )  # fmt: skip
    if found.evidence == -math.inf:
        return best._replace(smallest_eigenvalue=0.0), -math.inf
    posterior = best._replace(
        state=found.state,
        covariance=found.covariance,
        arched=found.arched,
        squared_errors=frame.observations.squared_errors(found.state),
        model_error=found.smooth,
        shared=found.shared,
        bend=frame.bend,
        speeds=found.speeds,
        scales=best.scales._replace(speeds=found.log_likelihoods),
        mirror=(
            farthest(found.costs, found.evidences, found.steps, found.covariance)
            if frame.planar
            else None
        ),
    )
    if best.declared > 0.0:  # points that a known bend moves out of the gate are no outliers
        near = near_outliers(found.squared_errors, found.chosen, frame.threshold)
        posterior = posterior._replace(inliers=found.chosen, near_outliers=near)
    return posterior, found.evidence - math.log(len(SPEEDS))


def _smooth(frame: _Frame) -> SmoothError:
    return SmoothError(frame.smooth, *frame.hyper, frame.bend)


def _inliers(frame: _Frame) -> Inliers:
    observations, best = frame.observations, frame.best
    return Inliers(
        observations.packed, observations.points, best.inliers,
        best.noise, best.freedom, best.cost / best.noise**2,
        frame.assumed.focal_length, frame.threshold,
    )  # fmt: skip


def _either(
    steady: Posterior, evidence: float, shaken: Posterior, evidence_of_shaking: float
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
    shared = math.sqrt(weight * steady.shared**2 + (1.0 - weight) * shaken.shared**2)
    return likely._replace(
        state=state,
        covariance=covariance,
        arched=None,
        shake=turns,
        shared=shared,
        scales=shaken.scales._replace(
            speeds=weight * steady.scales.speeds + (1.0 - weight) * shaken.scales.speeds
        ),
    )
