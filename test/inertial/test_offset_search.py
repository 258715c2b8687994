# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The time offset from nothing: whatever shakes, the right one of its periods is found."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from benchmarks.aided import believed, record
from benchmarks.independent.cameras import Camera
from benchmarks.independent.gyroscopes import Imu
from benchmarks.independent.motions import hand, rest, shaken_hand
from benchmarks.independent.scenes import Rich
from rs_localizer.inertial.gyroscope_noise import InertialSettings
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline.pose_at_time import twist_at
from rs_localizer.tracking import Tracker


def tracker_of(recorded, estimated=True):
    settings = InertialSettings(recorded.imu.noise, 1e-4, estimated)
    return Tracker(Localizer(believed(recorded.frames.camera)), settings)


def followed(tracker, recorded, frames):
    """Whether the search goes on after each frame, and the last status."""
    going = []
    for frame in range(frames):
        seen = recorded.frames.seen(frame, 1.0)
        middle = recorded.frames.middle_ns(frame)
        assert tracker.localize(middle, *seen, imu=recorded.around(frame))
        going.append(tracker._aid._search is not None)
    return going, tracker.inertial


@pytest.mark.parametrize(
    ("offset", "hertz"),
    [
        (0.005, 61.3),
        (-0.011, 120.0),
        pytest.param(0.005, 60.0, marks=pytest.mark.bench),
        pytest.param(0.005, 120.0, marks=pytest.mark.bench),
    ],
)
def test_no_period_of_a_vibration_is_mistaken_for_another(hertz, offset):
    motion = partial(shaken_hand, shaking=((0.2, hertz),))
    recorded = record(Camera(), motion, Rich(), (1, 30), 5, replace(Imu(), offset=offset))
    tracker = tracker_of(recorded)
    going, status = followed(tracker, recorded, 30)
    assert not going[-1]
    assert abs(status.time_offset - offset) < 5e-4
    assert abs(status.time_offset - offset) < 4.0 * status.time_offset_deviation + 4e-5
    tracker.reset()
    assert tracker._aid._search is not None  # begins anew


def test_a_camera_at_rest_says_nothing():
    recorded = record(Camera(), rest, Rich(), (1, 12), 5)
    going, status = followed(tracker_of(recorded), recorded, 12)
    assert all(going)
    assert status.time_offset_deviation > 5e-3


@pytest.mark.parametrize("shaking", [((0.2, 60.0),), pytest.param((), marks=pytest.mark.bench)])
def test_a_step_of_the_stamps_is_found(shaking):
    """Another clock from one sample on, by 20 ms: more than a period of the vibration."""
    motion = partial(shaken_hand, shaking=shaking) if shaking else hand
    recorded = record(Camera(), motion, Rich(), (1, 70), 5)
    (samples,) = recorded.samples
    step_ns, since_ns = 20_000_000, recorded.frames.middle_ns(25)
    times_ns = samples.times_ns + step_ns * (samples.times_ns > since_ns)
    stepped = replace(recorded, samples=(replace(samples, times_ns=times_ns),))
    tracker = tracker_of(stepped)
    _, before = followed(tracker, stepped, 25)
    deviations, inside = [], []
    for frame in range(25, 70):
        middle_ns = stepped.frames.middle_ns(frame)
        later = times_ns < middle_ns + 60_000_000  # samples come in time, with wrong stamps
        imu = replace(
            samples, times_ns=times_ns[later], angular_velocity=samples.angular_velocity[later]
        )
        found = tracker.localize(middle_ns, *stepped.frames.seen(frame, 1.0), imu=imu)
        deviations.append(tracker.inertial.time_offset_deviation)
        if found:
            inside.append(rate_error(stepped, frame, found) < 7.81)
    after = tracker.inertial
    assert max(deviations[:10]) > 5.0 * before.time_offset_deviation
    assert abs(after.time_offset - recorded.imu.offset + 0.02) < 5e-4
    assert np.mean(inside[:10]) > 0.65  # 0.1 to 0.4 before
    assert np.mean(inside[10:]) > 0.85


def rate_error(recorded, frame, found):
    """Squared error of the turn rate in deviations, of three numbers."""
    twist = twist_at(found, 0.0, recorded.frames.camera.readout_time)
    off = twist.angular - recorded.frames.middle.angular[frame]
    return off @ np.linalg.solve(twist.covariance[3:, 3:], off)
