# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How an IMU goes with the camera: offset of its stamps, rotation and gyroscope bias."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.trajectory.banded import Undetermined
from rs_localizer.trajectory.fit import Fit, fit
from rs_localizer.trajectory.gyro import DELAY, MOUNT, GyroMount, GyroSamples, first_mount
from rs_localizer.trajectory.gyro_terms import GyroTerms
from rs_localizer.trajectory.model import Observations
from rs_localizer.trajectory.online_readout import REVERSED
from rs_localizer.trajectory.spline import refined

# The noise of the gyroscope has settled when it changes by less than this share.
_ROUNDS, _SETTLED = 6, 0.03
_LEAST_DEVIATION = 1e-6  # rad/s; recordings without noise are simulated
# A gyroscope sees what images do not: knots may be so much finer than theirs, but no finer than
# so many samples.
_MOST_HALVINGS, _LEAST_SAMPLES = 3, 2.0
_COST_PER_PARAMETER = 2.0  # Akaike, as of the knots of the images alone
# Determined is what is known to this (s, rad, rad/s).
_MOST_OFFSET, _MOST_TURN, _MOST_BIAS = 2e-3, np.radians(2.0), np.radians(1.0)


@dataclass(frozen=True, slots=True, eq=False)
class ImuRecording:
    """What an IMU measured while the camera ran."""

    stamps_ns: IntArray  # (k,)
    angular_velocities: Array  # (k,3) rad/s, in its own axes
    camera_from_imu: Array | None = None  # (3,3) as others say: checked, not believed

    def samples(self, start_ns: int) -> GyroSamples:
        """Its finite samples in the order of time, one for each stamp, from a time 0 on."""
        finite = np.isfinite(self.angular_velocities).all(axis=1)
        stamps, order = np.unique(self.stamps_ns[finite], return_index=True)
        times = (stamps - start_ns).astype(float) * 1e-9
        return GyroSamples(times, self.angular_velocities[finite][order])


@dataclass(frozen=True, slots=True, eq=False)
class MountFound:
    """What a recording says of its IMU."""

    # s to add to a stamp of the IMU to get the camera's time, where images are stamped at the
    # exposure of their first row
    time_offset: float
    time_offset_deviation: float  # s
    mount: GyroMount
    rotation_deviations: Array  # (3,) rad, about the IMU's axes
    bias_deviations: Array  # (3,) rad/s
    shape_deviations: Array  # (6,) as of GyroMount.shape
    noise: float  # rad/s, standard deviation of a sample and axis
    samples: int
    inflation: float  # of the offset's deviation, because parts disagree; 1: they do not

    @property
    def time_offset_determined(self) -> bool:
        return bool(self.time_offset_deviation < _MOST_OFFSET)

    @property
    def rotation_determined(self) -> bool:
        return bool(np.all(self.rotation_deviations < _MOST_TURN))

    @property
    def bias_determined(self) -> bool:
        return bool(np.all(self.bias_deviations < _MOST_BIAS))


def with_gyro(
    camera: Camera,
    observations: Observations,
    fitted: Fit,
    samples: GyroSamples,
    given: Array | None,
) -> tuple[Observations, Fit]:
    """The motion again, with a gyroscope and its mount in it.

    Args:
        observations: keypoints.
        fitted: motion of the keypoints alone.
        given: (3,3) camera_from_imu as others say; checked, not believed.

    Returns:
        The observations with the samples and their noise, and the estimate.

    Raises:
        NoMount: when the gyroscope shows other turns than the camera.
        Undetermined: when the joint system cannot be solved.
    """
    mount = first_mount(samples, fitted.state.spline, given)
    guess = replace(fitted, state=replace(fitted.state, mount=mount))
    samples, joint = _settled(camera, observations, samples, guess)
    least = _LEAST_SAMPLES * float(np.median(np.diff(samples.times)))
    for _ in range(_MOST_HALVINGS):
        spacing = 0.5 * joint.state.spline.layout.spacing
        if spacing < least:
            break
        finer = replace(joint.state, spline=refined(joint.state.spline, spacing))
        try:
            quieter, other = _settled(camera, observations, samples, replace(joint, state=finer))
        except Undetermined:
            break
        if not _worth_it(quieter, other, samples, joint):
            break
        samples, joint = quieter, other
    return replace(observations, gyro=samples), joint


def _settled(
    camera: Camera, observations: Observations, samples: GyroSamples, fitted: Fit
) -> tuple[GyroSamples, Fit]:
    """The joint estimate when the noise of the gyroscope does not change any more."""
    samples = _with_noise(samples, fitted)
    for _ in range(_ROUNDS):
        joint = replace(observations, gyro=samples)
        fitted = fit(camera, joint, fitted.state, fitted.freedom, fitted.deviation)
        before, samples = samples.deviation, _with_noise(samples, fitted)
        if abs(samples.deviation - before) < _SETTLED * before:
            break
    return samples, fitted


def _with_noise(samples: GyroSamples, fitted: Fit) -> GyroSamples:
    noise = GyroTerms(samples, fitted.state, 0).noise(fitted.state)
    return replace(samples, deviation=max(noise, _LEAST_DEVIATION))


def _worth_it(quieter: GyroSamples, finer: Fit, samples: GyroSamples, coarser: Fit) -> bool:
    """Whether finer knots explain more than they cost: by the likelihood of both noises."""
    count = np.count_nonzero(quieter.covered(finer.state.spline.layout, 0.0, 0.0))
    gain = 6.0 * count * np.log(samples.deviation / quieter.deviation)
    gain += 4.0 * np.count_nonzero(coarser.inliers) * np.log(coarser.deviation / finer.deviation)
    added = 6 * (len(finer.state.spline.positions) - len(coarser.state.spline.positions))
    return bool(gain > _COST_PER_PARAMETER * added)


def mount_of(camera: Camera, fitted: Fit, samples: GyroSamples, inflation: float) -> MountFound:
    """What a joint estimate says of the IMU.

    Args:
        camera: whose images were stamped when their first row was exposed.
        samples: with the noise that they turned out to have.
        inflation: of the deviation of the delay, because parts of the recording disagree.
    """
    mount, covariance = fitted.state.mount, fitted.border_covariance
    assert mount is not None
    deviations = np.sqrt(np.diag(covariance))[-MOUNT:]
    # The spline's time of an image is its stamp at the middle row, the camera's at the first row.
    by_offset, later = np.zeros(len(covariance)), middle_row(camera, fitted.state.readout_time)
    by_offset[DELAY - MOUNT] = 1.0
    if fitted.freedom.readout_time:
        by_offset[0] = later
    return MountFound(
        time_offset=mount.delay + later * fitted.state.readout_time,
        time_offset_deviation=inflation * float(np.sqrt(by_offset @ covariance @ by_offset)),
        mount=mount,
        rotation_deviations=deviations[:3],
        bias_deviations=deviations[3:6],
        shape_deviations=deviations[DELAY + 1 :],
        noise=samples.deviation,
        samples=len(GyroTerms(samples, fitted.state, 0).samples.times),
        inflation=inflation,
    )


def middle_row(camera: Camera, readout_time: float) -> float:
    """How much later than the first row the middle one is exposed, by (signed) readout time."""
    if readout_time >= 0.0:
        return -camera.first_row_time
    reversed_ = replace(camera, scan_direction=REVERSED[ScanDirection(camera.scan_direction)])
    return reversed_.first_row_time
