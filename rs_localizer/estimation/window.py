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

Real accelerations last longer than this model's, and those of noise end at once: a tenth of a
second ahead it claims too small an error for the first and too large a one for the second. So the
motions of the last images are extrapolated to each new one (:class:`PredictionErrors`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np

from rs_localizer.config import Acceleration
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, Array1, Array2, Array3
from rs_localizer.core.rotation_prior import RotationPrior
from rs_localizer.core.shake import MIDDLE_RATES, MIDDLE_VALUES
from rs_localizer.core.shutter import Motion, carried
from rs_localizer.core.state import (
    ANGULAR,
    MOTION_PARAMETERS,
    PARAMETERS,
    STATE_ANGULAR,
    STATE_ANGULAR_ACCELERATION,
    STATE_LINEAR,
    STATE_LINEAR_ACCELERATION,
    STATE_SIZE,
    STATE_TRANSLATION,
    TURN,
    rotation_of,
    step_between,
)
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.prior import PriorTerms, add_prior, state_in
from rs_localizer.estimation.robust import apply_step, inverted
from rs_localizer.native import entry, kernel

LENGTH = 6
"""Frames of the window: at 30 Hz a fifth of a second, in which a hand changes its mind."""
# Time (s) in which accelerations fade. Of 0.1, 0.05 and 0.03 the last one has the least errors of
# turn rates of a phone in a car and of Aria's head, and the most of them inside.
FADING = 0.03
# Below this part of the time of fading the closed form of the noise is rounding errors.
_SHORT = 0.03
# Weight of a transition's score by its age, in transitions.
_FORGETTING = 0.8
# Numbers that must have told of a scale before it follows them halfway.
_DOUBT = 5.0
# How much variances may change in a round, and rounds: by a hundred within two frames.
_LEAST_CHANGE, _MOST_CHANGE, _ROUNDS = 0.2, 25.0, 2
# Of the configured deviations: a tripod's, and that of a blow.
_LEAST_SCALE, _MOST_SCALE = 0.03, 100.0
# Who turns about one axis turns a little about the others: of the largest deviation.
_LEAST_SHARE = 0.3
# Horizons of predictions, as parts of the longest one: at 30 Hz and 0.1 s, one, two, three images.
_KNOTS = np.array([1.0, 2.0, 3.0]) / 3.0
# Weight of the newest image, so that some two dozen images count; weight of the first one.
_NEWEST, _FIRST = 0.08, 0.5
# Largest ratio of squared errors that one image may contribute.
_MOST_RATIO = 20.0
# Smallest factor if the window has learnt its accelerations, and beside an aid, where it has not.
_LEAST, _LEAST_UNLEARNT = 1.0, 0.1
# A factor rests on some twelve independent numbers, so regions follow F(3, 12) instead of
# chi-squared: the ratio of their 95 % bounds.
_FEW = 1.3
# Derivatives of a motion without its vibration by motion and coefficients.
_UNSHAKEN = np.eye(PARAMETERS, PARAMETERS + 3 * len(MIDDLE_VALUES))
_UNSHAKEN[TURN, PARAMETERS:] = -np.kron(MIDDLE_VALUES, np.eye(3))
_UNSHAKEN[ANGULAR, PARAMETERS:] = -np.kron(MIDDLE_RATES, np.eye(3))
_ORIGIN = np.zeros(3)
# Of the readout time in velocities and accelerations, by the places of a step.
_POWERS = -np.repeat([0.0, 0.0, 1.0, 1.0, 2.0, 2.0], 3)


class Gaussian(NamedTuple):
    """A motion at a time; s, m and rad, camera_from_map."""

    time_ns: int
    state: Array  # (24,)
    covariance: Array  # (18,18) of a step


class MotionSample(NamedTuple):
    """Motion of one frame by its points."""

    time_ns: int
    state: Array  # (24,) the frame's estimate
    information: Array  # (18,18)
    gradient: Array  # (18,)


class _Solved(NamedTuple):
    """Filter and smoother of n samples, behind the start (n + 1 rows)."""

    predicted: Array  # (24,) of the last one
    prediction: Array  # (18,18) its covariance
    filtered: Array  # (n+1,24)
    covariances: Array  # (n+1,18,18)
    smoothed: Array  # (n+1,24)
    smoothed_covariances: Array  # (n+1,18,18)
    scores: Array  # (4,3) of the deviations: squared, expected, information


@dataclass(frozen=True, slots=True, eq=False)
class MotionWindow:
    """The last frames with a pose that hang together.

    Args:
        start: the motion of the frame before them, by all frames until then.
        samples: the frames after it.
        deviations: (4,) of accelerations, angular about the camera's axes (rad/s^2) and linear.
        configured: (4,) those of the settings.
        readout_share: deviation of the readout time, as a part of it.
    """

    start: Gaussian
    configured: Array
    deviations: Array
    samples: tuple[MotionSample, ...] = ()
    solved: _Solved | None = None
    readout_share: float = 0.0

    @classmethod
    def begin(
        cls, start: Gaussian, acceleration: Acceleration, readout_share: float = 0.0
    ) -> MotionWindow:
        """Begin with a motion of which no other frame tells."""
        configured = _deviations(acceleration)
        return cls(start, configured, configured.copy(), readout_share=readout_share)

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
        if self.solved is None:
            return 0.0
        solved, sample = self.solved, self.samples[-1]
        moved = step_between(solved.predicted, solved.filtered[-1])
        pulled = step_between(sample.state, solved.filtered[-1])
        squared = moved @ np.linalg.solve(solved.prediction, moved)
        squared += pulled @ (sample.information @ pulled - 2.0 * sample.gradient)
        return float(squared)

    def __len__(self) -> int:
        return len(self.samples) + 1

    def before(self, frames: int) -> Gaussian:
        """Return the motion so many frames before the last one, given all frames."""
        if self.solved is None:
            return self.start
        row = len(self.samples) - frames
        return Gaussian(
            self.times[row], self.solved.smoothed[row], self.solved.smoothed_covariances[row]
        )  # fmt: skip

    def after(self, time_ns: int) -> Gaussian:
        """Return the motion at a time after the last frame."""
        newest = self.newest
        seconds = 1e-9 * (time_ns - newest.time_ns)
        if seconds == 0.0:
            return newest
        state, covariance, _ = _predicted(
            newest.state, newest.covariance, seconds, self.deviations, self.readout_share
        )
        return Gaussian(time_ns, state, covariance)

    def at(self, time_ns: int) -> Gaussian | None:
        """Return the motion at a time, given all frames; None before the first of them."""
        if time_ns < self.start.time_ns:
            return None
        if time_ns >= self.newest.time_ns:
            return self.after(time_ns)
        times = self.times
        if time_ns in times:
            return self.before(len(times) - 1 - times.index(time_ns))
        row = int(np.searchsorted(times, time_ns)) - 1
        neighbour = self.samples[row]
        silent = MotionSample(
            time_ns, neighbour.state, np.zeros((PARAMETERS,) * 2), np.zeros(PARAMETERS)
        )  # fmt: skip
        samples = (*self.samples[:row], silent, *self.samples[row:])
        solved = _solved(self.start, samples, self.deviations, self.readout_share)
        return replace(self, samples=samples, solved=solved).before(len(self.samples) - row)

    def joined(self, sample: MotionSample) -> MotionWindow:
        """Return the window with one more frame, and with learnt accelerations."""
        start, samples = self.start, (*self.samples, sample)
        if len(samples) >= LENGTH:
            assert self.solved is not None
            first, solved = samples[0], self.solved
            start = Gaussian(first.time_ns, solved.filtered[1], solved.covariances[1])
            samples = samples[1:]
        deviations = self.deviations
        for _ in range(_ROUNDS):
            solved = _solved(start, samples, deviations, self.readout_share)
            deviations = self._learnt(deviations, solved.scores)
        solved = _solved(start, samples, deviations, self.readout_share)
        return replace(self, start=start, samples=samples, deviations=deviations, solved=solved)

    def _learnt(self, deviations: Array, scores: Array) -> Array:
        """Return the deviations (4,) that the scores (4,3) prefer."""
        squared, expected, information = scores.T
        ratio = 1.0 + (squared - expected) / (information + _DOUBT)
        changed = deviations * np.sqrt(np.clip(ratio, _LEAST_CHANGE, _MOST_CHANGE))
        changed = np.clip(changed / self.configured, _LEAST_SCALE, _MOST_SCALE) * self.configured
        changed[:3] = np.maximum(changed[:3], _LEAST_SHARE * changed[:3].max())
        learnt: Array = changed
        return learnt


def _solved(
    start: Gaussian, samples: tuple[MotionSample, ...], deviations: Array, readout_share: float
) -> _Solved:
    times = np.array([1e-9 * (sample.time_ns - start.time_ns) for sample in samples])
    return _Solved(
        *_solve(
            times, np.array([sample.state for sample in samples]),
            np.array([sample.information for sample in samples]),
            np.array([sample.gradient for sample in samples]),
            start.state, start.covariance, deviations, readout_share,
        )
    )  # fmt: skip


@entry
def _predicted(
    state: Array1, covariance: Array2, seconds: float, deviations: Array1, readout_share: float
) -> tuple[Array, Array, Array]:
    """State and covariance so much later, and the derivative of the state."""
    numbers = (
        state[:9].copy().reshape(3, 3), state[9:12].copy(), state[12:15].copy(),
        state[15:18].copy(), state[18:21].copy(), state[21:24].copy(),
    )  # fmt: skip
    later, transport = carried(numbers, seconds, FADING)
    predicted = np.concatenate((
        later[0].reshape(9), later[1], later[2], later[3], later[4], later[5],
    ))  # fmt: skip
    spread = transport @ covariance @ transport.T + _added(seconds, deviations)
    for i in range(6):
        for j in range(6):
            moved = predicted[12 + i] * predicted[12 + j]
            spread[i, j] += (readout_share * seconds) ** 2 * moved
    return predicted, spread, transport


@entry
def _added(seconds: float, deviations: Array1) -> Array:
    """Return the covariance (18,18) that new accelerations (4,) add, in SI units."""
    unit = singer(abs(seconds))
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
    units = _per_second(readout_time)
    added: Array = _added(float(dt), _deviations(acceleration)) / np.outer(units, units)
    return added


def _deviations(acceleration: Acceleration) -> Array:
    return np.repeat([float(acceleration.angular), float(acceleration.linear)], (3, 1))


@kernel
def singer(seconds: float) -> Array:
    """Return the covariance (3,3) of way, velocity, acceleration per unit acceleration, SI."""
    x = seconds / FADING
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
    units = (FADING * FADING, FADING, 1.0)
    for i in range(3):
        for j in range(i, 3):
            block[i, j] *= units[i] * units[j]
            block[j, i] = block[i, j]
    return block


@entry
def _solve(
    times: Array1, states: Array2, informations: Array3, gradients: Array2, start: Array1,
    start_covariance: Array2, deviations: Array1, readout_share: float,
) -> tuple[Array, Array, Array, Array, Array, Array, Array]:  # fmt: skip
    """Filter and smoother: the fields of :class:`_Solved`; times (n,) in s after the start."""
    count = len(times)
    square = (count + 1, PARAMETERS, PARAMETERS)
    predicted, filtered = np.empty((count, STATE_SIZE)), np.empty((count + 1, STATE_SIZE))
    predictions, transports, covariances = np.empty(square), np.empty(square), np.empty(square)
    knowns = np.empty(square)  # inverses of the predictions
    filtered[0], covariances[0], time = start, start_covariance, 0.0
    for k in range(count):
        predicted[k], predictions[k], transports[k] = _predicted(
            filtered[k], covariances[k], times[k] - time, deviations, readout_share
        )
        known = knowns[k]
        known[:] = inverted(predictions[k])
        covariances[k + 1] = inverted(informations[k] + known)
        right = gradients[k] + known @ step_between(states[k], predicted[k])
        filtered[k + 1] = apply_step(states[k], covariances[k + 1] @ right)
        time = times[k]
    smoothed, smoothed_covariances = filtered.copy(), covariances.copy()
    scores, weight, block = np.zeros((4, 3)), 1.0, np.empty((3, 3))
    for k in range(count - 1, -1, -1):
        known, after = knowns[k], smoothed_covariances[k + 1]
        step = step_between(predicted[k], smoothed[k + 1])
        pulled, spread = known @ step, known - known @ after @ known
        unit = singer(times[k] - (times[k - 1] if k > 0 else 0.0))
        for axis in range(6):
            place = min(axis, 3)
            variance, total, expected = deviations[place] ** 2, 0.0, 0.0
            for i in range(3):
                for j in range(3):
                    total += variance * unit[i, j] * pulled[6 * i + axis] * pulled[6 * j + axis]
                    block[i, j] = 0.0
                    for m in range(3):
                        shared = spread[6 * m + axis, 6 * j + axis]
                        block[i, j] += variance * unit[i, m] * shared
                expected += block[i, i]
            scores[place, 0] += weight * total
            scores[place, 1] += weight * expected
            scores[place, 2] += weight * np.sum(block * block.T)
        weight *= _FORGETTING
        gain = covariances[k] @ transports[k].T @ known
        smoothed[k] = apply_step(filtered[k], gain @ step)
        whole = covariances[k] + gain @ (after - predictions[k]) @ gain.T
        smoothed_covariances[k] = 0.5 * (whole + whole.T)
    return (
        predicted[-1], predictions[count - 1], filtered, covariances, smoothed,
        smoothed_covariances, scores,
    )  # fmt: skip


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
    if not len(shake) and len(joint) == PARAMETERS:
        still = Motion(
            estimate.rotation, estimate.translation, estimate.angular_velocity,
            estimate.linear_velocity, angular_acceleration=estimate.angular_acceleration,
            linear_acceleration=estimate.linear_acceleration,
        )  # fmt: skip
        return still, joint, swing, jacobian
    values, rates = MIDDLE_VALUES[: len(shake)], MIDDLE_RATES[: len(shake)]
    turned = so3.exp(values @ shake)
    still = Motion(
        turned @ estimate.rotation, turned @ estimate.translation,
        estimate.angular_velocity - rates @ shake, estimate.linear_velocity,
        angular_acceleration=estimate.angular_acceleration,
        linear_acceleration=estimate.linear_acceleration,
    )  # fmt: skip
    squares = np.square(shake).sum(axis=1) / 3.0
    swing[TURN, TURN] = (values**2 @ squares) * np.eye(3)
    swing[ANGULAR, ANGULAR] = (rates**2 @ squares) * np.eye(3)
    covariance = jacobian @ joint @ jacobian.T
    # Pose and turn cancel: what rounding leaves of the difference of two large variances.
    return still, 0.5 * (covariance + covariance.T), swing, jacobian


def _per_second(span: float) -> Array:
    """Step (18,) per second of one per readout."""
    units: Array = span**_POWERS
    return units


def _state(motion: Motion, units: Array) -> Array:
    state: Array = state_in(motion, _ORIGIN)
    state[12:] *= units[6:]
    return state


def gaussian_of(estimate: Estimate, time_ns: int) -> Gaussian:
    """Return the motion of one frame without vibration."""
    motion, covariance, _, _ = unshaken(estimate)
    units = _per_second(estimate.span)
    return Gaussian(time_ns, _state(motion, units), covariance * np.outer(units, units))


def motion_of(gaussian: Gaussian, span: float) -> tuple[Motion, Array]:
    """Return the motion and its covariance (18,18), per readout of ``span`` s."""
    units = 1.0 / _per_second(span)
    state = gaussian.state.copy()
    state[12:] *= units[6:]
    motion = Motion(
        rotation_of(state).copy(), state[STATE_TRANSLATION], state[STATE_ANGULAR],
        state[STATE_LINEAR], angular_acceleration=state[STATE_ANGULAR_ACCELERATION],
        linear_acceleration=state[STATE_LINEAR_ACCELERATION],
    )  # fmt: skip
    return motion, gaussian.covariance * np.outer(units, units)


def told_of(estimate: Estimate, known: PriorTerms) -> MotionSample:
    """Return what the points of an estimate tell of its motion, per readout.

    ``known`` is what was known of that motion before, in the map's frame.
    """
    motion, covariance, _, _ = unshaken(estimate)
    information, slope = np.zeros((PARAMETERS,) * 2), np.zeros(PARAMETERS)
    state = state_in(motion, _ORIGIN)
    add_prior(known, state, 1.0, information, slope)
    return MotionSample(estimate.time_ns, state, _told_by_points(covariance, information), slope)


def sample_of(
    estimate: Estimate, time_ns: int, known: PriorTerms, rotation: RotationPrior | None = None
) -> MotionSample:
    """Sample by the points of an estimate, beside what was known of its motion before.

    Args:
        known: that, in the map's frame.
        rotation: beside which it is; None: it is the whole motion.
    """
    told = told_of(estimate if rotation is None else rotation.beside(estimate), known)
    state, information, slope = told.state.copy(), told.information, told.gradient
    if rotation is not None:
        state[STATE_ANGULAR] += rotation.smooth_rate
        state[STATE_ANGULAR_ACCELERATION] += rotation.change
    units = _per_second(estimate.span)
    state[12:] *= units[6:]
    return MotionSample(time_ns, state, information / np.outer(units, units), slope / units)


def estimate_at(estimate: Estimate, gaussian: Gaussian) -> Estimate:
    """Return a frame's estimate with the window's motion; residuals stay as they were.

    What shakes beside the motion goes along as far as the frame's covariance ties it to it.
    """
    motion, covariance, _, jacobian = unshaken(estimate)
    known, spread = motion_of(gaussian, estimate.span)
    joint = estimate.joint_covariance
    gain = np.linalg.solve(covariance, jacobian @ joint).T
    step = gain @ step_between(state_in(motion, _ORIGIN), state_in(known, _ORIGIN))
    state = apply_step(state_in(estimate, _ORIGIN), step[:PARAMETERS])
    joint = joint + gain @ (spread - covariance) @ gain.T
    return estimate.with_joint_covariance(
        0.5 * (joint + joint.T),
        rotation=rotation_of(state).copy(),
        translation=state[STATE_TRANSLATION],
        angular_velocity=state[STATE_ANGULAR],
        linear_velocity=state[STATE_LINEAR],
        angular_acceleration=state[STATE_ANGULAR_ACCELERATION],
        linear_acceleration=state[STATE_LINEAR_ACCELERATION],
        shake=estimate.shake + step[PARAMETERS:].reshape(-1, 3),
        twist_known=True,
    )


def predicted_estimate(nearest: Estimate, gaussian: Gaussian, swing: Array) -> Estimate:
    """Return the motion between or after frames, with the points of the nearest frame.

    Args:
        swing: (18,18) covariance of the shaking about that motion, per readout.
    """
    motion, covariance = motion_of(gaussian, nearest.span)
    return nearest.with_joint_covariance(
        covariance + swing,
        **{each.name: getattr(motion, each.name) for each in fields(Motion)},
        shake=np.zeros((0, 3)),
        time_ns=gaussian.time_ns,
    )


def errors_ahead(window: MotionWindow, found: Estimate, swing: Array) -> Array:
    """Return squared errors (4,), over the claimed ones, of the motion predicted for an image.

    Of turn, place, angular and linear velocity; 1 is as claimed, NaN without a covariance.

    Args:
        window: of the images until one before it.
        found: its estimate, with the time.
        swing: (18,18) covariance of the shaking about the predicted motion, per readout.
    """
    assert found.time_ns is not None
    motion, covariance = motion_of(window.after(found.time_ns), found.span)
    step = step_between(state_in(motion, _ORIGIN), state_in(found, _ORIGIN))
    claimed = covariance + swing
    second = found.joint_covariance[:PARAMETERS, :PARAMETERS] + np.outer(step, step)
    ratios: Array = _ratios(claimed, second)
    return ratios


@entry
def _ratios(claimed: Array2, second: Array2) -> Array:
    """Return second moments of steps over what was claimed (18,18), for each of four parts."""
    ratios = np.empty(4)
    for part in range(4):
        first = 3 * part
        known = inverted(claimed[first : first + 3, first : first + 3].copy())
        ratios[part] = np.sum(known * second[first : first + 3, first : first + 3]) / 3.0
    return ratios


class PredictionErrors:
    """Factors of the variances of predictions ahead of the images, learnt from the last ones.

    Each horizon has a factor for rotation, position, angular and linear velocity. Let ``e`` be the
    step from prediction to estimate, ``P`` and ``C`` their covariances. The expected squared error,
    given the image, over the claimed one is ``(e' P^-1 e + tr(P^-1 C)) / 3``.

    Args:
        longest: s ahead, at most.
    """

    def __init__(self, longest: float) -> None:
        self._longest = longest
        self.reset()

    def reset(self) -> None:
        """Forget all images so far."""
        self._factors = np.ones((len(_KNOTS), 4))
        self._told = np.zeros(len(_KNOTS))  # images that tell of each
        self._least = _LEAST
        # When each of the last images was, the motion until then, and the shaking about it.
        self._past: list[tuple[int, MotionWindow, Array]] = []

    def add(self, found: Estimate, window: MotionWindow, swing: Array) -> None:
        """Compare what was predicted for an image, and predict from it.

        Args:
            found: its estimate.
            window: of the motion, until then.
            swing: (18,18) covariance of the shaking about that motion, per readout.
        """
        if self._longest <= 0.0:
            return
        self._least = _LEAST if not found.aided else _LEAST_UNLEARNT
        apart, kept = math.inf, []  # s since the newest of the past
        for past in self._past:
            seconds = 1e-9 * (found.time_ns - past[0])
            if 0.0 < seconds <= 1.2 * self._longest:
                apart = seconds
                kept.append(past)
                self._learn(apart, errors_ahead(past[1], found, past[2]))
        if apart > 0.45 * _KNOTS[0] * self._longest:
            kept.append((found.time_ns, window, swing))
        self._past = kept

    def _learn(self, seconds: float, ratios: Array) -> None:
        if not np.isfinite(ratios).all():  # rounding errors are all that is left of a covariance
            return
        # Copies of this object keep theirs.
        self._told, self._factors = self._told.copy(), self._factors.copy()
        place = np.clip(seconds / self._longest, _KNOTS[0], _KNOTS[-1])
        for k, weight in enumerate(np.maximum(1.0 - np.abs(place - _KNOTS) / _KNOTS[0], 0.0)):
            if weight > 0.0:
                self._told[k] += weight
                newest = min(max(_NEWEST * weight, weight / (1.0 + self._told[k])), _FIRST)
                self._factors[k] += newest * (np.minimum(ratios, _MOST_RATIO) - self._factors[k])

    def widened(self, predicted: Estimate, seconds: float) -> Estimate:
        """Widen the covariance of a prediction this many s ahead by the errors of earlier ones."""
        told = self._told > 0.0
        if not told.any():
            return predicted
        horizons = self._longest * _KNOTS[told]
        factors = [np.interp(seconds, horizons, of) for of in self._factors[told].T]
        scale = np.ones(PARAMETERS)
        scale[:MOTION_PARAMETERS] = np.repeat(np.sqrt(_FEW * np.maximum(factors, self._least)), 3)
        covariance = predicted.joint_covariance * np.outer(scale, scale)
        return replace(predicted, joint_covariance=covariance)
