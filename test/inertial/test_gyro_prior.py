# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A tracker and its gyroscope: what that is off by is found, and where it lies it is left out."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from benchmarks.aided import believed, record
from benchmarks.independent.cameras import Camera
from benchmarks.independent.gyroscopes import Imu
from benchmarks.independent.motions import hand, rest, shaken_hand
from benchmarks.independent.scenes import Rich
from rs_localizer.inertial.gyro_prior import GyroscopeTrack
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.status import InertialSettings
from rs_localizer.inertial.turning import GyroscopeErrors, smoothed, spectrum_of, waves_at
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline.pose_at_time import twist_at
from rs_localizer.tracking import Tracker

from ..moving import squared  # noqa: TID252 - Python has a package "test"


def test_the_update_is_that_of_the_whole_filter():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(28, 28)) / np.r_[np.full(18, 1.0), np.full(10, 30.0)][:, None]
    joint = root @ root.T
    observed, noise = rng.normal(size=(7, 18)), 0.1  # fewer numbers than the motion has
    seen = np.hstack([observed, np.zeros((7, 10))])
    gain = joint @ seen.T @ np.linalg.inv(seen @ joint @ seen.T + noise * np.eye(7))
    after, innovation = joint - gain @ seen @ joint, rng.normal(size=7)

    gyroscope = GyroscopeTrack(InertialSettings(1e-4, 1e-4), 0.02)
    gyroscope.errors = GyroscopeErrors(np.zeros(10), joint[18:, 18:], 1e-4)
    information = observed.T @ observed / noise
    by_prior = np.linalg.inv(np.eye(18) + joint[:18, :18] @ information)
    gyroscope._learn(joint[:18, 18:], by_prior, information, observed.T @ innovation / noise)
    np.testing.assert_allclose(gyroscope.errors.mean, gain[18:] @ innovation, atol=1e-10)
    np.testing.assert_allclose(gyroscope.errors.covariance, after[18:, 18:], atol=1e-10)
    np.testing.assert_allclose(gyroscope._tied, after[:18, 18:], atol=1e-10)


def around(recorded, frame):
    """Samples of a frame until long after it: stamps may be late."""
    (samples,), middle = recorded.samples, recorded.frames.middle_ns(frame)
    first, last = np.searchsorted(samples.times_ns, [middle - 600_000_000, middle + 60_000_000])
    return ImuSamples(samples.times_ns[first:last], samples.angular_velocity[first:last])


def followed(recorded, frames=60):
    """The gyroscope's status after each frame, and the results."""
    tracker = Tracker(Localizer(believed(recorded.frames.camera)), recorded.aid())
    found = []
    for frame in range(frames):
        seen, samples = recorded.frames.seen(frame, 1.0), around(recorded, frame)
        result = tracker.localize(recorded.frames.middle_ns(frame), *seen, readings=samples)
        found.append((tracker.aid.status, result))
    return found


def rate_errors(recorded, found, first):
    """Errors (n,3) of the turn rate in rad/s from a frame on, and their squared lengths (n,) in
    deviations.
    """
    off, far = [], []
    for frame, (_, result) in enumerate(found[first:], first):
        twist = twist_at(result, 0.0, recorded.frames.camera.readout_time)
        off.append(twist.angular - recorded.frames.middle.angular[frame])
        far.append(squared(off[-1], twist.covariance[3:, 3:]))
    return np.array(off), np.array(far)


@pytest.fixture(scope="module")
def held():
    return record(Camera(), hand, Rich(), (1, 60), seed=4)


@pytest.mark.parametrize(
    ("shaking", "offset"),
    [
        (((0.2, 61.3),), 0.005),
        (((0.2, 120.0),), -0.011),  # in step with the images, and so alike in all of them
        (((0.3, 60.0), (0.1, 120.0)), 0.005),
        pytest.param((), 0.005, marks=pytest.mark.bench),
    ],
)
def test_a_time_offset_is_found_and_no_period_of_a_vibration_mistaken_for_another(shaking, offset):
    motion = partial(shaken_hand, shaking=shaking) if shaking else hand
    recorded = record(Camera(), motion, Rich(), (1, 75), 5, replace(Imu(), offset=offset))
    found = followed(recorded, 75)
    assert abs(found[-1][0].time_offset - offset) < 5e-4
    assert all(result for _, result in found[60:])
    off, _ = rate_errors(recorded, found, 60)
    # 50 without the gyroscope; a tenth of a millisecond is worth 5 under the vibrations.
    assert np.median(np.degrees(np.linalg.norm(off, axis=1))) < 7.0
    # Also before it is known.
    assert np.mean(rate_errors(recorded, found, 5)[1] < 7.81) > 0.85


def test_a_camera_at_rest_says_nothing_of_the_offset():
    recorded = record(Camera(), rest, Rich(), (1, 12), 5)
    status, _ = followed(recorded, 12)[-1]
    assert status.time_offset_deviation > 0.01


@pytest.mark.parametrize("shaking", [((0.2, 60.0),), pytest.param((), marks=pytest.mark.bench)])
def test_a_step_of_the_stamps_is_found(shaking):
    motion = partial(shaken_hand, shaking=shaking) if shaking else hand
    recorded = record(Camera(), motion, Rich(), (1, 70), 5, replace(Imu(), step=0.02))
    found = followed(recorded, 70)  # in the middle of them
    assert abs(found[-1][0].time_offset + 0.02) < 1e-3
    assert "stamps" in found[-1][0].oddity
    _, far = rate_errors(recorded, found, 0)
    assert np.mean(far[35:50] < 7.81) > 0.4
    assert np.mean(far[50:] < 7.81) > 0.85


def test_the_bias_is_found(held):
    status, result = followed(held)[-1]
    assert status.unused is None
    assert status.oddity == ""
    assert result.aided
    assert 0.1 < np.degrees(np.linalg.norm(status.bias)) < 0.9  # of 0.5
    assert np.degrees(status.bias_deviation) < 0.2


def test_behind_the_last_row_the_camera_turns_on(held):
    """Readings of later than the middle row have not come: the frame's own rows say it."""
    tracker = Tracker(Localizer(believed(held.frames.camera)), held.aid())
    half = round(0.5e9 * Camera().readout_time)
    off = []
    for frame in range(60):
        samples, middle = held.around(frame), held.frames.middle_ns(frame)
        tracker.localize(middle, *held.frames.seen(frame, 1.0), readings=samples)
        here = int(np.searchsorted(samples.times_ns, middle))
        late = ImuSamples(samples.times_ns[:here], samples.angular_velocity[:here])
        moved = [tracker.at(middle + half + 1_000_000, heard) for heard in (late, samples)]
        if frame >= 20:
            off.append(np.subtract(*(one.angular_velocity for one in moved)))
    off = np.degrees(np.linalg.norm(off, axis=1)) / Camera().readout_time
    assert np.median(off) < 1.0  # 4.8 deg/s where the motion of the frames so far is carried on


@pytest.mark.parametrize(("motion", "noise"), [(hand, 1e-3), (rest, 5e-3)])
def test_noise_that_nobody_declared_is_learned(motion, noise):
    noisy = record(Camera(), motion, Rich(), (1, 40), 2, Imu(noise=noise))
    found = followed(replace(noisy, imu=Imu()), 40)
    assert np.mean(rate_errors(noisy, found, 5)[1] < 7.81) >= 0.9
    assert not any(status.oddity for status, _ in found)


@pytest.mark.parametrize("rate", [200.0, 400.0, 1000.0])
def test_readings_tell_their_noise_and_how_well_they_tell_rates(rate):
    rng, times = np.random.default_rng(1), np.arange(0.0, 0.6, 1.0 / rate)
    noise, wanted = 1e-3, np.linspace(0.55, 0.58, 31)

    def true(time):
        return np.stack([np.sin(9.0 * time + k) + np.sin(250.0 * time - k) for k in range(3)], -1)

    ratios = []
    for _ in range(20):
        rates = true(times) + noise * np.sqrt(rate) * rng.normal(size=(len(times), 3))
        spectrum = spectrum_of(np.rint(1e9 * times).astype(np.int64), rates, 1e-4)
        assert np.sqrt(spectrum.noise / rate) == pytest.approx(noise, rel=0.35)
        near = slice(-len(spectrum.frequencies), None)
        shown = waves_at(wanted, spectrum)
        own = waves_at(times[near], spectrum)
        told, covariance = smoothed(own, rates[near], shown, spectrum)
        mean = (shown @ told).real
        ratios.append((mean - true(wanted)) ** 2 / covariance.diagonal()[:, None])
    assert 0.5 < np.mean(ratios) < 1.5


@pytest.mark.parametrize("count", [2, 3, 7, 17])
def test_few_readings_have_the_noise_that_is_given(count):
    times_ns, rates = (
        2_500_000 * np.arange(count),
        np.outer(np.linspace(0.1, 0.2, count), np.ones(3)),
    )
    spectrum, times = spectrum_of(times_ns, rates, 1e-3), 1e-9 * times_ns
    assert spectrum.noise == pytest.approx(400.0 * 1e-6)
    shown = waves_at(times, spectrum)
    told, covariance = smoothed(shown, rates, shown, spectrum)
    mean = (shown @ told).real
    np.testing.assert_allclose(mean, rates, atol=0.05)
    assert np.linalg.eigvalsh(covariance).min() > -1e-9
