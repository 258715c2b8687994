# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Factors beside keypoints: priors of the motion and of other unknowns, a gyroscope's samples.

Accelerations have zero mean. With a memory, neighbouring ones are those of a first-order Markov
process (Singer, see :mod:`rs_localizer.tracking`): what counts is by how much one is not what the
one before lets expect. In the gyroscope's axes ``e = M rate(t + delay) + bias - measured``: the
noise of the samples must not stand beside what is estimated of ``M``, which it would make smaller.
"""

import math
from itertools import pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.tools.adjust.spline import Spline
from rs_localizer.tools.adjust.spline_kernels import CONTROL, LOCAL
from rs_localizer.tools.adjust.system import Quadratic, Rows
from rs_localizer.tools.adjust.variables import DELAY, MOUNT, Freedom, GyroSamples, Unknowns

# The whole may float so far while it is adjusted, by its size: loose enough to cost nothing.
_FLOAT = 1e-3


def known(offset: Array, information: Array, first: int) -> Quadratic:
    """Return the prior of numbers (k,) of the border, from ``first`` on, with these offsets."""
    slope = information @ offset
    columns = np.arange(first, first + len(offset))
    return Quadratic(columns, information, slope, float(offset @ slope))


def block_rows(offsets: Array, deviations: Array, first: int) -> Rows:
    """Return priors of blocks (b,w) of unknowns, from ``first`` on, with deviations (b,)."""
    count, width = offsets.shape
    values = np.eye(width) / deviations[:, None, None]
    errors = offsets / deviations[:, None]
    columns = first + np.arange(count * width).reshape(count, width)
    return Rows(values, np.zeros(count, np.int64), columns, errors, float(np.sum(errors**2)))


class Floating:
    """Seven directions in which map and motion move as a whole, held by the controls' start."""

    def __init__(self, start: Spline) -> None:
        self._start = start
        self._arms = start.positions - start.positions.mean(axis=0)
        self._squared = max(float(np.sum(self._arms**2)), 1e-12)
        size = np.sqrt(self._squared / len(self._arms))
        self._weights = 1.0 / (_FLOAT * np.array([size, size, size, 1.0, 1.0, 1.0, 1.0]))

    def rows(self, spline: Spline) -> Rows:
        """Return rows of mean shift, mean rotation and relative size."""
        count = len(spline.positions)
        shift = spline.positions - self._start.positions
        turned = spline.rotations @ np.swapaxes(self._start.rotations, 1, 2)
        turns = Rotation.from_matrix(turned).as_rotvec()
        size = np.sum(self._arms * shift) / self._squared
        errors = np.concatenate([shift.mean(axis=0), turns.mean(axis=0), [size]]) * self._weights
        by = np.zeros((count, 6, 7))
        by[:, 3:, :3] = np.eye(3) / count
        by[:, :3, 3:6] = np.swapaxes(spline.rotations, 1, 2) / count
        by[:, 3:, 6] = self._arms / self._squared
        values = np.ascontiguousarray((by.reshape(-1, 7) * self._weights).T)[None]
        none = np.zeros((1, 0), np.int64)
        return Rows(values, np.zeros(1, np.int64), none, errors[None], float(errors @ errors))


def acceleration_rows(spline: Spline, expected: Freedom) -> Rows:
    """Return six rows for each control with an acceleration: rotations, then positions."""
    spacing, fading = spline.layout.spacing, expected.fading
    # Controls with an acceleration (k,), and 1 for the first one of a stretch, else 0.
    ends = pairwise(spline.layout.firsts.tolist())
    parts = [np.arange(first + 1, last - 1) for first, last in ends]
    at = np.concatenate(parts)
    begins = np.concatenate([np.arange(len(part)) == 0 for part in parts]).astype(np.int64)
    vectors, inverses = spline.steps()
    first = at - 2 + begins
    values, errors = np.zeros((len(at), 6, LOCAL)), np.zeros((len(at), 6))
    memory = np.where(begins, 0.0, math.exp(-spacing / fading) if fading > 0.0 else 0.0)
    rows, axes = np.arange(len(at)), np.arange(3)
    for back in (0, 1):
        share = -memory if back else np.ones(len(at))
        used = np.flatnonzero(share)
        k, own, scale = at[used] - back, rows[used], share[used, None]
        before, after = inverses[k], inverses[k + 1]
        way = spline.positions[k - 1] - 2.0 * spline.positions[k] + spline.positions[k + 1]
        errors[used, :3] += scale * (vectors[k + 1] - vectors[k])
        errors[used, 3:] += scale * way
        by_turn = (before.swapaxes(1, 2), -before - after.swapaxes(1, 2), after)
        for place, by in enumerate(by_turn):
            columns = (CONTROL * (k - 1 + place - first[used]))[:, None] + axes
            turned = own[:, None, None], axes[:, None], columns[:, None]
            values[turned] += scale[:, :, None] * by
            values[own[:, None], 3 + axes, columns + 3] += scale * (-2.0 if place == 1 else 1.0)
    usual = spacing**2 * np.sqrt(1.0 - memory**2)
    sizes = np.array([expected.angular_acceleration, expected.linear_acceleration])
    weights = np.repeat(1.0 / sizes, 3) / usual[:, None]
    errors *= weights
    values *= weights[:, :, None]
    none = np.zeros((len(at), 0), np.int64)
    return Rows(values, CONTROL * first, none, errors, float(np.sum(errors**2)))


def rest_rows(spline: Spline, angular: float, linear: float) -> Rows:
    """Return rows of zero-mean velocities (rad/s, m/s) in stretches of a single interval."""
    at = spline.layout.alone()
    vectors, inverses = spline.steps()
    values, errors = np.zeros((len(at), 6, 2 * CONTROL)), np.zeros((len(at), 6))
    errors[:, :3] = vectors[at + 1]
    errors[:, 3:] = spline.positions[at + 1] - spline.positions[at]
    values[:, :3, :3] = -inverses[at + 1].swapaxes(1, 2)
    values[:, :3, 6:9] = inverses[at + 1]
    values[:, 3:, 3:6], values[:, 3:, 9:] = -np.eye(3), np.eye(3)
    weights = 1.0 / (spline.layout.spacing * np.repeat([angular, linear], 3))
    errors *= weights
    none = np.zeros((len(at), 0), np.int64)
    return Rows(values * weights[:, None], CONTROL * at, none, errors, float(np.sum(errors**2)))


# Standard deviations of a first guess of rotation (rad), bias (rad/s) and delay (s): nearly no
# prior, but numbers that the motion does not determine stay in place. Scales and angles of consumer
# gyroscopes are good to some percent.
MOUNT_DEVIATIONS = np.repeat([1.0, 1.0, 0.5, 0.03], (3, 3, 1, 6))
_LIMIT = 6.0  # of Tukey's weight, in standard deviations
# Samples nearer (s) to the edge of the motion are left out: the delay may yet change.
_MARGIN = 0.02
# Median of the squared length of three standard Gaussian numbers.
_MEDIAN = 2.366


class Gyroscope:
    """The samples of a gyroscope.

    Args:
        samples: with the deviation of their noise.
        start: with a first guess of the mount.
    """

    def __init__(self, samples: GyroSamples, start: Unknowns) -> None:
        assert start.mount is not None
        delay = start.mount.delay
        self.samples = samples.subset(samples.covered(start.spline.layout, delay, _MARGIN))
        self.start = start.mount

    def _linearized(self, state: Unknowns) -> tuple[IntArray, Array, Array]:
        """Return first controls (k,), derivatives (k,3,24 + 13) and errors (k,3) of the samples."""
        mount = state.mount
        assert mount is not None
        times = self.samples.times + mount.delay
        states = state.spline.states(times)
        first, jacobians = state.spline.jacobians(times)
        turned = states.angular @ mount.camera_from_imu
        by_mount = np.empty((len(first), 3, MOUNT))
        by_mount[:, :, :3] = mount.matrix @ mount.camera_from_imu @ so3.hat(turned)
        by_mount[:, :, 3:6] = np.eye(3)
        by_mount[:, :, DELAY] = states.angular_acceleration @ mount.matrix.T
        by_mount[:, :, DELAY + 1 :] = by_shape(turned)
        by_all = np.concatenate([mount.matrix @ jacobians[:, 6:9], by_mount], axis=2)
        return first, by_all, self._errors(state)

    def _errors(self, state: Unknowns) -> Array:
        mount = state.mount
        assert mount is not None
        rates = state.spline.states(self.samples.times + mount.delay).angular
        return np.asarray(rates @ mount.matrix.T + mount.bias - self.samples.rates)

    def noise(self, state: Unknowns) -> float:
        """Return the standard deviation of an axis (rad/s), by the errors' median."""
        squared = np.sum(np.square(self._errors(state)), axis=1)
        return float(np.sqrt(np.median(squared) / _MEDIAN))

    def terms(self, state: Unknowns, column: int) -> list[Rows | Quadratic]:
        """Return rows of samples with Tukey's weights, and priors of the mount from a column on."""
        first, values, errors = self._linearized(state)
        deviation, squared = self.samples.deviation, np.sum(np.square(errors), axis=1)
        rest = np.maximum(1.0 - squared / (_LIMIT * deviation) ** 2, 0.0)
        weights = rest[:, None] / deviation
        columns = np.tile(np.arange(column, column + MOUNT), (len(first), 1))
        cost = float(np.sum(1.0 - rest**3)) * _LIMIT**2 / 3.0
        assert state.mount is not None
        information = np.diag(MOUNT_DEVIATIONS**-2.0)
        return [
            Rows(weights[:, :, None] * values, CONTROL * first, columns, weights * errors, cost),
            known(state.mount.beside(self.start), information, column),
        ]


def by_shape(rates: Array) -> Array:
    """Return the derivative (k,3,6) of ``shape rate`` by the six numbers of a symmetric matrix."""
    out = np.zeros((len(rates), 3, 6))
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        out[:, axis, axis] = rates[:, axis]
        for one, other in (others, others[::-1]):  # the entry beside the diagonal without this axis
            out[:, one, 3 + axis] = rates[:, other]
    return out
