# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The motion over the last frames: one trajectory, whose accelerations' deviations are learnt.

Frames are samples of a trajectory whose accelerations fade while new ones come (Singer, "Estimating
optimal tracking filter performance for manned maneuvering targets", 1970). A frame's points, beside
what was known before, give a Gaussian ``exp(-d' L d / 2 + g' d)`` of the step ``d`` from the
frame's estimate. A filter runs forward through the window, and a smoother back (Rauch et al.,
"Maximum likelihood estimates of linear dynamic systems", 1965).

``P`` is the covariance of the prediction, to which the transition adds ``Q`` for the accelerations
of one axis. ``x`` is the smoothed step from the prediction, and ``V`` its covariance. The score of
the variance of these accelerations is

    e' Q e - tr(Q M),      e = P^-1 x,      M = cov(e) = P^-1 - P^-1 V P^-1.

A variance ``r`` times as large makes it ``(r - 1) tr(Q M Q M)`` in the mean: so scales of a tripod,
of a hand and of a car are found within a few frames.

Real accelerations last longer than this model's, and those of noise end at once. So the next image
is predicted by what fades soon, and the errors of a moment that no image shows are those of
accelerations that last.

The motion is a mixture, weighed as that of one frame (docs/estimator.md). Who rests may start
before a scale can be learnt anew: in the last transitions accelerations are those that were learnt,
or three or ten times as large. A hand that images see once or thrice a second has turned back
between them: velocities in images may also differ from the trajectory's, by deviations of five
sizes, and poses between images by what that makes.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from rs_localizer.config import Acceleration
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, Array1, Array2, Array3
from rs_localizer.core.rotation_prior import RotationPrior
from rs_localizer.core.shake import MIDDLE_RATES, MIDDLE_VALUES
from rs_localizer.core.shutter import Motion, carried, motion_of
from rs_localizer.core.state import (
    ANGULAR,
    PARAMETERS,
    POSE,
    POSE_SIZE,
    STATE_ANGULAR,
    STATE_ANGULAR_ACCELERATION,
    STATE_SIZE,
    STATE_TRANSLATION,
    TURN,
    VELOCITIES,
    rotation_of,
    step_between,
)
from rs_localizer.core.types import Estimate, altered
from rs_localizer.estimation.gaussian import Gaussians, mixture
from rs_localizer.estimation.hypotheses import TEMPER
from rs_localizer.estimation.prior import PriorTerms, add_prior, state_in
from rs_localizer.estimation.robust import apply_step, inverse_of, inverted
from rs_localizer.native import entry, kernel

LENGTH = 6
"""Frames of the window: at 30 Hz a fifth of a second, in which a hand changes its mind."""
# Time (s) in which accelerations fade. Of 0.1, 0.05 and 0.03 the last one has the least errors of
# turn rates of a phone in a car and of Aria's head, and the most of them inside.
FADING = 0.03
# The same for errors of predictions that no image follows, and the factor of their variances for
# deviations that are learnt from some twelve numbers: F(3, 12) instead of chi-squared. Of a real
# hand, 0.03 and 1 leave 87 and 76 % of poses and twists inside 0.1 s ahead, these 96 and 97 %.
_LASTING, _FEW = 0.1, 1.3
# Below this part of the time of fading the closed form of the noise is rounding errors.
_SHORT = 0.03
# Weight of a transition's score by its age, in transitions.
_FORGETTING = 0.8
# Numbers that must have told of a scale before it follows them halfway.
_DOUBT = 5.0
# How much variances may change in a round, and rounds: by a hundred within two frames.
_LEAST_CHANGE, _MOST_CHANGE, _ROUNDS = 0.2, 25.0, 2
# Deviations that a round changes by less than this logarithm have settled.
_SETTLED = 0.1
# Of the configured deviations: a tripod's, and that of a blow.
_LEAST_SCALE, _MOST_SCALE = 0.03, 100.0
# Factors of the accelerations of the last transitions, and, in the mean, the logarithm of the odds
# that they are as they were learnt: at 30 Hz one start in two seconds.
_GROWN, _ODDS, _RECENT = (3.0, 10.0), math.log(20.0), 3
# Deviations of velocities in images from the trajectory's, over configured accelerations times the
# time between images, if that (s) is longer: below, they change no twist of hands nor of a phone.
_SWINGS, _SLOW = (0.01, 0.03, 0.1, 0.3, 1.0), 0.15
# Who turns about one axis turns a little about the others: of the largest deviation.
_LEAST_SHARE = 0.3
# Derivatives of a motion without its vibration by motion and coefficients.
_UNSHAKEN = np.eye(PARAMETERS, PARAMETERS + 3 * len(MIDDLE_VALUES))
_UNSHAKEN[TURN, PARAMETERS:] = -np.kron(MIDDLE_VALUES, np.eye(3))
_UNSHAKEN[ANGULAR, PARAMETERS:] = -np.kron(MIDDLE_RATES, np.eye(3))
_ORIGIN = np.zeros(3)
# Places of the deviations of a pose's axes: each turn has its own, all moves share the last.
_OF_AXES = np.array([0, 1, 2, 3, 3, 3])
# Powers of a time in velocities and accelerations, by the places of a step.
_ORDERS = np.repeat([0.0, 0.0, 1.0, 1.0, 2.0, 2.0], 3)


class Gaussian(NamedTuple):
    """A motion at a time; s, m and rad, camera_from_map."""

    time_ns: int
    state: Array1  # (24,)
    covariance: Array2  # (18,18) of a step

    def per_readout(self, span: float) -> tuple[Motion, Array]:
        """Return the motion and its covariance, per readout of ``span`` s."""
        state, units = _per(self.state, span)
        motion = motion_of((rotation_of(state), *state[POSE_SIZE - 3 :].reshape(5, 3)))
        return motion, self.covariance * np.outer(units, units)


class MotionSample(NamedTuple):
    """The estimate that the points of a frame give of its motion; s, m and rad."""

    time_ns: int
    state: Array  # (24,) the frame's estimate
    information: Array  # (18,18)
    gradient: Array  # (18,)

    def over(self, seconds: float) -> MotionSample:
        """Return the same per so many s: per readout, or of one per readout by its inverse."""
        state, units = _per(self.state, seconds)
        information = self.information / np.outer(units, units)
        return MotionSample(self.time_ns, state, information, self.gradient / units)


def _per(state: Array, seconds: float) -> tuple[Array, Array]:
    """Return a state (24,) per so many s in place of one, and the units (18,) of its step."""
    units, state = seconds**_ORDERS, state.copy()
    state[POSE_SIZE:] *= units[POSE.stop :]
    return state, units


class _Solved(NamedTuple):
    """Motions of n samples, behind the start."""

    states: Array2  # (n+1,24)
    covariances: Array3  # (n+1,18,18)
    deviations: Array1  # (4,) as they were learnt
    surprise: float  # squared distance of the last sample from its prediction
    evidence: float  # logarithm, of all samples


class _Swinging(NamedTuple):
    """Motions of n images about one trajectory, beside which their velocities are."""

    states: Array  # (n,24)
    own: tuple[Array, Array]  # informations (n,18,18) and gradients (n,18) of the images
    told: tuple[Array, Array]  # of the trajectory
    spreads: Array  # (n,18,18) covariance of the images' motions, if the trajectory is known
    evidence: float  # logarithm of the factor of their likelihood

    @classmethod
    def of(
        cls, states: Array, own: tuple[Array, Array], deviations: Array, away: Array
    ) -> _Swinging:
        """Let velocities differ by deviations (n,4), and poses by these times ``away`` (n,), s."""
        informations, gradients = own
        precisions, spreads = deviations[:, _OF_AXES] ** -2.0, np.zeros_like(informations)
        inner = informations[:, VELOCITIES, VELOCITIES] + precisions[:, :, None] * np.eye(6)
        spreads[:, VELOCITIES, VELOCITIES] = np.linalg.inv(inner)
        across = informations @ spreads
        pulled = np.einsum("nij,nj->ni", across, gradients)
        evidence = np.log(precisions).sum() - np.linalg.slogdet(inner)[1].sum()
        evidence += np.einsum("ni,nij,nj->", gradients, spreads, gradients)
        spreads[:, POSE, POSE] = (away[:, None] ** 2 / precisions)[:, :, None] * np.eye(6)
        told = informations - across @ informations, gradients - pulled
        return cls(states, own, told, spreads, 0.5 * float(evidence))

    def of_images(self, found: _Solved) -> _Solved:
        """Return the motions of the images by those of the trajectory."""
        for k, (state, told, pull, spread) in enumerate(
            zip(self.states, *self.own, self.spreads, strict=True), 1
        ):
            kept = np.eye(PARAMETERS) - spread @ told
            step = kept @ step_between(state, found.states[k]) + spread @ pull
            found.states[k] = apply_step(state, step)
            found.covariances[k] = kept @ found.covariances[k] @ kept.T + spread
        return found._replace(evidence=found.evidence + self.evidence)


@dataclass(frozen=True, eq=False)
class MotionWindow:
    """The last frames with a pose that hang together.

    Args:
        start: the motion of the frame before them, by all frames until then.
        configured: (4,) deviations of accelerations, angular about the camera's axes (rad/s^2) and
            linear, by the settings.
        deviations: (4,) the same, learnt.
        readout_share: deviation of the readout time, as a part of it.
        samples: the frames after the start.
        filtered: their motions, of each by the samples until then; first with accelerations as
            they were learnt.
    """

    start: Gaussian
    configured: Array
    deviations: Array
    readout_share: float = 0.0
    samples: tuple[MotionSample, ...] = ()
    filtered: tuple[_Solved, ...] = ()

    @classmethod
    def begin(
        cls, start: Gaussian, acceleration: Acceleration, readout_share: float = 0.0
    ) -> MotionWindow:
        """Begin with a motion of which no other frame tells."""
        configured = _deviations(acceleration)
        return cls(start, configured, configured, readout_share)

    @property
    def times(self) -> list[int]:
        """Times of its frames, ns."""
        return [self.start.time_ns, *(sample.time_ns for sample in self.samples)]

    @property
    def surprise(self) -> float:
        """Squared distance of the last frame's points from its prediction; chi-squared of 18."""
        return self.filtered[0].surprise if self.filtered else 0.0

    def __len__(self) -> int:
        return len(self.samples) + 1

    @cached_property
    def newest(self) -> Gaussian:
        """The motion of the last frame, of which no later one tells."""
        return self._mixed(self.filtered, len(self.samples)) if self.samples else self.start

    @cached_property
    def _earlier(self) -> list[Gaussian]:
        """The motions of the others, given all frames."""
        solved = self._solved(0, True)
        return [self._mixed(solved, row) for row in range(len(self.samples))]

    def before(self, frames: int) -> Gaussian:
        """Return the motion so many frames before the last one, given all frames."""
        return self._earlier[-frames] if frames else self.newest

    def _mixed(self, solved: Sequence[_Solved], row: int) -> Gaussian:
        """Return the motion of a row by all solutions."""
        odds = np.zeros(len(solved))
        odds[0] = _ODDS
        # From where the camera is: a map's origin may be thousands of kilometres away.
        states = np.array([one.states[row] for one in solved])
        centre = -rotation_of(states[0]).T @ states[0, STATE_TRANSLATION]
        for state in states:
            state[STATE_TRANSLATION] += rotation_of(state) @ centre
        covariances = np.array([one.covariances[row] for one in solved])
        evidences = np.array([one.evidence for one in solved])
        parts = Gaussians(states, np.zeros((len(odds), 0)), covariances, evidences)
        whole = mixture(parts, odds, TEMPER)
        whole.state[STATE_TRANSLATION] -= rotation_of(whole.state) @ centre
        return Gaussian(self.times[row], whole.state, whole.covariance)

    def foreseen(self, time_ns: int, readout_share: float) -> Gaussian:
        """Return the motion that an image at a time after the last frame may have.

        Its accelerations may be as large as the settings say, however calm the frames before were:
        what the image tells joins the window without this.
        """
        largest = np.maximum(self.deviations, self.configured)
        return self._ahead(time_ns, largest, readout_share, FADING)

    def _ahead(
        self, time_ns: int, deviations: Array, readout_share: float, lasting: float
    ) -> Gaussian:
        """Return the motion after the last frame, with deviations (4,) of accelerations.

        ``lasting`` is the time (s) in which the accelerations fade that its covariance is of.
        """
        last, seconds = self.newest, 1e-9 * (time_ns - self.newest.time_ns)
        if seconds == 0.0:
            return last
        state, transport, added = _predicted(
            last.state, seconds, deviations, readout_share, lasting
        )
        return Gaussian(time_ns, state, transport @ last.covariance @ transport.T + added)

    def at(self, time_ns: int) -> Gaussian | None:
        """Return the motion at a time, given all frames; None before the first of them."""
        times = self.times
        if time_ns < times[0]:
            return None
        if time_ns > times[-1]:
            ahead = self._ahead(time_ns, self.deviations, self.readout_share, _LASTING)
            return ahead._replace(covariance=_FEW * ahead.covariance)
        if time_ns in times:
            return self.before(len(times) - 1 - times.index(time_ns))
        row = int(np.searchsorted(times, time_ns)) - 1
        nothing = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
        silent = MotionSample(time_ns, self.samples[row].state, *nothing)
        there = replace(self, samples=(*self.samples[:row], silent, *self.samples[row:]))
        return there.before(len(self.samples) - row)

    def joined(self, sample: MotionSample) -> MotionWindow:
        """Return the window with one more frame, and with learnt accelerations."""
        start, samples = self.start, (*self.samples, sample)
        if len(samples) >= LENGTH:
            states, covariances, *_ = self.filtered[0]
            start, samples = Gaussian(samples[0].time_ns, states[1], covariances[1]), samples[1:]
        there = replace(self, start=start, samples=samples)
        filtered = there._solved(_ROUNDS, False)
        return replace(there, deviations=filtered[0].deviations, filtered=filtered)

    def _solved(self, rounds: int, smooths: bool) -> tuple[_Solved, ...]:
        """Return the motions by all samples or, not smoothed, by those until each.

        ``rounds``: of learning the deviations.
        """
        _, states, informations, gradients = map(np.array, zip(*self.samples, strict=True))
        seconds: Array = np.diff(self.times).astype(np.float64) * 1e-9

        def solved(
            told: tuple[Array, Array], deviations: Array, rounds: int, grown: float
        ) -> _Solved:
            return _solve(
                seconds, states, *told, self.start, self.configured, deviations,
                self.readout_share, rounds, smooths, grown,
            )  # fmt: skip

        told = informations, gradients
        found = [solved(told, self.deviations, rounds, 1.0)]
        learnt = found[0].deviations
        found += [solved(told, learnt, 0, grown) for grown in _GROWN]
        apart, away = _between(seconds, informations)
        for swing in _SWINGS if statistics.median(apart.tolist()) > _SLOW else ():
            beside = _Swinging.of(states, told, swing * np.outer(apart, self.configured), away)
            found.append(beside.of_images(solved(beside.told, learnt, 0, 1.0)))
        return tuple(found)


def _between(seconds: Array, informations: Array) -> tuple[Array, Array]:
    """Return times (n,) between images, of steps between samples, and how far one is from them.

    A sample that tells nothing, and is not the last one, lies between two images. The slowest
    swing that neither shows has a half of its period between them, and is away by its velocity
    times this time (n,), s.
    """
    apart, away = seconds.copy(), np.zeros(len(seconds))
    for k in np.flatnonzero(~informations[:-1].any(axis=(1, 2))):
        apart[k : k + 2] = whole = seconds[k] + seconds[k + 1]
        away[k] = whole / math.pi * math.sin(math.pi * seconds[k] / whole)
    return apart, away


@entry
def _predicted(
    state: Array1, seconds: float, deviations: Array1, readout_share: float, lasting: float
) -> tuple[Array, Array, Array]:
    """Return the state so much later, its derivative, and the covariance that is added until then.

    Derivative and covariance are those of accelerations that last so long (s).
    """
    numbers = (
        state[:9].copy().reshape(3, 3), state[9:12].copy(), state[12:15].copy(),
        state[15:18].copy(), state[18:21].copy(), state[21:24].copy(),
    )  # fmt: skip
    later, transport = carried(numbers, seconds, FADING)
    predicted = np.concatenate((
        later[0].reshape(9), later[1], later[2], later[3], later[4], later[5],
    ))  # fmt: skip
    if lasting != FADING:
        _, transport = carried(numbers, seconds, lasting)
    added, moved = _added(seconds, deviations, lasting), predicted[12:18]
    added[POSE, POSE] += (readout_share * seconds) ** 2 * np.outer(moved, moved)
    return predicted, transport, added


@entry
def _added(seconds: float, deviations: Array1, lasting: float) -> Array:
    """Return the covariance (18,18) that new accelerations (4,) add, in SI units."""
    unit, added = singer(abs(seconds), lasting), np.zeros((3, 6, 3, 6))
    for axis in range(6):
        added[:, axis, :, axis] = deviations[_OF_AXES[axis]] ** 2 * unit
    return added.reshape(PARAMETERS, PARAMETERS)


def acceleration_covariance(acceleration: Acceleration, dt: float, readout_time: float) -> Array:
    """Return the covariance (18,18), per readout, that new accelerations add over ``dt`` s.

    The deviations are those of the accelerations themselves, at any time (Singer's model in closed
    form).
    """
    units, deviations = readout_time**_ORDERS, _deviations(acceleration)
    added: Array = _added(float(dt), deviations, FADING) * np.outer(units, units)
    return added


def _deviations(acceleration: Acceleration) -> Array:
    return np.repeat([float(acceleration.angular), float(acceleration.linear)], (3, 1))


@kernel
def singer(seconds: float, fading: float) -> Array:
    """Return the covariance (3,3) of way, velocity, acceleration per unit acceleration, SI."""
    x = seconds / fading
    block = np.empty((3, 3))
    if x < _SHORT:
        # White noise on the acceleration, to first order.
        block[0, 0], block[0, 1], block[0, 2] = x**5 / 10.0, x**4 / 4.0, x**3 / 3.0
        block[1, 1], block[1, 2], block[2, 2] = 2.0 * x**3 / 3.0, x**2, 2.0 * x
    else:
        e, e2 = math.exp(-x), math.exp(-2.0 * x)
        block[0, 0] = 1.0 - e2 + 2.0 * x + 2.0 * x**3 / 3.0 - 2.0 * x**2 - 4.0 * x * e
        block[0, 1] = e2 + 1.0 - 2.0 * e + 2.0 * x * e - 2.0 * x + x**2
        block[0, 2] = 1.0 - e2 - 2.0 * x * e
        block[1, 1] = 4.0 * e - 3.0 - e2 + 2.0 * x
        block[1, 2] = e2 + 1.0 - 2.0 * e
        block[2, 2] = 1.0 - e2
    units = (fading * fading, fading, 1.0)
    for i in range(3):
        for j in range(i, 3):
            block[i, j] *= units[i] * units[j]
            block[j, i] = block[i, j]
    return block


@entry
def _solve(
    seconds: Array1, states: Array2, informations: Array3, gradients: Array2, start: Gaussian,
    configured: Array1, learnt: Array1, readout_share: float, rounds: int, smooths: bool,
    grown: float,
) -> _Solved:  # fmt: skip
    """Filter, learn deviations and perhaps smooth.

    Args:
        seconds: (n,) of each transition.
        configured, learnt: (4,) deviations by the settings, and as they are known.
        rounds: of learning.
        smooths: all samples tell of all motions.
        grown: factor of the deviations of the last transitions.
    """
    count, deviations = len(seconds), learnt.copy()
    square, row = (count + 1, PARAMETERS, PARAMETERS), (count + 1, STATE_SIZE)
    predicted, found, covariances = np.empty(row), np.empty(row), np.empty(square)
    added, transports, knowns = np.empty(square), np.empty(square), np.empty(square)
    while True:
        found[0], covariances[0], surprise, evidence = start.state, start.covariance, 0.0, 0.0
        for k in range(count):
            own = enlarged(deviations, configured, grown if k >= count - _RECENT else 1.0)
            predicted[k], transports[k], added[k] = _predicted(
                found[k], seconds[k], own, readout_share, FADING
            )
            spread = transports[k] @ covariances[k] @ transports[k].T + added[k]
            knowns[k], narrower = inverse_of(spread)
            covariances[k + 1], left = inverse_of(informations[k] + knowns[k])
            right = gradients[k] + knowns[k] @ step_between(states[k], predicted[k])
            step = covariances[k + 1] @ right
            found[k + 1] = apply_step(states[k], step)
            moved = step_between(predicted[k], found[k + 1])
            surprise = np.sum(moved * (knowns[k] @ moved))
            surprise += np.sum(step * (informations[k] @ step - 2.0 * gradients[k]))
            evidence -= narrower + left + 0.5 * surprise
        if rounds == 0 and not smooths:
            break
        scores, weight = np.zeros((4, 3)), 1.0
        for k in range(count - 1, -1, -1):
            known, after = knowns[k], covariances[k + 1].copy()
            step = step_between(predicted[k], found[k + 1])
            pull, spread = known @ step, known - known @ after @ known
            _score(seconds[k], deviations, pull, spread, weight, scores)
            weight *= _FORGETTING
            gain = covariances[k] @ transports[k].T @ known
            found[k] = apply_step(found[k], gain @ step)
            kept = np.eye(PARAMETERS) - gain @ transports[k]  # no difference of large ones (Joseph)
            whole = kept @ covariances[k] @ kept.T + gain @ (after + added[k]) @ gain.T
            covariances[k] = 0.5 * (whole + whole.T)
        if rounds == 0:
            break
        ratios = 1.0 + (scores[:, 0] - scores[:, 1]) / (scores[:, 2] + _DOUBT)
        before, ratios = deviations, np.minimum(np.maximum(ratios, _LEAST_CHANGE), _MOST_CHANGE)
        least, most = _LEAST_SCALE * configured, _MOST_SCALE * configured
        deviations = np.minimum(np.maximum(before * np.sqrt(ratios), least), most)
        deviations[:3] = np.maximum(deviations[:3], _LEAST_SHARE * deviations[:3].max())
        is_settled = np.max(np.abs(np.log(deviations / before))) < _SETTLED
        rounds = 0 if is_settled else rounds - 1
    return _Solved(found, covariances, deviations, surprise, evidence)


@entry
def enlarged(deviations: Array1, configured: Array1, grown: float) -> Array:
    """Return deviations (4,) so many times as large, up to those of the settings."""
    larger: Array = np.minimum(grown * deviations, np.maximum(deviations, configured))
    return larger


@kernel
def _score(
    seconds: float, deviations: Array1, pull: Array1, spread: Array2, weight: float, scores: Array2
) -> None:
    """Add a transition to scores (4,3) of the deviations: squared, expected, information."""
    unit = singer(seconds, FADING)
    for axis in range(6):
        place = _OF_AXES[axis]
        noise, along = deviations[place] ** 2 * unit, pull[axis::6].copy()
        own = noise @ spread[axis::6, axis::6].copy()
        scores[place, 0] += weight * np.sum(along * (noise @ along))
        scores[place, 1] += weight * np.trace(own)
        scores[place, 2] += weight * np.sum(own * own.T)


@entry
def _told_by_points(covariance: Array2, known: Array2) -> Array:
    """Return the information (18,18) of a posterior beyond its prior.

    By the eigenvalues of what was known, in units of the posterior: none of them exceeds 1.
    """
    whole = inverted(covariance)
    scale = np.sqrt(np.diag(whole))
    units = np.outer(scale, scale)
    factor = np.linalg.cholesky(whole / units)
    back = np.linalg.inv(factor)
    part = back @ (known / units) @ back.T
    values, vectors = np.linalg.eigh(0.5 * (part + part.T))
    half = factor.copy() @ (vectors * np.sqrt(np.maximum(1.0 - values, 0.0)))
    told: Array = (half @ half.T) * units
    return told


def swing_of(estimate: Estimate) -> Array:
    """Return the covariance (18,18) of the shaking about the motion without it.

    A camera that shakes is, in the middle row, somewhere on its swing; a frame later it is
    somewhere else on it.
    """
    swing, squares = np.zeros((PARAMETERS, PARAMETERS)), np.square(estimate.shake).sum(axis=1) / 3.0
    if len(squares):
        swing[TURN, TURN] = (MIDDLE_VALUES[: len(squares)] ** 2 @ squares) * np.eye(3)
        swing[ANGULAR, ANGULAR] = (MIDDLE_RATES[: len(squares)] ** 2 @ squares) * np.eye(3)
    return swing


def unshaken(estimate: Estimate) -> tuple[Motion, Array, Array]:
    """Return the motion without vibration, its covariance, and its derivative."""
    shake, joint = estimate.shake, estimate.joint_covariance
    jacobian = _UNSHAKEN[:, : len(joint)]
    if not len(shake) and len(joint) == PARAMETERS:
        return estimate, joint, jacobian
    turned = so3.exp(MIDDLE_VALUES[: len(shake)] @ shake)
    still = altered(
        estimate, rotation=turned @ estimate.rotation, translation=turned @ estimate.translation,
        angular_velocity=estimate.angular_velocity - MIDDLE_RATES[: len(shake)] @ shake,
    )  # fmt: skip
    covariance = jacobian @ joint @ jacobian.T
    # Pose and turn cancel: what rounding leaves of the difference of two large variances.
    return still, 0.5 * (covariance + covariance.T), jacobian


def gaussian_of(estimate: Estimate, time_ns: int) -> Gaussian:
    """Return the motion of one frame without vibration."""
    motion, covariance, _ = unshaken(estimate)
    state, units = _per(state_in(motion, _ORIGIN), 1.0 / estimate.span)
    return Gaussian(time_ns, state, covariance * np.outer(units, units))


def told_of(
    estimate: Estimate, time_ns: int, known: PriorTerms, rotation: RotationPrior | None = None
) -> MotionSample:
    """Return what the points of an estimate tell of its motion.

    Args:
        known: what was known of that motion before, in the map's frame.
        rotation: beside which that is; None: it is of the whole motion.
    """
    motion, covariance, _ = unshaken(estimate if rotation is None else rotation.beside(estimate))
    information, slope = np.zeros((PARAMETERS,) * 2), np.zeros(PARAMETERS)
    state = state_in(motion, _ORIGIN)
    add_prior(known, state, 1.0, information, slope)
    if rotation is not None:
        state[STATE_ANGULAR] += rotation.smooth_rate
        state[STATE_ANGULAR_ACCELERATION] += rotation.change
    told = MotionSample(time_ns, state, _told_by_points(covariance, information), slope)
    return told.over(1.0 / estimate.span)


def estimate_at(estimate: Estimate, gaussian: Gaussian) -> Estimate:
    """Return a frame's estimate with the window's motion; residuals stay as they were.

    What shakes beside the motion goes along as far as the frame's covariance ties it to it.
    """
    known, spread = gaussian.per_readout(estimate.span)
    if not len(estimate.shake):
        return estimate.with_joint_covariance(spread, **numbers_by_name(known), twist_known=True)
    motion, covariance, jacobian = unshaken(estimate)
    joint = estimate.joint_covariance
    gain = np.linalg.solve(covariance, jacobian @ joint).T
    step = gain @ step_from(motion, known)
    state = apply_step(state_in(estimate, _ORIGIN), step[:PARAMETERS])
    whole, _ = Gaussian(gaussian.time_ns, state, spread).per_readout(1.0)
    joint = joint + gain @ (spread - covariance) @ gain.T
    return estimate.with_joint_covariance(
        0.5 * (joint + joint.T), **numbers_by_name(whole),
        shake=estimate.shake + step[PARAMETERS:].reshape(-1, 3), twist_known=True,
    )  # fmt: skip


def predicted_estimate(nearest: Estimate, gaussian: Gaussian, swing: Array) -> Estimate:
    """Return the motion between or after frames, with the points of the nearest frame.

    Args:
        swing: (18,18) covariance of the shaking about that motion, per readout.
    """
    motion, covariance = gaussian.per_readout(nearest.span)
    return nearest.with_joint_covariance(
        covariance + swing, **numbers_by_name(motion), shake=np.zeros((0, 3)),
        time_ns=gaussian.time_ns,
    )  # fmt: skip


def step_from(one: Motion, other: Motion) -> Array:
    """Return the step (18,) from one motion to another: rad and m in the axes of the first."""
    step: Array = step_between(state_in(one, _ORIGIN), state_in(other, _ORIGIN))
    return step


def numbers_by_name(motion: Motion) -> dict[str, Array]:
    """Return the numbers of a motion, or of what has one, by their names."""
    return {each.name: getattr(motion, each.name) for each in fields(Motion)}
