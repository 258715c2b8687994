# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How an IMU hangs on a camera whose motion is known: offset of its stamps, rotation, bias.

The mount is that of the joint estimate (:mod:`rs_localizer.trajectory.imu`), with the motion held.
A motion that images have found is good in its orientations, and noisy in its rates; so what is
compared are turns over a while, of which the camera's are ``v`` and the gyroscope's

    u = (1 + shape) camera_from_imu^T v + while bias

within the small errors of a first guess. Deviations come from the scatter of parts of the
recording, since what a motion lacks lasts for many samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.rate_spline import rotations_at_knots
from rs_localizer.core.rate_spline import spline as cubics_of
from rs_localizer.trajectory.gyro import (
    DELAY,
    MOUNT,
    MOUNT_DEVIATIONS,
    GyroMount,
    GyroSamples,
    NoMount,
    first_mount,
)
from rs_localizer.trajectory.gyro_terms import by_shape
from rs_localizer.trajectory.spline import Layout, Spline

# Turns are taken over about so long (s): short beside the motion, long beside the images' noise.
_WHILE, _UNEVEN = 0.15, 0.05
# Turns with a longer step between samples (s) in them, or nearer to the motion's ends, are none.
_LONGEST_STEP, _MARGIN = 0.03, 0.02
# Rates are averaged over so long (s) for a first guess: a third of a period of a hand's quickest.
_CALMED = 0.06
_ROUNDS = 10
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
_STEP = 1e-3  # s, of the derivative by the delay
# Squared errors of three axes count up to so many times their median.
_LIMIT = 16.0
# Turns further apart than so many have nothing to do with each other.
_PART = 6
_LEAST_PARTS = 3


@dataclass(frozen=True, slots=True, eq=False)
class ImuExtrinsics:
    """A mount beside a given motion."""

    mount: GyroMount
    covariance: Array  # (13,13) of turn (rad, IMU axes), bias, delay, shape

    @property
    def delay_deviation(self) -> float:
        """s."""
        return float(np.sqrt(self.covariance[DELAY, DELAY]))

    @property
    def turn_deviation(self) -> float:
        """rad, about the axis that is known worst."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[:3, :3])[-1]))


def imu_extrinsics(
    samples: GyroSamples, spline: Spline, given: Array | None = None
) -> ImuExtrinsics:
    """The mount under which a gyroscope shows the turns of a motion.

    Args:
        samples: of the gyroscope; their deviation is not used.
        spline: the motion of the camera.
        given: (3,3) camera_from_imu, as far as the motion does not tell it.

    Raises:
        NoMount: when there are too few samples during the motion, or they show other turns.
    """
    calmed = _calmed(samples)
    start = mount = first_mount(calmed, spline, given)
    shown = _Turned(samples), _Turned(calmed)
    times, whiles = _times(spline.layout, samples.times + mount.delay)
    if len(times) < _LEAST_PARTS * _PART:
        raise NoMount(f"{_WHILE * len(times):.1f} s of the motion have samples without a gap")
    before, after = (spline.states(ends).rotations for ends in (times, times + whiles))
    turns = Rotation.from_matrix(np.swapaxes(before, 1, 2) @ after).as_rotvec()
    parts: IntArray = np.arange(len(times)) // _PART
    for _ in range(_ROUNDS):
        errors, by_mount = _errors(shown, (times, whiles), turns, mount)
        squared = np.sum(np.square(errors), axis=1)
        weights = np.square(np.maximum(1.0 - squared / (_LIMIT * np.median(squared)), 0.0))
        scores = weights[:, None] * np.einsum("nij,ni->nj", by_mount, errors)
        variance = float(weights @ squared / (3.0 * np.sum(weights)))
        held = np.diag(variance / MOUNT_DEVIATIONS**2)
        normal = np.einsum("n,nij,nik->jk", weights, by_mount, by_mount)
        inverse = np.linalg.inv(normal + held)
        mount = mount.moved(-inverse @ (scores.sum(axis=0) + held @ mount.beside(start)))
    sums = np.zeros((parts[-1] + 1, MOUNT))
    np.add.at(sums, parts, scores)
    return ImuExtrinsics(mount, inverse @ (sums.T @ sums + variance * held) @ inverse)


def _calmed(samples: GyroSamples) -> GyroSamples:
    """Averaged over a moment: vibration, which no image shows, would be most of the rates."""
    if len(samples.times) < 2:
        return samples
    turned = cumulative_trapezoid(samples.rates, samples.times, axis=0, initial=0.0)
    ends = np.clip(
        samples.times + np.array([[-0.5], [0.5]]) * _CALMED, samples.times[0], samples.times[-1]
    )
    at = np.array([np.interp(ends, samples.times, axis) for axis in turned.T])
    return GyroSamples(samples.times, ((at[:, 1] - at[:, 0]) / (ends[1] - ends[0])).T)


class _Turned:
    """Orientations by samples."""

    def __init__(self, samples: GyroSamples) -> None:
        self._times, self._rates = samples.times, np.ascontiguousarray(samples.rates)
        self._turned = rotations_at_knots(self._times, cubics_of(self._times, self._rates))

    def turns(self, times: Array, whiles: Array) -> Array:
        """Rotation vectors (m,3) from times (m,) on, for whiles (m,)."""
        before, after = self._at(times), self._at(times + whiles)
        return np.asarray(Rotation.from_matrix(before @ np.swapaxes(after, 1, 2)).as_rotvec())

    def _at(self, times: Array) -> Array:
        """IMU-then from IMU-at-first (m,3,3)."""
        place = np.clip(np.searchsorted(self._times, times) - 1, 0, len(self._times) - 2)
        since = (times - self._times[place])[:, None]
        step = (self._times[place + 1] - self._times[place])[:, None]
        rate, change = self._rates[place], self._rates[place + 1] - self._rates[place]
        turned = so3.exp_many(-since * (rate + 0.5 * since / step * change))
        return np.asarray(turned @ self._turned[place], np.float64)


def _times(layout: Layout, sampled: Array) -> tuple[Array, Array]:
    """When turns begin (m,), and how long they last (m,), s: each within a stretch, without a gap.

    Not evenly: a tone in step with them would be no noise.
    """
    parts = [
        _unevenly(np.arange(start + _MARGIN, end - _MARGIN - _UNEVEN, _WHILE))
        for start, end in zip(layout.starts, layout.ends, strict=True)
    ]
    times = np.concatenate([ends[:-1] for ends in parts])
    whiles = np.concatenate([np.diff(ends) for ends in parts])
    first = np.searchsorted(sampled, times - _MARGIN)
    last = np.searchsorted(sampled, times + whiles + _MARGIN)
    gaps = np.concatenate([[0], np.cumsum(np.diff(sampled) > _LONGEST_STEP)])
    inside = (first > 0) & (last < len(sampled))
    whole = gaps[first - 1] == gaps[np.minimum(last, len(gaps) - 1)]
    return times[inside & whole], whiles[inside & whole]


def _unevenly(times: Array) -> Array:
    """Times (n,) later by multiples of the golden section, which come back to no tone."""
    return np.asarray(times + _UNEVEN * np.modf(_GOLDEN * np.arange(len(times)))[0])


def _errors(
    shown: tuple[_Turned, _Turned], when: tuple[Array, Array], turns: Array, mount: GyroMount
) -> tuple[Array, Array]:
    """What turns (m,3) of the gyroscope should be more, and its derivatives (m,3,13).

    Args:
        shown: turns by the samples, and without vibration: with it, an offset would be found at
            which the tone of a motor happens to be zero at these times.
    """
    turned = turns @ mount.camera_from_imu
    here, whiles = when[0] - mount.delay, when[1]
    errors = turns @ mount.matrix.T + whiles[:, None] * mount.bias - shown[0].turns(here, whiles)
    ahead, behind = (shown[1].turns(here + shift, whiles) for shift in (_STEP, -_STEP))
    by_mount = np.empty((len(turns), 3, MOUNT))
    by_mount[:, :, :3] = mount.matrix @ mount.camera_from_imu @ so3.hat(turned)
    by_mount[:, :, 3:6] = whiles[:, None, None] * np.eye(3)
    by_mount[:, :, DELAY] = (ahead - behind) / (2.0 * _STEP)
    by_mount[:, :, DELAY + 1 :] = by_shape(turned)
    return errors, by_mount
