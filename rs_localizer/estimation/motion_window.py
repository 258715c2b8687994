# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The motion over the last frames: one trajectory, whose accelerations' deviations are learnt.

Frames are samples of a trajectory whose accelerations fade while new ones come
(:mod:`rs_localizer.estimation.motion_model`). A frame's points, beside what was known before, give
a Gaussian ``exp(-d' L d / 2 + g' d)`` of the step ``d`` from the frame's estimate. A filter runs
forward through the window, and a smoother back (Rauch et al., "Maximum likelihood estimates of
linear dynamic systems", 1965).

``P`` is the covariance of the prediction, to which the transition adds ``Q`` for the accelerations
of one axis. ``x`` is the smoothed step from the prediction, and ``V`` its covariance. The score of
the variance of these accelerations is

    e' Q e - tr(Q M),      e = P^-1 x,      M = cov(e) = P^-1 - P^-1 V P^-1.

A variance ``r`` times as large makes it ``(r - 1) tr(Q M Q M)`` in the mean. So the scales of a
tripod, of a hand and of a car are found within a few frames, from below and from above.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np

from rs_localizer.config import Acceleration
from rs_localizer.core.arrays import Array, Array1, Array2, Array3
from rs_localizer.core.shutter import Motion, carried
from rs_localizer.core.state import (
    PARAMETERS,
    STATE_ANGULAR,
    STATE_ANGULAR_ACCELERATION,
    STATE_LINEAR,
    STATE_LINEAR_ACCELERATION,
    STATE_SIZE,
    STATE_TRANSLATION,
    rotation_of,
    step_between,
)
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.motion_model import FADING, mean_turn, singer, unshaken
from rs_localizer.estimation.prior import PriorTerms, add_prior, state_in
from rs_localizer.estimation.refine import apply_step, inverted
from rs_localizer.native import entry, kernel

LENGTH = 6
"""Frames of the window: at 30 Hz a fifth of a second, in which a hand changes its mind."""
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
    predicted: Array  # (n,24)
    predictions: Array  # (n,18,18) their covariances
    transports: Array  # (n,18,18) from the sample before
    filtered: Array  # (n,24)
    covariances: Array  # (n,18,18)
    smoothed: Array  # (n,24)
    smoothed_covariances: Array  # (n,18,18)
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
        configured = np.repeat([acceleration.angular, acceleration.linear], (3, 1)).astype(float)
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
        moved = step_between(solved.predicted[-1], solved.filtered[-1])
        pulled = step_between(sample.state, solved.filtered[-1])
        squared = moved @ np.linalg.solve(solved.predictions[-1], moved)
        squared += pulled @ (sample.information @ pulled - 2.0 * sample.gradient)
        return float(squared)

    def __len__(self) -> int:
        return len(self.samples) + 1

    def before(self, frames: int) -> Gaussian:
        """Return the motion so many frames before the last one, given all frames."""
        if self.solved is None:
            return self.start
        row = len(self.samples) - 1 - frames
        if row < 0:
            return self._smoothed_start()
        solved = self.solved
        return Gaussian(
            self.samples[row].time_ns, solved.smoothed[row], solved.smoothed_covariances[row]
        )  # fmt: skip

    def after(self, time_ns: int) -> Gaussian:
        """Return the motion at a time after the last frame."""
        return _moved(self.newest, time_ns, self.deviations, self.readout_share)

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
            start = Gaussian(first.time_ns, solved.filtered[0], solved.covariances[0])
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

    def _smoothed_start(self) -> Gaussian:
        solved, start = self.solved, self.start
        assert solved is not None
        return Gaussian(
            start.time_ns,
            *_back(
                start.state, start.covariance, solved.predicted[0], solved.predictions[0],
                inverted(solved.predictions[0]), solved.transports[0], solved.smoothed[0],
                solved.smoothed_covariances[0],
            ),
        )  # fmt: skip


def _moved(motion: Gaussian, time_ns: int, deviations: Array, readout_share: float) -> Gaussian:
    seconds = 1e-9 * (time_ns - motion.time_ns)
    if seconds == 0.0:
        return motion
    state, covariance, _ = _predicted(
        motion.state, motion.covariance, seconds, deviations, readout_share
    )
    return Gaussian(time_ns, state, covariance)


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
    predicted = np.empty(STATE_SIZE)
    for i in range(3):
        for j in range(3):
            predicted[3 * i + j] = later[0][i, j]
        predicted[9 + i], predicted[12 + i], predicted[15 + i] = (
            later[1][i],
            later[2][i],
            later[3][i],
        )
        predicted[18 + i], predicted[21 + i] = later[4][i], later[5][i]
    spread = transport @ covariance @ transport.T + _noise(seconds, deviations)
    for i in range(6):
        for j in range(6):
            moved = predicted[12 + i] * predicted[12 + j]
            spread[i, j] += (readout_share * seconds) ** 2 * moved
    return predicted, spread, transport


@kernel
def _noise(seconds: float, deviations: Array) -> Array:
    """Return the covariance (18,18) that new accelerations add."""
    unit = singer(abs(seconds))
    noise = np.zeros((PARAMETERS, PARAMETERS))
    for i in range(3):
        for j in range(3):
            for axis in range(6):
                square = deviations[min(axis, 3)] ** 2
                noise[6 * i + axis, 6 * j + axis] = square * unit[i, j]
    return noise


@entry
def _back(
    state: Array1, covariance: Array2, predicted: Array1, prediction: Array2, known: Array2,
    transport: Array2, smoothed: Array1, smoothed_covariance: Array2,
) -> tuple[Array, Array]:  # fmt: skip
    """Smooth a filtered motion with the next sample's smoothed one.

    ``known``: (18,18) inverse of the prediction's covariance.
    """
    gain = covariance @ transport.T @ known
    back = apply_step(state, gain @ step_between(predicted, smoothed))
    spread = covariance + gain @ (smoothed_covariance - prediction) @ gain.T
    return back, 0.5 * (spread + spread.T)


@entry
def _solve(
    times: Array1, states: Array2, informations: Array3, gradients: Array2, start: Array1,
    start_covariance: Array2, deviations: Array1, readout_share: float,
) -> tuple[Array, Array, Array, Array, Array, Array, Array, Array]:  # fmt: skip
    """Filter and smoother: the fields of :class:`_Solved`; times (n,) in s after the start."""
    count = len(times)
    square = (count, PARAMETERS, PARAMETERS)
    predicted, filtered = np.empty((count, STATE_SIZE)), np.empty((count, STATE_SIZE))
    predictions, transports, covariances = np.empty(square), np.empty(square), np.empty(square)
    knowns = np.empty(square)  # inverses of the predictions
    state, covariance, time = start, start_covariance, 0.0
    for k in range(count):
        predicted[k], predictions[k], transports[k] = _predicted(
            state, covariance, times[k] - time, deviations, readout_share
        )
        known = knowns[k]
        known[:] = inverted(predictions[k])
        covariances[k] = inverted(informations[k] + known)
        right = gradients[k] + known @ step_between(states[k], predicted[k])
        filtered[k] = apply_step(states[k], covariances[k] @ right)
        state, covariance, time = filtered[k], covariances[k], times[k]
    smoothed, smoothed_covariances = filtered.copy(), covariances.copy()
    scores = np.zeros((4, 3))
    weight, block, unit = 1.0, np.empty((3, 3)), np.empty((3, 3))
    for k in range(count - 1, -1, -1):
        known = knowns[k]
        pulled = known @ step_between(predicted[k], smoothed[k])
        spread = known - known @ smoothed_covariances[k] @ known
        unit[:] = singer(times[k] - (times[k - 1] if k > 0 else 0.0))
        for axis in range(6):
            place, total, expected = min(axis, 3), 0.0, 0.0
            for i in range(3):
                for j in range(3):
                    added = deviations[place] ** 2 * unit[i, j]
                    total += added * pulled[6 * i + axis] * pulled[6 * j + axis]
                    block[i, j] = 0.0
                    for m in range(3):
                        shared = deviations[place] ** 2 * unit[i, m]
                        block[i, j] += shared * spread[6 * m + axis, 6 * j + axis]
                expected += block[i, i]
            scores[place, 0] += weight * total
            scores[place, 1] += weight * expected
            for i in range(3):
                for j in range(3):
                    scores[place, 2] += weight * block[i, j] * block[j, i]
        weight *= _FORGETTING
        if k > 0:
            smoothed[k - 1], smoothed_covariances[k - 1] = _back(
                filtered[k - 1], covariances[k - 1], predicted[k], predictions[k], knowns[k],
                transports[k], smoothed[k], smoothed_covariances[k],
            )  # fmt: skip
    return (
        predicted, predictions, transports, filtered, covariances, smoothed,
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
    root = np.empty_like(whole)
    for k in range(len(values)):
        root[:, k] = vectors[:, k] * np.sqrt(max(1.0 - values[k], 0.0))
    half = np.ascontiguousarray(factor) @ root
    told: Array = (half @ half.T) * units
    return told


def _per_second(span: float) -> Array:
    """Step (18,) per second of one per readout."""
    units: Array = np.repeat(1.0 / span ** np.array([0, 0, 1, 1, 2, 2]), 3)
    return units


def _state(motion: Motion, units: Array) -> Array:
    state: Array = state_in(motion, np.zeros(3))
    state[12:] *= units[6:]
    return state


def gaussian_of(estimate: Estimate, time_ns: int) -> Gaussian:
    """Return the motion of one frame without vibration and without a gyroscope's rotation."""
    motion, covariance, _, _ = unshaken(estimate)
    if estimate.turn is not None:
        mean, spread = mean_turn(estimate.turn)
        motion = replace(motion, angular_velocity=motion.angular_velocity + mean)
        covariance = covariance + spread
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
    """Return what the points of an estimate tell of its motion, per readout, beside its turn.

    ``known`` is what was known of that motion before, in the map's frame.
    """
    motion, covariance, _, _ = unshaken(estimate)
    information, slope = np.zeros((PARAMETERS,) * 2), np.zeros(PARAMETERS)
    state = state_in(motion, np.zeros(3))
    add_prior(known, state, 1.0, information, slope)
    return MotionSample(estimate.time_ns, state, _told_by_points(covariance, information), slope)


def sample_of(estimate: Estimate, time_ns: int, known: PriorTerms) -> MotionSample:
    """Sample by the points of an estimate, beside what was known of its motion before.

    Args:
        known: that, in the map's frame; of an estimate with a gyroscope beside the known turn.
    """
    told = told_of(estimate, known)
    state, information, slope = told.state.copy(), told.information, told.gradient
    if estimate.turn is not None:
        mean, spread = mean_turn(estimate.turn)
        state[STATE_ANGULAR] += mean
        # (L^-1 + spread)^-1 of what is not known for sure.
        left = np.linalg.inv(np.eye(PARAMETERS) + information @ spread)
        information, slope = left @ information, left @ slope
        information = 0.5 * (information + information.T)
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
    origin = np.zeros(3)
    step = gain @ step_between(state_in(motion, origin), state_in(known, origin))
    state = apply_step(state_in(estimate, origin), step[:PARAMETERS])
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
        turn=None,
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
    newest = window.newest
    ratios: Array = _errors_ahead(
        newest.state, newest.covariance, 1e-9 * (found.time_ns - newest.time_ns),
        window.deviations, window.readout_share, _per_second(found.span), swing,
        state_in(found, np.zeros(3)), np.ascontiguousarray(found.joint_covariance),
    )  # fmt: skip
    return ratios


@entry
def _errors_ahead(
    state: Array1, covariance: Array2, seconds: float, deviations: Array1, readout_share: float,
    units: Array1, swing: Array2, found: Array1, joint: Array2,
) -> Array:  # fmt: skip
    later, spread, _ = _predicted(state, covariance, seconds, deviations, readout_share)
    for k in range(6, PARAMETERS):
        later[6 + k] /= units[k]
    step, ratios, block = step_between(later, found), np.zeros(4), np.empty((3, 3))
    for part in range(4):
        first = 3 * part
        for i in range(3):
            for j in range(3):
                row, column = first + i, first + j
                claimed = spread[row, column] / (units[row] * units[column])
                block[i, j] = claimed + swing[row, column]
        known = inverted(block)
        for i in range(3):
            for j in range(3):
                row, column = first + i, first + j
                second = joint[row, column] + step[row] * step[column]
                ratios[part] += known[i, j] * second / 3.0
    return ratios
