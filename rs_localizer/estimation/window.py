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

A variance ``r`` times as large makes it ``(r - 1) tr(Q M Q M)`` in the mean. So the scales of a
tripod, of a hand and of a car are found within a few frames, from below and from above.

Real accelerations last longer than this model's, and those of noise end at once. So the next image
is predicted by what fades soon, and the errors of a moment that no image shows are those of
accelerations that last.

Who rests may start at any time, before a scale can be learnt anew. So the motion is a mixture: in
the last transitions accelerations are those that were learnt, or three or ten times as large, up to
the settings'. Its mean and its region are weighed as those of one frame (docs/estimator.md).

A hand that images see once or thrice a second has turned back between them: their way does not tell
its velocity. So velocities in images may also differ from those of the trajectory, by deviations of
four sizes, each a part of the mixture.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
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
from rs_localizer.core.types import Estimate
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
# Accelerations of the last transitions may be so many times as large as they were learnt. In the
# mean, the logarithm of the odds that they are not: at 30 Hz one start in two seconds.
_GROWN, _ODDS, _RECENT = (3.0, 10.0), math.log(20.0), 3
# Deviations of velocities in images from the trajectory's, over configured accelerations times the
# time between images, if that (s) is longer: below, they change no twist of hands nor of a phone.
_SWINGS, _SLOW = (0.01, 0.03, 0.1, 0.3), 0.15
# Who turns about one axis turns a little about the others: of the largest deviation.
_LEAST_SHARE = 0.3
# Derivatives of a motion without its vibration by motion and coefficients.
_UNSHAKEN = np.eye(PARAMETERS, PARAMETERS + 3 * len(MIDDLE_VALUES))
_UNSHAKEN[TURN, PARAMETERS:] = -np.kron(MIDDLE_VALUES, np.eye(3))
_UNSHAKEN[ANGULAR, PARAMETERS:] = -np.kron(MIDDLE_RATES, np.eye(3))
_ORIGIN = np.zeros(3)
# Places of the deviations of a velocity: each turn has its own, all moves share the last.
_AXES = (0, 1, 2, 3, 3, 3)
# Powers of a time in velocities and accelerations, by the places of a step.
_ORDERS = np.repeat([0.0, 0.0, 1.0, 1.0, 2.0, 2.0], 3)


class Gaussian(NamedTuple):
    """A motion at a time; s, m and rad, camera_from_map."""

    time_ns: int
    state: Array  # (24,)
    covariance: Array  # (18,18) of a step

    def per_readout(self, span: float) -> tuple[Motion, Array]:
        """Return the motion and its covariance, per readout of ``span`` s."""
        units, state = span**_ORDERS, self.state.copy()
        state[12:] *= units[6:]
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
        units, state = seconds**_ORDERS, self.state.copy()
        state[12:] *= units[6:]
        information = self.information / np.outer(units, units)
        return MotionSample(self.time_ns, state, information, self.gradient / units)


class _Solved(NamedTuple):
    """Motions of n samples, behind the start."""

    states: Array  # (n+1,24)
    covariances: Array  # (n+1,18,18)
    deviations: Array  # (4,) as they were learnt
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
    def of(cls, states: Array, own: tuple[Array, Array], deviations: Array) -> _Swinging:
        """Let velocities differ by deviations (n,4)."""
        informations, gradients = own
        precisions, spreads = deviations[:, _AXES] ** -2.0, np.zeros_like(informations)
        inner = informations[:, VELOCITIES, VELOCITIES] + precisions[:, :, None] * np.eye(6)
        spreads[:, VELOCITIES, VELOCITIES] = np.linalg.inv(inner)
        across = informations @ spreads
        pulled = np.einsum("nij,nj->ni", across, gradients)
        evidence = np.log(precisions).sum() - np.linalg.slogdet(inner)[1].sum()
        evidence += np.einsum("ni,nij,nj->", gradients, spreads, gradients)
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


@dataclass(frozen=True, slots=True, eq=False)
class MotionWindow:
    """The last frames with a pose that hang together.

    Args:
        start: the motion of the frame before them, by all frames until then.
        configured: (4,) deviations of accelerations, angular about the camera's axes (rad/s^2) and
            linear, by the settings.
        deviations: (4,) the same, learnt.
        samples: the frames after it.
        readout_share: deviation of the readout time, as a part of it.
    """

    start: Gaussian
    configured: Array
    deviations: Array
    samples: tuple[MotionSample, ...] = ()
    solved: tuple[_Solved, ...] = ()  # filtered; first with accelerations as they were learnt
    readout_share: float = 0.0
    mixed: dict[int, Gaussian] = field(default_factory=dict)  # by row, those that were asked for

    @classmethod
    def begin(
        cls, start: Gaussian, acceleration: Acceleration, readout_share: float = 0.0
    ) -> MotionWindow:
        """Begin with a motion of which no other frame tells."""
        configured = _deviations(acceleration)
        return cls(start, configured, configured, readout_share=readout_share)

    @property
    def newest(self) -> Gaussian:
        """The motion of the last frame, as all frames tell."""
        return self.before(0)

    @property
    def times(self) -> list[int]:
        """Times of its frames, ns."""
        return [self.start.time_ns, *(sample.time_ns for sample in self.samples)]

    @property
    def surprise(self) -> float:
        """Squared distance of the last frame's points from its prediction; chi-squared of 18."""
        return self.solved[0].surprise if self.solved else 0.0

    def __len__(self) -> int:
        return len(self.samples) + 1

    def before(self, frames: int) -> Gaussian:
        """Return the motion so many frames before the last one, given all frames."""
        if not self.solved:
            return self.start
        last = len(self.samples)
        if last - frames not in self.mixed:
            # Of the last one no later sample tells.
            rows = range(last) if frames else range(last, last + 1)
            solved = self._solutions(0, True) if frames else self.solved
            self.mixed.update({row: self._mixture(solved, row) for row in rows})
        return self.mixed[last - frames]

    def _mixture(self, solved: Sequence[_Solved], row: int) -> Gaussian:
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

    def foreseen(self, time_ns: int) -> Gaussian:
        """Return the motion that an image at a time after the last frame may have.

        Its accelerations may have grown: what the image tells joins the window without this.
        """
        deviations = enlarged(self.deviations, self.configured, _GROWN[-1])
        return replace(self, deviations=deviations).after(time_ns)

    def after(self, time_ns: int, lasting: float = FADING) -> Gaussian:
        """Return the motion at a time after the last frame.

        ``lasting`` is the time (s) in which the accelerations fade that its covariance is of.
        """
        last = self.newest
        if time_ns == last.time_ns:
            return last
        state, transport, added = _predicted(
            last.state, 1e-9 * (time_ns - last.time_ns), self.deviations, self.readout_share,
            float(lasting),
        )  # fmt: skip
        return Gaussian(time_ns, state, transport @ last.covariance @ transport.T + added)

    def at(self, time_ns: int) -> Gaussian | None:
        """Return the motion at a time, given all frames; None before the first of them."""
        times = self.times
        if time_ns < times[0]:
            return None
        if time_ns > times[-1]:
            ahead = self.after(time_ns, _LASTING)
            return ahead._replace(covariance=_FEW * ahead.covariance)
        if time_ns in times:
            return self.before(len(times) - 1 - times.index(time_ns))
        row = int(np.searchsorted(times, time_ns)) - 1
        nothing = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
        silent = MotionSample(time_ns, self.samples[row].state, *nothing)
        there = replace(self, samples=(*self.samples[:row], silent, *self.samples[row:]))
        return there._through(0).before(len(self.samples) - row)

    def joined(self, sample: MotionSample) -> MotionWindow:
        """Return the window with one more frame, and with learnt accelerations."""
        start, samples = self.start, (*self.samples, sample)
        if len(samples) >= LENGTH:
            states, covariances, *_ = self.solved[0]
            start = Gaussian(samples[0].time_ns, states[1], covariances[1])
            samples = samples[1:]
        return replace(self, start=start, samples=samples)._through(_ROUNDS)

    def _through(self, rounds: int) -> MotionWindow:
        """Return the window with the motion by its samples, learning from them in some rounds."""
        solved = self._solutions(rounds, False)
        return replace(self, deviations=solved[0].deviations, solved=solved, mixed={})

    def _solutions(self, rounds: int, smooths: bool) -> tuple[_Solved, ...]:
        """Return the motions by all samples or, not smoothed, by those until each."""
        _, states, informations, gradients = map(np.array, zip(*self.samples, strict=True))
        seconds: Array = np.diff(self.times).astype(np.float64) * 1e-9

        def solved(
            told: tuple[Array, Array], deviations: Array, rounds: int, grown: float
        ) -> _Solved:
            return _Solved(*_solve(
                seconds, states, *told, self.start.state, self.start.covariance,
                np.stack([self.configured, deviations]), self.readout_share, rounds, smooths, grown,
            ))  # fmt: skip

        told = informations, gradients
        found = [solved(told, self.deviations, rounds, 1.0)]
        learnt = found[0].deviations
        found += [solved(told, learnt, 0, grown) for grown in _GROWN]
        for swing in _SWINGS if np.median(seconds) > _SLOW else ():
            swings = swing * np.outer(seconds, self.configured)
            beside = _Swinging.of(states, told, swings)
            found.append(beside.of_images(solved(beside.told, learnt, 0, 1.0)))
        return tuple(found)


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
    added = _added(seconds, deviations, lasting)
    for i in range(6):
        for j in range(6):
            moved = predicted[12 + i] * predicted[12 + j]
            added[i, j] += (readout_share * seconds) ** 2 * moved
    return predicted, transport, added


@entry
def _added(seconds: float, deviations: Array1, lasting: float) -> Array:
    """Return the covariance (18,18) that new accelerations (4,) add, in SI units."""
    unit = singer(abs(seconds), lasting)
    noise = np.zeros((PARAMETERS, PARAMETERS))
    for i in range(3):
        for j in range(3):
            for axis in range(6):
                square = deviations[min(axis, 3)] ** 2
                noise[6 * i + axis, 6 * j + axis] = square * unit[i, j]
    return noise


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
    seconds: Array1, states: Array2, informations: Array3, gradients: Array2, start: Array1,
    start_covariance: Array2, scales: Array2, readout_share: float, rounds: int, smooths: bool,
    grown: float,
) -> tuple[Array, Array, Array, float, float]:  # fmt: skip
    """Filter, learn deviations and perhaps smooth: the fields of :class:`_Solved`.

    Args:
        seconds: (n,) of each transition.
        scales: (2,4) deviations by the settings, and as they are known.
        rounds: of learning.
        smooths: all samples tell of all motions.
        grown: factor of the deviations of the last transitions.
    """
    count, configured, deviations = len(seconds), scales[0], scales[1].copy()
    square, row = (count + 1, PARAMETERS, PARAMETERS), (count + 1, STATE_SIZE)
    predicted, filtered = np.empty(row), np.empty(row)
    added, transports, knowns = np.empty(square), np.empty(square), np.empty(square)
    covariances = np.empty(square)
    while True:
        filtered[0], covariances[0], surprise, evidence = start, start_covariance, 0.0, 0.0
        for k in range(count):
            own = enlarged(deviations, configured, grown if k >= count - _RECENT else 1.0)
            predicted[k], transports[k], added[k] = _predicted(
                filtered[k], seconds[k], own, readout_share, FADING
            )
            spread = transports[k] @ covariances[k] @ transports[k].T + added[k]
            known, narrower = inverse_of(spread)
            covariances[k + 1], left = inverse_of(informations[k] + known)
            right = gradients[k] + known @ step_between(states[k], predicted[k])
            step = covariances[k + 1] @ right
            filtered[k + 1], knowns[k] = apply_step(states[k], step), known
            moved = step_between(predicted[k], filtered[k + 1])
            surprise = np.sum(moved * (known @ moved))
            surprise += np.sum(step * (informations[k] @ step - 2.0 * gradients[k]))
            evidence -= narrower + left + 0.5 * surprise
        if rounds == 0 and not smooths:
            break
        scores, weight = np.zeros((4, 3)), 1.0
        for k in range(count - 1, -1, -1):
            known, after = knowns[k], covariances[k + 1].copy()
            step = step_between(predicted[k], filtered[k + 1])
            pull, spread = known @ step, known - known @ after @ known
            _score(seconds[k], deviations, pull, spread, weight, scores)
            weight *= _FORGETTING
            gain = covariances[k] @ transports[k].T @ known
            filtered[k] = apply_step(filtered[k], gain @ step)
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
    return filtered, covariances, deviations, surprise, evidence


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
    unit, own = singer(seconds, FADING), np.empty((3, 3))
    for axis in range(6):
        place = min(axis, 3)
        variance = deviations[place] ** 2
        for i in range(3):
            for j in range(3):
                own[i, j] = 0.0
                for k in range(3):
                    own[i, j] += variance * unit[i, k] * spread[6 * k + axis, 6 * j + axis]
                squared = pull[6 * i + axis] * pull[6 * j + axis]
                scores[place, 0] += weight * variance * unit[i, j] * squared
            scores[place, 1] += weight * own[i, i]
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
    roots = np.ascontiguousarray(vectors * np.sqrt(np.maximum(1.0 - values, 0.0)))
    half = np.ascontiguousarray(factor) @ roots
    told: Array = (half @ half.T) * units
    return told


def unshaken(estimate: Estimate) -> tuple[Motion, Array, Array, Array]:
    """Return the motion without vibration, both covariances, and the derivative of that motion.

    A camera that shakes is, in the middle row, somewhere on its swing; a frame later it is
    somewhere else on it.
    """
    shake, joint = estimate.shake, estimate.joint_covariance
    swing, jacobian = np.zeros((PARAMETERS, PARAMETERS)), _UNSHAKEN[:, : len(joint)]
    numbers = _numbers(estimate)
    if not len(shake) and len(joint) == PARAMETERS:
        return Motion(**numbers), joint, swing, jacobian
    values, rates = MIDDLE_VALUES[: len(shake)], MIDDLE_RATES[: len(shake)]
    turned = so3.exp(values @ shake)
    still = Motion(**numbers | {
        "rotation": turned @ estimate.rotation, "translation": turned @ estimate.translation,
        "angular_velocity": estimate.angular_velocity - rates @ shake,
    })  # fmt: skip
    squares = np.square(shake).sum(axis=1) / 3.0
    swing[TURN, TURN] = (values**2 @ squares) * np.eye(3)
    swing[ANGULAR, ANGULAR] = (rates**2 @ squares) * np.eye(3)
    covariance = jacobian @ joint @ jacobian.T
    # Pose and turn cancel: what rounding leaves of the difference of two large variances.
    return still, 0.5 * (covariance + covariance.T), swing, jacobian


def gaussian_of(estimate: Estimate, time_ns: int) -> Gaussian:
    """Return the motion of one frame without vibration."""
    motion, covariance, _, _ = unshaken(estimate)
    units, state = estimate.span**-_ORDERS, state_in(motion, _ORIGIN)
    state[12:] *= units[6:]
    return Gaussian(time_ns, state, covariance * np.outer(units, units))


def told_of(
    estimate: Estimate, time_ns: int, known: PriorTerms, rotation: RotationPrior | None = None
) -> MotionSample:
    """Return what the points of an estimate tell of its motion.

    Args:
        known: what was known of that motion before, in the map's frame.
        rotation: beside which that is; None: it is of the whole motion.
    """
    beside = estimate if rotation is None else rotation.beside(estimate)
    motion, covariance, _, _ = unshaken(beside)
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
        return estimate.with_joint_covariance(spread, **_numbers(known), twist_known=True)
    motion, covariance, _, jacobian = unshaken(estimate)
    joint = estimate.joint_covariance
    gain = np.linalg.solve(covariance, jacobian @ joint).T
    step = gain @ step_between(state_in(motion, _ORIGIN), state_in(known, _ORIGIN))
    state = apply_step(state_in(estimate, _ORIGIN), step[:PARAMETERS])
    whole, _ = Gaussian(gaussian.time_ns, state, spread).per_readout(1.0)
    joint = joint + gain @ (spread - covariance) @ gain.T
    return estimate.with_joint_covariance(
        0.5 * (joint + joint.T), **_numbers(whole),
        shake=estimate.shake + step[PARAMETERS:].reshape(-1, 3), twist_known=True,
    )  # fmt: skip


def predicted_estimate(nearest: Estimate, gaussian: Gaussian, swing: Array) -> Estimate:
    """Return the motion between or after frames, with the points of the nearest frame.

    Args:
        swing: (18,18) covariance of the shaking about that motion, per readout.
    """
    motion, covariance = gaussian.per_readout(nearest.span)
    return nearest.with_joint_covariance(
        covariance + swing, **_numbers(motion), shake=np.zeros((0, 3)), time_ns=gaussian.time_ns
    )


def _numbers(motion: Motion) -> dict[str, Array]:
    return {each.name: getattr(motion, each.name) for each in fields(Motion)}
