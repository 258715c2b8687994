# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How an IMU goes with the camera: offset of its stamps, rotation and gyroscope bias."""

from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import REVERSED, ScanDirection
from rs_localizer.io.imu import ImuRecording
from rs_localizer.tools.adjust.factors import Gyroscope
from rs_localizer.tools.adjust.fit import Fit, fit
from rs_localizer.tools.adjust.spline import Spline, refined
from rs_localizer.tools.adjust.system import Undetermined
from rs_localizer.tools.adjust.variables import (
    DELAY,
    MOUNT,
    GyroMount,
    GyroSamples,
    SplineKeypoints,
)

# The noise of the gyroscope has settled when it changes by less than this share.
_ROUNDS, _SETTLED = 6, 0.03
_LEAST_DEVIATION = 1e-6  # rad/s; recordings without noise are simulated
# A gyroscope sees what images do not: knots may be so much finer than theirs, but no finer than
# this many samples.
_MOST_HALVINGS, _LEAST_SAMPLES = 3, 2.0
_COST_PER_PARAMETER = 2.0  # Akaike, as of the knots of the images alone
# Determined is what is known to this (s, rad, rad/s).
_MOST_OFFSET, _MOST_TURN, _MOST_BIAS = 2e-3, np.radians(2.0), np.radians(1.0)


# Stamps of camera and IMU are looked for within this (s) of each other, in these steps (s): the
# turns of a hand hardly change within a step.
_MOST_DELAY, _DELAY_STEP = 0.5, 0.005
# A first guess needs no more samples than this.
_GUESS_SAMPLES = 3000
_LEAST_GUESS = 100
# Least share of the gyroscope's variance that the camera's rotation must explain.
_LEAST_EXPLAINED = 0.5
# A unit is wrong, not a scale, where rates differ by more than this.
_MOST_SCALE = 1.5


def first_mount(samples: GyroSamples, spline: Spline) -> GyroMount:
    """Return delay, rotation and bias under which the gyroscope best follows the camera.

    Raises:
        Undetermined: when there are too few samples during the motion, or they show other turns.
    """
    layout = spline.layout
    # The same samples at every delay, else the shares they agree by could not be compared.
    near = samples.subset(samples.covered(layout, 0.0, _MOST_DELAY))
    if len(near.times) < _LEAST_GUESS:
        raise Undetermined(
            f"{len(near.times)} samples of the IMU lie in the time of the images, at least "
            f"{_LEAST_GUESS} are needed"
        )
    near = near.subset(np.arange(len(near.times)) % (1 + len(near.times) // _GUESS_SAMPLES) == 0)
    delays = np.arange(-_MOST_DELAY, _MOST_DELAY + 0.5 * _DELAY_STEP, _DELAY_STEP)
    matches = [_match(near, spline, float(delay)) for delay in delays]
    mount, explained, scale = max(matches, key=lambda match: match[1])
    if not explained > _LEAST_EXPLAINED:
        raise Undetermined(
            f"the IMU's angular rates are not the camera's: within {1e3 * _MOST_DELAY:.0f} ms of "
            f"each other's stamps {max(explained, 0.0):.0%} of them agree"
        )
    if not 1.0 / _MOST_SCALE < scale < _MOST_SCALE:
        raise Undetermined(
            f"the IMU's angular rates are {scale:.3g} times the camera's: are they in rad/s?"
        )
    return mount


def _match(samples: GyroSamples, spline: Spline, delay: float) -> tuple[GyroMount, float, float]:
    """Return the best rotation (Kabsch) and bias at a delay.

    And the share of the gyroscope's variance that they explain, and the scale of its rates.
    """
    inside = samples.covered(spline.layout, delay, 0.0)
    if np.count_nonzero(inside) < _LEAST_GUESS:
        return GyroMount(np.eye(3), np.zeros(3), delay), -np.inf, 1.0
    rates = samples.rates[inside]
    turns = spline.states(samples.times[inside] + delay).angular
    rate, turn = rates.mean(axis=0), turns.mean(axis=0)
    product = (turns - turn).T @ (rates - rate)
    turning, shown = float(np.sum((turns - turn) ** 2)), float(np.sum((rates - rate) ** 2))
    power = float(np.sqrt(turning * shown))
    left, strengths, right = np.linalg.svd(product)
    sign = np.array([1.0, 1.0, np.linalg.det(left @ right)])
    rotation = left * sign @ right
    common = float(strengths @ sign)
    explained = (common / max(power, 1e-300)) ** 2 * np.sign(common)
    mount = GyroMount(rotation, rate - rotation.T @ turn, delay)
    return mount, float(explained), float(np.sqrt(shown / max(turning, 1e-300)))


def gyro_samples(recording: ImuRecording, start_ns: int) -> GyroSamples:
    """Return finite samples in the order of time, one for each stamp, from a time 0 on."""
    finite = np.isfinite(recording.angular_velocities).all(axis=1)
    stamps, order = np.unique(recording.stamps_ns[finite], return_index=True)
    times = (stamps - start_ns).astype(float) * 1e-9
    return GyroSamples(times, recording.angular_velocities[finite][order])


@dataclass(frozen=True, slots=True, eq=False)
class MountFound:
    """Findings of a recording on its IMU."""

    # s to add to a stamp of the IMU to get the camera's time, where images are stamped at the
    # exposure of their first row
    time_offset: float
    time_offset_deviation: float  # s
    mount: GyroMount
    rotation_deviations: Array  # (3,) rad, about the IMU's axes
    bias_deviations: Array  # (3,) rad/s
    noise: float  # rad/s, standard deviation of a sample and axis
    inflation: float  # of the offset's deviation, because parts disagree; 1: they do not

    @property
    def determined(self) -> tuple[bool, bool, bool]:
        """Whether offset, rotation and bias are known well enough."""
        return (
            bool(self.time_offset_deviation < _MOST_OFFSET),
            bool(np.all(self.rotation_deviations < _MOST_TURN)),
            bool(np.all(self.bias_deviations < _MOST_BIAS)),
        )


def with_gyro(
    observations: SplineKeypoints, fitted: Fit, samples: GyroSamples
) -> tuple[SplineKeypoints, Fit]:
    """Fit the motion again, with a gyroscope and its mount in it.

    Args:
        observations: keypoints.
        fitted: motion of the keypoints alone.

    Returns:
        The observations with the samples and their noise, and the estimate.

    Raises:
        Undetermined: when the gyroscope shows other turns than the camera, or the joint system
            cannot be solved.
    """
    mount = first_mount(samples, fitted.state.spline)
    guess = replace(fitted, state=replace(fitted.state, mount=mount))
    samples, joint = _settled(observations, samples, guess)
    least = _LEAST_SAMPLES * float(np.median(np.diff(samples.times)))
    for _ in range(_MOST_HALVINGS):
        spacing = 0.5 * joint.state.spline.layout.spacing
        if spacing < least:
            break
        finer = replace(joint.state, spline=refined(joint.state.spline, spacing))
        try:
            quieter, other = _settled(observations, samples, replace(joint, state=finer))
        except Undetermined:
            break
        # Finer knots have to explain more than they cost, by both likelihoods.
        count = np.count_nonzero(quieter.covered(other.state.spline.layout, 0.0, 0.0))
        gain = 6.0 * count * np.log(samples.deviation / quieter.deviation)
        gain += 4.0 * np.count_nonzero(joint.inliers) * np.log(joint.deviation / other.deviation)
        added = 6 * (len(other.state.spline.positions) - len(joint.state.spline.positions))
        if not gain > _COST_PER_PARAMETER * added:
            break
        samples, joint = quieter, other
    return replace(observations, gyro=samples), joint


def _settled(
    observations: SplineKeypoints, samples: GyroSamples, fitted: Fit
) -> tuple[GyroSamples, Fit]:
    """Return the joint estimate when the noise of the gyroscope no longer changes."""
    samples = _with_noise(samples, fitted)
    for _ in range(_ROUNDS):
        joint = replace(observations, gyro=samples)
        fitted = fit(joint, fitted.state, fitted.freedom, fitted.deviation)
        before, samples = samples.deviation, _with_noise(samples, fitted)
        if abs(samples.deviation - before) < _SETTLED * before:
            break
    return samples, fitted


def _with_noise(samples: GyroSamples, fitted: Fit) -> GyroSamples:
    noise = Gyroscope(samples, fitted.state).noise(fitted.state)
    return replace(samples, deviation=max(noise, _LEAST_DEVIATION))


def mount_of(observations: SplineKeypoints, fitted: Fit, inflation: float) -> MountFound:
    """Return the findings of a joint estimate on the IMU.

    Args:
        observations: of images that were stamped when their first row was exposed, and samples with
            the noise that they turned out to have.
        inflation: of the deviation of the delay, because parts of the recording disagree.
    """
    mount, covariance = fitted.state.mount, fitted.border_covariance
    camera, samples = observations.camera, observations.gyro
    assert mount
    assert samples
    deviations = np.sqrt(np.diag(covariance))[-MOUNT:]
    # The spline's time of an image is its stamp at the middle row, the camera's at the first row.
    by_offset, later = np.zeros(len(covariance)), middle_row(camera, fitted.state.readout_time)
    by_offset[DELAY - MOUNT] = 1.0
    if fitted.freedom.readout_time:
        by_offset[0] = later
    return MountFound(
        time_offset=mount.delay + later * fitted.state.readout_time,
        time_offset_deviation=inflation * float(np.sqrt(by_offset @ covariance @ by_offset)),
        mount=mount, rotation_deviations=deviations[:3], bias_deviations=deviations[3:6],
        noise=samples.deviation, inflation=inflation,
    )  # fmt: skip


def middle_row(camera: Camera, readout_time: float) -> float:
    """Return the time from the first to the middle row's exposure, by (signed) readout time."""
    if readout_time >= 0.0:
        return -camera.first_row_time
    reversed_ = replace(camera, scan_direction=REVERSED[ScanDirection(camera.scan_direction)])
    return reversed_.first_row_time
