# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The posterior of a frame: a list of hypotheses, each fitted and weighed, and one Gaussian of all.

docs/estimator.md is the page. A camera rests or moves at a typical speed, and is steady or
vibrates within its frame: each is a Gaussian with its evidence (:mod:`.linear_fit`,
:mod:`.leans`), and the mean and the covariance of their mixture go out (:mod:`.gaussian`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.shake import COMBINATIONS, RESOLVED, shake_at
from rs_localizer.core.state import (
    LINEAR,
    MOTION_PARAMETERS,
    PARAMETERS,
    POSE,
    POSE_SIZE,
    VELOCITIES,
    step_between,
)
from rs_localizer.estimation.gaussian import Gaussians, mixture, weights_of
from rs_localizer.estimation.known_rotation import coupled, uncoupled
from rs_localizer.estimation.leans import Frame, Mode, linear_at, mode_of, over_leans
from rs_localizer.estimation.linear_fit import (
    MIDDLE,
    NO_TURN,
    SPECTRA,
    TURNS,
    VIBRATION,
    Linear,
    Noise,
    TurnPrior,
    fit,
    known_at,
    linear_of,
    moved,
    under,
    without,
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
)
from rs_localizer.estimation.smooth_error import (
    ORDINARY,
    Shared,
    bend_of,
    nothing_shared,
    smooth_error,
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
# Probability that does not count, of either kind of camera.
_NO_PART = 1e-4
# Log odds of no vibration: one in ten of the cameras that do not show vibration has some.
_HIDDEN_ODDS = math.log(10.0)
# Logarithm of the evidence of an ordinary vibration against none from which it is fitted, and of
# the ordinary spectrum, one of several, from which all are looked at.
_ASKS, _MAY_SHAKE = -0.5, -1.8
# One frame tells no more of a vibration than this logarithm of odds: none is as Gaussian as that.
_MOST_TOLD = 5.0
# A last step this short, in squared standard deviations: the next one is its square.
_SHORT = 1e-2
_STEPS = 20
# Pose and velocities with the vibration by all unknowns, see MIDDLE.
_TURNED = np.hstack([np.eye(PARAMETERS), MIDDLE])[:MOTION_PARAMETERS]
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
    # (18,18) with the second order of arcs, of a mixture; None: of the covariance as a Gaussian's
    arched: Array | None = None
    # (12,12) of pose and velocities, beside the covariance: vibration that hides in the noise
    undetected: Array = np.zeros((12, 12))
    # (s,f) logarithms of the evidence of each vibration, against none; empty: not looked at
    vibrations: Array = np.zeros((0, 0))
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


class MotionHypothesis(NamedTuple):
    """A motion that a camera may have."""

    speed: float  # part of the configured one
    terms: PriorTerms  # of its motion
    odds: float  # logarithm, by all but the points
    preference: float  # logarithm of odds that count in the mean alone


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
    observations: Observations, start: Array, terms: PriorTerms, threshold: float, assumed: Assumed,
    one_lens: bool = True,
) -> Posterior:  # fmt: skip
    """Return the posterior of the motion given the points, near a first motion.

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
    best = Posterior(*best_motion(observations.packed, observations.count, start, terms, threshold))
    if not best.determined or np.count_nonzero(best.inliers) < _FEWEST:
        return best
    given = _given(observations, best, terms, threshold, assumed, one_lens)
    declares, best = assumed.map_deviation > 0.0, given.best
    planar, _, _ = plane_of(observations.points, best.inliers)
    is_clear = not (declares or planar) and _clearly_moving(given)
    hypotheses = speeds_of(terms, assumed, is_clear)
    modes = _modes(given.frame, hypotheses, best.state, planar)
    if not modes:
        return best._replace(smallest_eigenvalue=0.0)
    steady = _steady(given, modes)
    groups = [steady]
    if assumed.rolling and assumed.in_frame is not None:
        turning = _vibrating(given, hypotheses, steady.posterior, assumed.in_frame.rest)
        if turning is not None:  # it knows no leans
            groups = [steady, turning] if planar else [turning]
    elif assumed.rolling and not (declares and planar):
        # Apparent vibration before a bent board is more of its bend.
        groups = _with_turn(given, hypotheses, steady)
    return _mixed(given, groups)


def _given(
    observations: Observations, best: Posterior, terms: PriorTerms, threshold: float,
    assumed: Assumed, one_lens: bool,
) -> _Given:  # fmt: skip
    """Compute everything that does not depend on the hypothesis."""
    data, points, count = observations.packed, observations.points, observations.count
    found = int(np.count_nonzero(best.inliers))
    depth = max(observations.median_depth(best.state, best.inliers), NEAREST)
    lines = linearized(data, count, best.state, np.zeros((count, 6)))
    declared = assumed.map_deviation * assumed.focal_length / depth
    size, shared = declared or ORDINARY, nothing_shared(found)
    bend = np.zeros((count, 0))
    if assumed.rolling:
        if declared:
            bend = bend_of(points, best.inliers, depth / assumed.focal_length)
        if one_lens:
            shared = smooth_error(lines, best.inliers, bend, size)
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


def speeds_of(terms: PriorTerms, assumed: Assumed, is_clear: bool) -> list[MotionHypothesis]:
    """Return typical speeds of a camera, slowest first; if motion is clear, the configured one."""
    turn = assumed.turn
    return [
        MotionHypothesis(
            speed,
            terms if speed == 1.0 else terms_at(terms, speed, turn is not None),
            (assumed.of_rest if speed == 0.0 else 0.0) + (turn.evidence(speed) if turn else 0.0),
            REST_ODDS if speed == 0.0 else 0.0,
        )
        for speed in SPEEDS
        if speed == 1.0 or (assumed.may_rest and not is_clear)
    ]


def _modes(
    frame: Frame, hypotheses: list[MotionHypothesis], start: Array, planar: bool
) -> list[tuple[MotionHypothesis, Mode]]:
    """Return the Gaussians of the hypotheses of a steady camera, as far as they are probable."""
    modes, best, near = [], -math.inf, start
    if len(hypotheses) > 1:
        near = np.concatenate([start[:POSE_SIZE], np.zeros(len(start) - POSE_SIZE)])
    linear = linear_at(frame, near)
    for one in hypotheses:
        mode, near, linear = mode_of(frame, near, linear, one.terms)
        if planar and mode.evidence > -math.inf:
            mode = over_leans(frame, mode, one.terms)
        evidence = mode.evidence + one.odds
        if evidence > -math.inf:
            modes.append((one, mode._replace(evidence=evidence)))
        best = max(best, evidence)
        if evidence < best - _FAR_LESS_PROBABLE / TEMPER:
            break
    return modes


def _steady(given: _Given, modes: list[tuple[MotionHypothesis, Mode]]) -> _Camera:
    """Return the hypotheses of cameras without in-frame rotation."""
    parts = Gaussians(
        np.array([mode.state for _, mode in modes]), np.zeros((len(modes), 0)),
        np.array([mode.covariance for _, mode in modes]),
        np.array([mode.evidence for _, mode in modes])
        - _of_outliers(given, given.best.inliers),
    )  # fmt: skip
    preferences = np.array([one.preference for one, _ in modes])
    _, likely = modes[int((parts.evidences + preferences).argmax())]
    possible = weights_of(TEMPER * parts.evidences)
    shared = math.sqrt(possible @ np.square([mode.size for _, mode in modes]))
    speeds = np.zeros(len(SPEEDS))
    speeds[[SPEEDS.index(one.speed) for one, _ in modes]] = possible
    posterior = given.best._replace(
        noise=likely.noise, freedom=likely.freedom, model_error=shared, shared=shared,
        bend=given.bend, speeds=speeds, squared_errors=np.zeros(0),
    )  # fmt: skip
    return _Camera(parts, preferences + STEADY_ODDS, posterior)


def _of_outliers(given: _Given, inliers: BoolArray) -> float:
    """Return the log evidence of the other points, anywhere in an image of squared focal length."""
    outside = given.observations.count - np.count_nonzero(inliers)
    return 2.0 * outside * math.log(given.assumed.focal_length)


def _with_turn(given: _Given, hypotheses: list[MotionHypothesis], steady: _Camera) -> list[_Camera]:
    """Return hypotheses without in-frame rotation, and with it if it is possible."""
    vibrating = None
    prior, odds = _expected(given.assumed)
    gain, undetected, vibrations = _hidden(given, steady.posterior, prior)
    steady = steady._replace(posterior=steady.posterior._replace(vibrations=vibrations))
    gain += odds
    if gain > _ASKS:
        vibrating = _vibrating(given, hypotheses, steady.posterior, prior)
    if vibrating is None:
        weight = 1.0 / (1.0 + math.exp(min(_HIDDEN_ODDS - TEMPER * gain, 700.0)))
        return [steady._replace(posterior=steady.posterior._replace(
            undetected=weight * undetected
        ))]  # fmt: skip
    total, other = (np.logaddexp.reduce(one.parts.evidences) for one in (steady, vibrating))
    # As if any speed left it, where vibration hardly shows.
    raised = vibrating.parts.evidences + max(total + gain - other, 0.0)
    return [steady, vibrating._replace(parts=vibrating.parts._replace(evidences=raised))]


def _expected(assumed: Assumed) -> tuple[TurnPrior, float]:
    """Return the prior of a vibration by the frames before, and the logarithm of its odds."""
    if not assumed.of_vibration.size:
        return VIBRATION, 0.0
    odds = VIBRATION.odds + assumed.of_vibration
    total = float(np.logaddexp.reduce(odds, axis=None))
    return VIBRATION._replace(odds=odds - total), total


def _hidden(given: _Given, steady: Posterior, prior: TurnPrior) -> tuple[float, Array, Array]:
    """Return evidence and effect of vibration at the best motion without it.

    Returns:
        logarithm of its evidence, against none; (12,12) second moments of the motion by it; (s,f)
        logarithms of the evidence of each one.
    """
    best, shared = given.best, given.frame.shared.at(steady.shared)
    own = steady.shared**2 * shared.squares
    # The degrees of freedom left are the same as with all sizes of the smooth error.
    decided = len(shared.rows) - float(np.sum(own / (steady.noise**2 + own))) - steady.freedom
    noise = Noise(steady.noise, 1.0, decided)
    linear = linear_of(given.lines, best.inliers, True, shared.rows)
    known = known_at(given.terms, best.state)
    # A track learns of each spectrum.
    looked = VIBRATION.of_first() if prior is VIBRATION else prior
    found = fit(linear, shared, known, noise, looked, True)
    if found.gain > _MAY_SHAKE and looked is not prior:
        looked = prior
        found = fit(linear, shared, known, noise, looked, True)
    none = np.zeros((MOTION_PARAMETERS, MOTION_PARAMETERS))
    if not found.evidence > -math.inf:
        return -math.inf, none, np.zeros((0, 0))
    each = np.log(np.maximum(found.weights, TINY)) - looked.odds + found.gain
    vibrations = np.tile(np.clip(each, -_MOST_TOLD, _MOST_TOLD), (len(SPECTRA) // len(each), 1))
    alone = fit(without(linear, "turn"), shared, known, noise, NO_TURN, True)
    place = slice(0, MOTION_PARAMETERS)
    move = _TURNED @ found.step - alone.step[place]
    beside = (found.noise / noise.deviation) ** 2 * alone.covariance[place, place]
    moments = _TURNED @ found.covariance @ _TURNED.T - beside + np.outer(move, move)
    return found.gain, moments, vibrations


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


def _at(given: _Given, state: Array, turn: Array, gate: float) -> _Turning:
    """Return the points at a motion with in-frame rotation; inliers lie within a gate (px)."""
    observations = given.observations
    data, count = observations.packed, observations.count
    shake = shake_at(observations.tau, COMBINATIONS @ turn.reshape(RESOLVED, 3))
    lines = linearized(data, count, state, shake)
    squares = np.square(lines.errors).sum(axis=1)
    squares[np.isinf(observations.squared_errors(state))] = np.inf
    return _Turning(state, turn, lines, squares, squares < gate * gate)


def _vibrating(
    given: _Given, hypotheses: list[MotionHypothesis], steady: Posterior, prior: TurnPrior
) -> _Camera | None:
    """Return hypotheses with in-frame rotation, if such a fit converges to as many points."""
    best, threshold = given.best, given.threshold
    widest = WIDEST_GATE * threshold
    gate, noise = min(max(threshold, GATE * best.noise), widest), best.noise
    in_frame, short = given.assumed.in_frame, _SHORT
    if in_frame is not None:  # near a rotation that is known the frame is more linear
        short = 1.0
    now, is_last, farthest = _at(given, best.state, np.zeros(TURNS), gate), False, math.inf
    # Points decide all of the motion.
    decided = float(PARAMETERS)
    for k in range(_STEPS):
        if np.count_nonzero(now.inliers) < _FEWEST_TURNING:
            return None
        beside = _beside_turn(given, now)
        known, linear = known_at(given.terms, beside.state), beside.linear
        if in_frame is not None:
            offset = step_between(given.terms.references[-1].copy(), beside.state)
            linear = uncoupled(linear, in_frame.by_motion, offset)
        found = fit(
            linear, beside.shared, known, Noise(noise, 1.0, decided), prior,
            is_last or k == _STEPS - 1,
        )  # fmt: skip
        if in_frame is not None:
            found = coupled(found, in_frame.by_motion, offset)
        step = beside.step + found.step
        if not found.evidence > -math.inf:
            return None
        lengths = np.square(step) / np.maximum(np.diagonal(found.covariance), TINY)
        farthest = float(lengths.max())
        state, turn = _after(now, step)
        if is_last or not np.isfinite(state).all():
            break
        noise = max(found.noise, LEAST_NOISE)
        gate = min(max(threshold, GATE * noise), widest)
        now, is_last = _at(given, state, turn, gate), farthest < short
    kept, had = np.count_nonzero(now.inliers), np.count_nonzero(best.inliers)
    if not (farthest < 1.0 and kept >= _KEPT * had):
        return None
    parts, last = [], _at(given, state, turn, math.inf)
    for one in hypotheses:
        part = under(found, known, known_at(one.terms, beside.state))
        parts.append((
            *_after(now, beside.step + part.step), _with_middle(part.covariance),
            part.evidence + one.odds,
        ))  # fmt: skip
    states, turns, covariances, evidences = (np.array(each) for each in zip(*parts, strict=True))
    evidences -= _of_outliers(given, now.inliers)
    preferences = np.array([one.preference for one in hypotheses])
    posterior = steady._replace(
        noise=found.noise, freedom=found.freedom, inliers=now.inliers, speeds=np.zeros(0),
        squared_errors=last.squares, shared=given.size,
    )  # fmt: skip
    return _Camera(Gaussians(states, turns, covariances, evidences), preferences, posterior)


class _BesideTurn(NamedTuple):
    """The products of motion and in-frame turn, from a camera that does not move."""

    linear: Linear
    shared: Shared
    state: Array  # (24,) without its vibration
    step: Array  # (72,) to there from where the lines are; the turn is whole


def _beside_turn(given: _Given, now: _Turning) -> _BesideTurn:
    shared = smooth_error(now.lines, now.inliers, given.bend, given.size).at(given.size)
    linear = linear_of(now.lines, now.inliers, True, shared.rows)
    still = apply_step(now.state, -MIDDLE @ now.turn)
    # The step starts at no velocity: the prior of a camera at rest is so sure of it that rounding
    # would show.
    step = np.append(np.zeros(PARAMETERS), -now.turn)
    step[POSE.stop : PARAMETERS] = -still[POSE_SIZE:]
    return _BesideTurn(moved(linear, step), shared, apply_step(still, step[:PARAMETERS]), step)


def _after(now: _Turning, step: Array) -> tuple[Array, Array]:
    """State and in-frame turn after a step (72,)."""
    change = step[PARAMETERS:]
    return apply_step(now.state, step[:PARAMETERS] + MIDDLE @ change), now.turn + change


def _mixed(given: _Given, groups: list[_Camera]) -> Posterior:
    """Mix all hypotheses; the inliers are those of the most probable kind."""
    if len(groups) > 1:
        evidences = np.concatenate([one.parts.evidences for one in groups])
        preferences = np.concatenate([one.preferences for one in groups])
        first = len(groups[0].preferences)
        shares = [
            weights_of(each)[:first].sum() for each in (TEMPER * evidences, evidences + preferences)
        ]
        groups = [
            one for one, part in zip(groups, (max(shares), 1.0 - min(shares)), strict=True)
            if part > _NO_PART
        ]  # fmt: skip
    parts = groups[0].parts if len(groups) == 1 else _together(*(one.parts for one in groups))
    found = mixture(parts, np.concatenate([one.preferences for one in groups]), TEMPER)
    likely = groups[0].posterior
    if len(groups) > 1 and found.probable[: len(groups[0].preferences)].sum() < 0.5:
        likely = groups[1].posterior
    covariance, shake = found.covariance, np.zeros((0, 3))
    if len(found.turn):
        covariance, shake = _in_functions(covariance), COMBINATIONS @ found.turn.reshape(-1, 3)
    if not len(likely.squared_errors):  # of all steady ones, and not of the best one alone
        likely = likely._replace(squared_errors=given.observations.squared_errors(found.state))
    return likely._replace(
        state=found.state, covariance=covariance, arched=found.along_arcs(), shake=shake
    )


def _together(steady: Gaussians, vibrating: Gaussians) -> Gaussians:
    """Join Gaussians of both kinds; those without in-frame rotation have zeros for it."""
    count = len(steady.states)
    covariances = np.zeros((count, PARAMETERS + TURNS, PARAMETERS + TURNS))
    covariances[:, :PARAMETERS, :PARAMETERS] = steady.covariances
    whole = steady._replace(turns=np.zeros((count, TURNS)), covariances=covariances)
    return Gaussians(*map(np.concatenate, zip(whole, vibrating, strict=True)))


def _in_functions(covariance: Array) -> Array:
    """Return the covariance (102,102) of motion and all coefficients, from one of (72,72)."""
    half, size = covariance[:, PARAMETERS:].reshape(-1, RESOLVED, 3), PARAMETERS + TURNS
    half = np.hstack([covariance[:, :PARAMETERS], (COMBINATIONS @ half).reshape(size, -1)])
    turned = (COMBINATIONS @ half[PARAMETERS:].reshape(RESOLVED, -1)).reshape(-1, half.shape[1])
    return np.vstack([half[:PARAMETERS], turned])


def _clearly_moving(given: _Given) -> bool:
    """Return True if neither rest nor another typical speed would change anything."""
    known = given.assumed.turn is not None  # and only the way is not
    place = slice(LINEAR.start if known else VELOCITIES.start, VELOCITIES.stop)
    spread = given.best.covariance[place, place]
    part = float(np.diagonal(given.terms.informations[0])[place] @ np.diagonal(spread))
    velocities = given.best.state[POSE_SIZE - POSE.stop :][place]
    return part < _LITTLE_OF_THE_PRIOR and bool(
        velocities @ np.linalg.solve(spread, velocities) > _CLEARLY_MOVING
    )
