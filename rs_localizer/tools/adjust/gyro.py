# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A gyroscope's samples: a factor.

In the gyroscope's axes ``e = M rate(t + delay) + bias - measured``: the noise of the samples must
not stand beside what is estimated of ``M``, which it would make smaller.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.tools.adjust.priors import known
from rs_localizer.tools.adjust.spline_kernels import CONTROL
from rs_localizer.tools.adjust.system import Quadratic, Rows
from rs_localizer.tools.adjust.variables import DELAY, MOUNT, GyroSamples, Unknowns

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
