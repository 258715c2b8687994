# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A gyroscope beside the camera: its samples, how it is mounted, and a first guess of that."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.trajectory.spline import Layout, Spline

# Stamps of camera and IMU are looked for within this (s) of each other, in these steps (s): the
# turns of a hand hardly change within a step.
_MOST_DELAY, _DELAY_STEP = 0.5, 0.005
# So many samples are enough for a first guess.
_GUESS_SAMPLES = 3000
_LEAST_SAMPLES = 100
# Of the gyroscope's variance, what the camera's turns must explain.
_LEAST_EXPLAINED = 0.5
# A unit is wrong, not a scale, where rates differ by more than this.
_MOST_SCALE = 1.5
MOUNT, DELAY = 13, 6
"""Numbers of a mount: turn of the IMU in its own axes, bias, delay, shape; place of the delay."""
# What a first guess of turn (rad), bias (rad/s) and delay (s) may be off: as good as nothing, but
# what the motion does not tell stays where it is. Scales and angles of consumer gyroscopes are good
# to some percent.
MOUNT_DEVIATIONS = np.repeat([1.0, 1.0, 0.5, 0.03], (3, 3, 1, 6))
# Weight of a rotation that is given, by what the motion says: it helps where that is nothing.
_GIVEN_WEIGHT = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class GyroSamples:
    """What a gyroscope measured."""

    times: Array  # (k,) s, by its own stamps
    rates: Array  # (k,3) rad/s, in its own axes
    deviation: float = np.inf  # rad/s, standard deviation of the noise of a sample and axis

    def covered(self, layout: Layout, delay: float, margin: float) -> BoolArray:
        """Which samples (k,) a motion covers, and its edges are farther away than ``margin`` s."""
        times = self.times + delay
        return layout.inside(times - margin) & layout.inside(times + margin)

    def subset(self, chosen: BoolArray) -> GyroSamples:
        """The chosen samples (k,)."""
        return GyroSamples(self.times[chosen], self.rates[chosen], self.deviation)


@dataclass(frozen=True, slots=True, eq=False)
class GyroMount:
    """How a gyroscope measures.

    It measures ``(1 + shape) camera_from_imu^T rate + bias`` of the camera's rate at ``t + delay``.
    The symmetric ``shape`` has what a consumer's gyroscope is wrong in: the scales of its axes and
    the angles between them, a percent or so. Without it the readout time would pay for them.
    """

    camera_from_imu: Array  # (3,3)
    bias: Array  # (3,) rad/s, in its own axes
    delay: float  # s, to be added to its stamps to get the time of the spline
    shape: Array = field(default_factory=lambda: np.zeros(6))  # xx yy zz yz xz xy

    @property
    def matrix(self) -> Array:
        """(3,3), from the camera's rates to measured ones without bias."""
        xx, yy, zz, yz, xz, xy = self.shape
        symmetric = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        matrix: Array = (np.eye(3) + symmetric) @ self.camera_from_imu.T
        return matrix

    def moved(self, step: Array) -> GyroMount:
        """After a step (13,)."""
        return GyroMount(
            self.camera_from_imu @ so3.exp(step[:3]), self.bias + step[3:6],
            self.delay + float(step[DELAY]), self.shape + step[DELAY + 1 :],
        )  # fmt: skip

    def beside(self, first: GyroMount) -> Array:
        """The step (13,) that leads here from a first guess, which has no shape."""
        turn = so3.log(np.ascontiguousarray(first.camera_from_imu.T @ self.camera_from_imu))
        step: Array = np.r_[turn, self.bias - first.bias, self.delay - first.delay, self.shape]
        return step

    def turned_from(self, given: Array) -> float:
        """Angle (rad) between its rotation and a given one (3,3)."""
        between = np.ascontiguousarray(given.T @ self.camera_from_imu)
        return float(np.linalg.norm(so3.log(between)))


class NoMount(ValueError):
    """Gyroscope and camera do not go together; the message says why."""


def first_mount(samples: GyroSamples, spline: Spline, given: Array | None = None) -> GyroMount:
    """Delay, rotation and bias under which the gyroscope agrees best with the camera's turns.

    Args:
        given: (3,3) camera_from_imu, as far as the motion does not tell it.

    Raises:
        NoMount: when there are too few samples during the motion, or they show other turns.
    """
    layout = spline.layout
    # The same samples at every delay, else the shares they agree by could not be compared.
    near = samples.subset(samples.covered(layout, 0.0, _MOST_DELAY))
    if len(near.times) < _LEAST_SAMPLES:
        raise NoMount(
            f"{len(near.times)} samples of the IMU lie in the time of the images, at least "
            f"{_LEAST_SAMPLES} are needed"
        )
    near = near.subset(np.arange(len(near.times)) % (1 + len(near.times) // _GUESS_SAMPLES) == 0)
    delays = np.arange(-_MOST_DELAY, _MOST_DELAY + 0.5 * _DELAY_STEP, _DELAY_STEP)
    matches = [_match(near, spline, float(delay), given) for delay in delays]
    best = max(matches, key=lambda match: match.explained)
    if not best.explained > _LEAST_EXPLAINED:
        raise NoMount(
            f"the IMU's turn rates are not the camera's: within {1e3 * _MOST_DELAY:.0f} ms of each "
            f"other's stamps {max(best.explained, 0.0):.0%} of them agree"
        )
    if not 1.0 / _MOST_SCALE < best.scale < _MOST_SCALE:
        raise NoMount(
            f"the IMU's turn rates are {best.scale:.3g} times the camera's: are they in rad/s?"
        )
    return best.mount


@dataclass(frozen=True, slots=True, eq=False)
class _Match:
    mount: GyroMount
    explained: float  # share of the gyroscope's variance
    scale: float  # of the gyroscope's rates by the camera's


def _match(samples: GyroSamples, spline: Spline, delay: float, given: Array | None) -> _Match:
    """The best rotation (Kabsch) and bias at a delay."""
    inside = samples.covered(spline.layout, delay, 0.0)
    if np.count_nonzero(inside) < _LEAST_SAMPLES:
        return _Match(GyroMount(np.eye(3), np.zeros(3), delay), -np.inf, 1.0)
    rates = samples.rates[inside]
    turns = spline.states(samples.times[inside] + delay).angular
    rate, turn = rates.mean(axis=0), turns.mean(axis=0)
    product = (turns - turn).T @ (rates - rate)
    power = float(np.sqrt(np.sum((turns - turn) ** 2) * np.sum((rates - rate) ** 2)))
    if given is not None:
        product = product + _GIVEN_WEIGHT * power * given
    left, strengths, right = np.linalg.svd(product)
    sign = np.array([1.0, 1.0, np.linalg.det(left @ right)])
    rotation = left * sign @ right
    common = float(strengths @ sign)
    scale = np.sqrt(np.sum((rates - rate) ** 2) / max(float(np.sum((turns - turn) ** 2)), 1e-300))
    return _Match(
        GyroMount(rotation, rate - rotation.T @ turn, delay),
        (common / max(power, 1e-300)) ** 2 * np.sign(common),
        float(scale),
    )
