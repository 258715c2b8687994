# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The posterior of a frame, whose covariance is published: hypotheses are fitted, weighed, mixed.

docs/estimator.md is the page. A camera rests or moves at a typical speed, and is steady or
vibrates within its frame: each is a Gaussian with its evidence (:mod:`.linear_fit`,
:mod:`.gaussian`), and the mean and the covariance of their mixture go out (:mod:`.gaussian`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.shake import COMBINATIONS, RESOLVED, shake_at
from rs_localizer.core.state import (
    LINEAR,
    PARAMETERS,
    POSE,
    POSE_SIZE,
    VELOCITIES,
    step_between,
)
from rs_localizer.estimation.gaussian import (
    Frame,
    Gaussians,
    Speeds,
    mixture,
    modes_at,
    weights_of,
)
from rs_localizer.estimation.linear_fit import (
    IN_FUNCTIONS,
    MIDDLE,
    ORDINARY,
    TURNS,
    VIBRATION,
    Noise,
    TurnPrior,
    bend_of,
    fit,
    hidden,
    known_at,
    linear_of,
    moved,
    nothing_shared,
    of_coupled,
    smooth_errors,
    under,
)
from rs_localizer.estimation.points import MOST_POINTS, NEAREST, Observations, plane_of
from rs_localizer.estimation.prior import SPEEDS, Assumed, PriorTerms, terms_at
from rs_localizer.estimation.projection import Lines, linearized
from rs_localizer.estimation.robust import (
    GATE,
    LEAST_NOISE,
    TINY,
    WIDEST_GATE,
    apply_step,
    best_motion,
    solve_positive,
)

# Logarithm of the odds of rest against each typical speed before any frame: errors of maps that no
# polynomial of the image follows look like motion, and a hundred to one is what surveyed tags ask
# for. The same of none against an in-frame turn.
REST_ODDS = STEADY_ODDS = math.log(100.0)
# The pose is the mean of the posterior. Its region is that of the posterior with probabilities to
# this power, about the same mean: it holds for a camera that moves so little that rest is more
# probable (1 would hold on average over all cameras, and not for that one). The odds for rest and
# those against an in-frame turn, which are choices, have no part in it.
TEMPER = 0.25
# Logarithm of the odds of a typical speed beside a better one, beyond which no faster one is tried.
_FAR_LESS_PROBABLE = 9.0
# Velocities beyond doubt, in squared standard deviations (four times the 99 % quantile of six), of
# which the prior knows less than this part: typical speeds are not weighed.
_CLEARLY_MOVING, _LITTLE_OF_THE_PRIOR = 67.0, 0.05
# A fit that loses more inliers than this part leaves is another group of points.
_KEPT = 0.9
# Log odds of no vibration: one in ten of the cameras that do not show vibration has some.
_HIDDEN_ODDS = math.log(10.0)
# Logarithm of the evidence of any vibration against none from which it is fitted; before a plane,
# of whose leans that fit knows nothing. With -1.5, 95 instead of 93 % of the twists of the paired
# set that vibrate lie inside, but 58 of 60 single frames of a steady camera are fitted, too, and
# take twice as long.
_ASKS, _ASKS_OF_PLANE = -0.5, 5.0
# A last step this short, in squared standard deviations: the next one is its square.
_SHORT = 1e-2
_STEPS = 20
# Least eigenvalue of an information matrix scaled to a unit diagonal.
_LEAST_EIGENVALUE = 1e-11
# Fewer inliers determine nothing; nor, beside an in-frame turn, do these.
_FEWEST, _FEWEST_TURNING = 6, 8


class Posterior(NamedTuple):
    """The refined motion of one frame and what the points say of it."""

    state: Array  # (24,)
    covariance: Array  # (18,18), or more with the coefficients of the shaking
    noise: float  # px, measured standard deviation
    freedom: float  # of the errors
    smallest_eigenvalue: float  # of the information scaled to a unit diagonal, or less
    inliers: BoolArray  # (n,)
    squared_errors: Array  # (n,) px^2
    shake: Array = np.zeros((0, 3))  # (k,3) rad, coefficients
    model_error: float = 0.0  # px, root mean square of what the motion leaves beside the noise
    shared: float = 0.0  # px, likewise, of all modes together
    declared: float = 0.0  # px, the part of it that the map is known to be off
    speeding: float = 0.0  # squared velocities, in deviations of what the configuration expects
    # Probabilities of the typical speeds; empty: the configured one
    speeds: Array = np.zeros(0)
    # (12,12) of pose and velocities, beside the covariance: vibration that hides in the noise
    undetected: Array = np.zeros((12, 12))
    # (k,) logarithms of the evidence of each vibration, against none; empty: not looked at
    vibrations: Array = np.zeros(0)
    # (n,b): of what the smooth error is a combination (see frame_fit), which other frames share, so
    # that the covariance does not have it, either
    bend: Array = np.zeros((0, 0))
    gate: float = 0.0  # px, of inliers, which goes on to twice as many for their noise

    @property
    def determined(self) -> bool:
        """True if points and prior together determine all parameters."""
        return self.smallest_eigenvalue > _LEAST_EIGENVALUE

    @property
    def inflation(self) -> float:
        """Inflation of the variances, because the noise itself is an estimate.

        Squared distances follow an F distribution; this makes its 95 % quantile that of the
        chi-squared one, to half a percent from 40 degrees of freedom.
        """
        left = max(self.freedom, 6.0)
        return left / (left - 5.0)


class _Given(NamedTuple):
    """The points of a frame, what is known of it, and its best motion."""

    observations: Observations
    terms: PriorTerms
    threshold: float  # px, of inliers
    assumed: Assumed
    best: Posterior
    lines: Lines  # at the best motion
    frame: Frame
    bend: Array  # (n,b), see smooth_columns
    size: float  # px, expected of the smooth error


class _Camera(NamedTuple):
    """The hypotheses of a camera that is steady, or vibrates, and what the most probable one leaves
    of the points.
    """

    parts: Gaussians
    preferences: Array  # (k,)
    posterior: Posterior


def frame_posterior(
    observations: Observations, start: Array, terms: PriorTerms, threshold: float, assumed: Assumed
) -> Posterior:
    """Return the posterior of the motion given the points, near a first motion.

    Args:
        observations: the points; of very many a part is enough, evenly taken.
        start: state (24,).
        terms: what is known of the motion beside the points.
        threshold: px, of inliers.
        assumed: of the camera.
    """
    if len(observations) > MOST_POINTS:
        some = np.linspace(0, len(observations) - 1, MOST_POINTS).astype(np.int64)
        part = frame_posterior(observations.only(some), start, terms, threshold, assumed)
        lines = linearized(
            observations.packed, len(observations), part.state,
            shake_at(observations.tau, part.shake),
        )  # fmt: skip
        errors = np.sum(lines.errors**2, axis=1)
        # The farthest inlier of the part is one of all points: no rounding leaves it out.
        inliers, bend = errors <= errors[some][part.inliers].max(initial=0.0), part.bend
        if bend.shape[1]:
            depth = max(observations.median_depth(part.state, inliers), NEAREST)
            bend = bend_of(observations.points, inliers, depth / assumed.focal_length)
        return part._replace(squared_errors=errors, inliers=inliers, bend=bend)
    best = Posterior(*best_motion(observations.packed, len(observations), start, terms, threshold))
    if not best.determined or np.count_nonzero(best.inliers) < _FEWEST:
        return best
    given = _given(observations, best, terms, threshold, assumed)
    declares, best = assumed.map_deviation > 0.0, given.best
    planar, _, _ = plane_of(observations.points, best.inliers)
    is_clear = not (declares or planar) and _clearly_moving(given)
    speeds = speeds_of(assumed, is_clear)
    steady = _steady(given, speeds, planar)
    if steady is None:
        return best._replace(smallest_eigenvalue=0.0)
    groups = [steady]
    if assumed.rolling and assumed.in_frame is not None:
        turning = _vibrating(given, speeds, steady.posterior, assumed.in_frame.rest)
        if turning is not None:  # it knows no leans
            groups = [steady, turning] if planar else [turning]
    elif assumed.rolling and not (declares and planar):
        # Apparent vibration before a bent board is more of its bend.
        groups = _with_turn(given, speeds, steady, _ASKS_OF_PLANE if planar else _ASKS)
    return _mixed(given, groups)


def _given(
    observations: Observations, best: Posterior, terms: PriorTerms, threshold: float,
    assumed: Assumed,
) -> _Given:  # fmt: skip
    """Compute everything that does not depend on the hypothesis."""
    data, points, count = observations.packed, observations.points, len(observations)
    found = int(np.count_nonzero(best.inliers))
    depth = max(observations.median_depth(best.state, best.inliers), NEAREST)
    lines = linearized(data, count, best.state, np.zeros((count, 6)))
    declared = assumed.map_deviation * assumed.focal_length / depth
    size, shared = declared or ORDINARY, nothing_shared(found)
    bend = np.zeros((count, 0))
    if assumed.rolling:
        if declared:
            bend = bend_of(points, best.inliers, depth / assumed.focal_length)
        lens = observations.lens_of(assumed.lenses)
        shared = smooth_errors(lines, best.inliers, bend, size, lens)
    left = float(best.squared_errors[best.inliers].sum()) / max(best.freedom, 1.0)
    noise = Noise(
        best.noise, max(best.noise**2 / max(left, LEAST_NOISE**2), 1.0),
        max(2.0 * found - best.freedom, 0.0),
    )  # fmt: skip
    return _Given(
        observations, terms, threshold, assumed,
        best._replace(declared=declared), lines,
        Frame(data, points, best.inliers, shared, noise, assumed.focal_length, depth), bend, size,
    )  # fmt: skip


def speeds_of(assumed: Assumed, is_clear: bool) -> Speeds:
    """Return typical speeds of a camera; if motion is clear, the configured one."""
    turn, every = assumed.turn, assumed.may_rest and not is_clear
    parts = np.array(SPEEDS if every else SPEEDS[-1:])
    rests = parts == 0.0
    odds = np.where(rests, assumed.of_rest, 0.0)
    if turn is not None:
        odds += turn.evidence(parts)
    return Speeds(parts, odds, np.where(rests, REST_ODDS, 0.0), turn is not None)


def _steady(given: _Given, speeds: Speeds, planar: bool) -> _Camera | None:
    """Return the Gaussians of a camera without in-frame rotation, of speeds that may be."""
    near, count = given.best.state, len(speeds.parts)
    if count > 1:
        near = np.concatenate([near[:POSE_SIZE], np.zeros(len(near) - POSE_SIZE)])
    parts, numbers = modes_at(
        given.frame, near, given.terms, speeds, planar, _FAR_LESS_PROBABLE / TEMPER
    )
    if not len(numbers):
        return None
    parts.evidences[:] -= _of_outliers(given, given.best.inliers)
    place, possible = numbers[:, 0].astype(np.int64), weights_of(TEMPER * parts.evidences)
    preferences = speeds.preferences[place]
    _, noise, _, freedom = numbers[(parts.evidences + preferences).argmax()].tolist()
    shared, of_speeds = math.sqrt(possible @ numbers[:, 2] ** 2), np.zeros(len(SPEEDS))
    of_speeds[len(SPEEDS) - count + place] = possible
    posterior = given.best._replace(
        noise=noise, freedom=freedom, model_error=shared, shared=shared, bend=given.bend,
        speeds=of_speeds, squared_errors=np.zeros(0),
    )  # fmt: skip
    return _Camera(parts, preferences + STEADY_ODDS, posterior)


def _of_outliers(given: _Given, inliers: BoolArray) -> float:
    """Return the log evidence of the other points, anywhere in an image of squared focal length."""
    outside = len(given.observations) - np.count_nonzero(inliers)
    return 2.0 * outside * math.log(given.assumed.focal_length)


def _with_turn(given: _Given, speeds: Speeds, steady: _Camera, asks: float) -> list[_Camera]:
    """Return hypotheses without in-frame rotation, and with it if its evidence is what it asks."""
    prior, expected, before = VIBRATION, 0.0, given.assumed.of_vibration
    if before.size:
        expected = float(np.logaddexp.reduce(prior.odds + before))
        prior = prior._replace(odds=prior.odds + before - expected)
    motion, known = steady.posterior, known_at(given.terms, given.best.state)
    gain, undetected, vibrations = hidden(
        given.lines, given.best.inliers, given.frame.shared.at(motion.shared), known,
        motion.noise, motion.freedom, given.assumed.noise, prior,
    )  # fmt: skip
    gain, posterior = gain + expected, steady.posterior._replace(vibrations=vibrations)
    vibrating = _vibrating(given, speeds, posterior, prior) if gain > asks else None
    if vibrating is None:
        weight = 1.0 / (1.0 + math.exp(min(_HIDDEN_ODDS - TEMPER * gain, 700.0)))
        return [steady._replace(posterior=posterior._replace(undetected=weight * undetected))]
    steady = steady._replace(posterior=posterior)
    total, other = (np.logaddexp.reduce(one.parts.evidences) for one in (steady, vibrating))
    # As if any speed left it, where vibration hardly shows.
    raised = vibrating.parts.evidences + max(total + gain - other, 0.0)
    return [steady, vibrating._replace(parts=vibrating.parts._replace(evidences=raised))]


def _with_middle(covariance: Array) -> Array:
    """Return the covariance (72,72) of the motion with its vibration, from one without it."""
    covariance = covariance.copy()
    covariance[:PARAMETERS] += MIDDLE @ covariance[PARAMETERS:]
    covariance[:, :PARAMETERS] += covariance[:, PARAMETERS:] @ MIDDLE.T
    return covariance


class _Turning(NamedTuple):
    """A motion with an in-frame turn, and its points."""

    state: Array  # (24,)
    turn: Array  # (54,)
    lines: Lines
    squares: Array  # (n,) px^2
    inliers: BoolArray  # (n,)

    def after(self, step: Array) -> tuple[Array, Array]:
        """Return state and in-frame turn after a step (72,)."""
        change = step[PARAMETERS:]
        return apply_step(self.state, step[:PARAMETERS] + MIDDLE @ change), self.turn + change


def _at(given: _Given, state: Array, turn: Array, gate: float) -> _Turning:
    """Return the points at a motion with in-frame rotation; inliers lie within a gate (px)."""
    observations = given.observations
    shake = shake_at(observations.tau, COMBINATIONS @ turn.reshape(RESOLVED, 3))
    lines = linearized(observations.packed, len(observations), state, shake)
    squares = np.square(lines.errors).sum(axis=1)
    squares[np.isinf(observations.squared_errors(state))] = np.inf
    return _Turning(state, turn, lines, squares, squares < gate * gate)


def _vibrating(
    given: _Given, speeds: Speeds, steady: Posterior, prior: TurnPrior
) -> _Camera | None:
    """Return hypotheses with in-frame rotation, if such a fit converges to as many points."""
    best, threshold, in_frame = given.best, given.threshold, given.assumed.in_frame
    lens = given.observations.lens_of(given.assumed.lenses)
    noise, fewest = best.noise, max(_KEPT * np.count_nonzero(best.inliers), _FEWEST_TURNING)
    # Near a rotation that is known the frame is more linear.
    short, by_motion = (_SHORT, None) if in_frame is None else (1.0, in_frame.by_motion)
    state, turn, is_last = best.state, np.zeros(TURNS), False
    for k in range(_STEPS):
        gate = min(max(threshold, GATE * noise), WIDEST_GATE * threshold)
        now = _at(given, state, turn, gate)
        if np.count_nonzero(now.inliers) < _FEWEST_TURNING:
            return None
        shared = smooth_errors(now.lines, now.inliers, given.bend, given.size, lens).at(given.size)
        if not len(shared.squares):  # columns of an absurd motion are no numbers
            return None
        still = apply_step(now.state, -MIDDLE @ now.turn)
        # From a camera that does not move or turn: the prior of one at rest is so sure of it that
        # rounding would show.
        first = np.concatenate([np.zeros(POSE.stop), -still[POSE_SIZE:], -now.turn])
        still = apply_step(still, first[:PARAMETERS])
        linear = linear_of(now.lines, now.inliers, True, shared)
        if by_motion is not None:
            offset = step_between(given.terms.references[-1].copy(), still)
            first[PARAMETERS:] += by_motion @ offset
        linear = moved(linear, first, by_motion)
        known, is_last = known_at(given.terms, still), is_last or k == _STEPS - 1
        seen = Noise(noise, 1.0, float(PARAMETERS), given.assumed.noise)
        if in_frame is not None and k == 0:  # the second step would change the noise alone
            found = fit(linear, shared, known, seen, prior, False)
            noise = max(found.noise, LEAST_NOISE)
            seen = seen._replace(deviation=noise)
        finely = is_last or in_frame is not None
        found = fit(linear, shared, known, seen, prior, finely)
        if by_motion is not None:
            found = of_coupled(found, by_motion)
        step = first + found.step
        state, turn = now.after(step)
        if not (found.evidence > -math.inf and np.isfinite(state).all()):
            return None
        farthest = float((step**2 / np.maximum(np.diagonal(found.covariance), TINY)).max())
        if is_last or (in_frame is not None and farthest < _SHORT):
            break
        noise, is_last = max(found.noise, LEAST_NOISE), farthest < short
    if not (farthest < 1.0 and np.count_nonzero(now.inliers) >= fewest):
        return None
    priors = [terms_at(given.terms, part, speeds.turn_known) for part in speeds.parts.tolist()]
    fits = [under(found, known, known_at(one, still)) for one in priors]
    states, turns = map(np.array, zip(*(now.after(first + one.step) for one in fits), strict=True))
    parts = Gaussians(
        states, turns, np.array([_with_middle(one.covariance) for one in fits]),
        np.array([one.evidence for one in fits]) + speeds.odds - _of_outliers(given, now.inliers),
    )  # fmt: skip
    posterior = steady._replace(
        noise=found.noise, freedom=found.freedom, inliers=now.inliers, speeds=np.zeros(0),
        squared_errors=_at(given, state, turn, math.inf).squares, shared=given.size,
    )  # fmt: skip
    return _Camera(parts, speeds.preferences, posterior)


def _mixed(given: _Given, groups: list[_Camera]) -> Posterior:
    """Mix all hypotheses; the inliers are those of the most probable kind."""
    parts = groups[0].parts if len(groups) == 1 else _together(*(one.parts for one in groups))
    found = mixture(parts, np.concatenate([one.preferences for one in groups]), TEMPER)
    rather = len(groups) > 1 and found.probable[: len(groups[0].preferences)].sum() < 0.5
    likely = groups[1 if rather else 0].posterior
    covariance, shake = found.covariance, np.zeros((0, 3))
    if len(found.turn):
        covariance = IN_FUNCTIONS @ covariance @ IN_FUNCTIONS.T
        shake = COMBINATIONS @ found.turn.reshape(-1, 3)
    if not len(likely.squared_errors):  # of all steady ones, and not of the best one alone
        likely = likely._replace(squared_errors=given.observations.squared_errors(found.state))
    return likely._replace(state=found.state, covariance=covariance, shake=shake)


def _together(steady: Gaussians, vibrating: Gaussians) -> Gaussians:
    """Join Gaussians of both kinds; those without in-frame rotation have zeros for it."""
    count = len(steady.states)
    covariances = np.zeros((count, PARAMETERS + TURNS, PARAMETERS + TURNS))
    covariances[:, :PARAMETERS, :PARAMETERS] = steady.covariances
    whole = steady._replace(turns=np.zeros((count, TURNS)), covariances=covariances)
    return Gaussians(*map(np.concatenate, zip(whole, vibrating, strict=True)))


def _clearly_moving(given: _Given) -> bool:
    """Return True if neither rest nor another typical speed would change anything."""
    known = given.assumed.turn is not None  # and only the way is not
    place = slice(LINEAR.start if known else VELOCITIES.start, VELOCITIES.stop)
    spread = given.best.covariance[place, place]
    part = float(given.terms.informations[0].diagonal()[place] @ spread.diagonal())
    velocities = given.best.state[POSE_SIZE - POSE.stop :][place]
    far = velocities @ solve_positive(spread.copy(), velocities)[0]
    return part < _LITTLE_OF_THE_PRIOR and bool(far > _CLEARLY_MOVING)
