# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A gyroscope's samples as a part of the trajectory's cost.

In the gyroscope's axes ``e = M rate(t + delay) + bias - measured``: the noise of the samples must
not stand beside what is estimated of ``M``, which it would make smaller.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.simd.jit import kernel
from rs_localizer.trajectory.gyro import (
    DELAY,
    MOUNT,
    MOUNT_DEVIATIONS,
    GyroMount,
    GyroSamples,
)
from rs_localizer.trajectory.model import State
from rs_localizer.trajectory.normal_kernels import Normal
from rs_localizer.trajectory.spline_kernels import CONTROL, LOCAL


class Turns(NamedTuple):
    """Samples on the spline."""

    first: IntArray  # (k,) first of the four controls
    errors: Array  # (k,3) rad/s, in the gyroscope's axes
    by_controls: Array  # (k,3,24)
    by_mount: Array  # (k,3,13)


@kernel
def accumulate_turns(turns: Turns, column: int, variance: float, limit: float,
                     normal: Normal) -> float:  # fmt: skip
    """Add the samples to the normal equations; returns their cost.

    Args:
        column: of the border, where the mount begins.
        variance: (rad/s)^2, of the noise of an axis.
        limit: (rad/s)^2, where Tukey's weight ends.
    """
    cost = 0.0
    for n in range(len(turns.first)):
        error, rows, border = turns.errors[n], turns.by_controls[n], turns.by_mount[n]
        squared = error[0] * error[0] + error[1] * error[1] + error[2] * error[2]
        rest = 1.0 - squared / limit
        if not rest > 0.0:
            cost += limit / (3.0 * variance)
            continue
        cost += (1.0 - rest * rest * rest) * limit / (3.0 * variance)
        weight = rest * rest / variance
        base = CONTROL * turns.first[n]
        for a in range(LOCAL):
            if a % CONTROL >= 3:
                continue  # the rate does not depend on positions
            x, y, z = weight * rows[0, a], weight * rows[1, a], weight * rows[2, a]
            normal.slope[base + a] += x * error[0] + y * error[1] + z * error[2]
            for b in range(a + 1):
                if b % CONTROL < 3:
                    normal.band[a - b, base + b] += x * rows[0, b] + y * rows[1, b] + z * rows[2, b]
            for k in range(MOUNT):
                normal.cross[base + a, column + k] += (
                    x * border[0, k] + y * border[1, k] + z * border[2, k]
                )
        for k in range(MOUNT):
            x, y, z = weight * border[0, k], weight * border[1, k], weight * border[2, k]
            normal.border_slope[column + k] += x * error[0] + y * error[1] + z * error[2]
            for j in range(k + 1):
                normal.corner[column + k, column + j] += (
                    x * border[0, j] + y * border[1, j] + z * border[2, j]
                )
    return cost


_LIMIT = 6.0  # of Tukey's weight, in standard deviations
# Samples nearer (s) to the edge of the motion are left out: the delay may yet change.
_MARGIN = 0.02
# Median of the squared length of three standard Gaussian numbers.
_MEDIAN = 2.366


class GyroTerms:
    """The cost of a gyroscope's errors.

    Args:
        samples: with the deviation of their noise.
        start: with a first guess of the mount.
        column: of the border, where the numbers of the mount begin.
    """

    def __init__(self, samples: GyroSamples, start: State, column: int) -> None:
        assert start.mount is not None
        delay = start.mount.delay
        self.samples = samples.subset(samples.covered(start.spline.layout, delay, _MARGIN))
        self.start, self.column = start.mount, column

    def look(self, state: State) -> Turns:
        """The samples on the spline."""
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
        errors = states.angular @ mount.matrix.T + mount.bias - self.samples.rates
        return Turns(first, errors, mount.matrix @ jacobians[:, 6:9], by_mount)

    def squared_errors(self, state: State) -> Array:
        """Squared errors (k,), (rad/s)^2, of three axes together."""
        errors: Array = np.sum(np.square(self.look(state).errors), axis=1)
        return errors

    def noise(self, state: State) -> float:
        """Standard deviation of an axis (rad/s), by the errors' median."""
        return float(np.sqrt(np.median(self.squared_errors(state)) / _MEDIAN))

    def add(self, state: State, normal: Normal) -> float:
        """Add samples and what is known of the mount to the normal equations; returns the cost."""
        variance = self.samples.deviation**2
        cost = accumulate_turns(
            self.look(state), self.column, variance, _LIMIT**2 * variance, normal
        )
        assert state.mount is not None
        offset = state.mount.beside(self.start) / MOUNT_DEVIATIONS
        at = np.arange(self.column, self.column + MOUNT)
        normal.border_slope[at] += offset / MOUNT_DEVIATIONS
        normal.corner[at, at] += MOUNT_DEVIATIONS**-2
        return float(cost) + float(offset @ offset)

    def moved(self, mount: GyroMount, border: Array) -> GyroMount:
        """The mount after a step of the border."""
        return mount.moved(border[self.column : self.column + MOUNT])


def by_shape(rates: Array) -> Array:
    """Derivative (k,3,6) of ``shape rate`` by the six numbers of a symmetric matrix."""
    out = np.zeros((len(rates), 3, 6))
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        out[:, axis, axis] = rates[:, axis]
        for one, other in (others, others[::-1]):  # the entry beside the diagonal without this axis
            out[:, one, 3 + axis] = rates[:, other]
    return out
