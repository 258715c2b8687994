# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A tracker and its gyroscope: offsets are found, and one that lies is dropped and said to."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.aided import believed, record
from benchmarks.independent.cameras import Camera
from benchmarks.independent.gyroscopes import Imu
from benchmarks.independent.motions import hand, shaken_hand
from benchmarks.independent.scenes import Rich
from rs_localizer.core.reasons import ImuReason
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.localizer import Localizer
from rs_localizer.tracking import Tracker


def vibrating(count, rng):
    return shaken_hand(count, rng, ((0.3, 60.0), (0.1, 120.0)))


def statuses(recorded, change, frames=60):
    """The gyroscope's status after each frame, with samples that were changed, and the results."""
    tracker = Tracker(Localizer(believed(recorded.frames.camera)), recorded.settings)
    found = []
    for frame in range(frames):
        samples = change(recorded.around(frame), frame)
        seen = recorded.frames.seen(frame, 1.0)
        result = tracker.localize(recorded.frames.middle_ns(frame), *seen, imu=samples)
        found.append((tracker.inertial, result))
    return found


@pytest.fixture(scope="module")
def held():
    return record(Camera(), hand, Rich(), (1, 60), seed=4)


@pytest.mark.parametrize("motion", [vibrating, pytest.param(hand, marks=pytest.mark.bench)])
def test_a_time_offset_is_found(motion):
    recorded = record(Camera(), motion, Rich(), (1, 75), 4, replace(Imu(), offset=0.005))
    found = statuses(recorded, lambda samples, frame: samples, 75)
    assert abs(found[-1][0].time_offset - 0.005) < 5e-4
    assert all(result for _, result in found[60:])
    true = recorded.frames.middle.angular[60:]
    rates = [result.angular_velocity / Camera().readout_time for _, result in found[60:]]
    # 50 without the gyroscope; a tenth of a millisecond is worth 5 under the vibrations.
    assert np.median(np.degrees(np.linalg.norm(rates - true, axis=1))) < 7.0


def test_the_bias_is_found(held):
    status, result = statuses(held, lambda samples, frame: samples)[-1]
    assert status.unused is None
    assert result.turn is not None
    assert 0.1 < np.degrees(np.linalg.norm(status.bias)) < 0.9  # of 0.5
    assert np.degrees(status.bias_deviation) < 0.2


def test_upside_down_is_dropped(held):
    def turned(samples, frame):
        return ImuSamples(samples.times_ns, samples.angular_velocity * (1.0, -1.0, -1.0))

    found = statuses(held, turned)
    status, _ = found[-1]
    assert status.unused.reason == ImuReason.DISAGREES
    assert all(result for _, result in found)


def test_behind_the_last_row_the_camera_turns_on(held):
    """Readings of later than the middle row have not come: the frame's own rows say it."""
    tracker = Tracker(Localizer(believed(held.frames.camera)), held.settings)
    half = round(0.5e9 * Camera().readout_time)
    off = []
    for frame in range(60):
        samples, middle = held.around(frame), held.frames.middle_ns(frame)
        tracker.localize(middle, *held.frames.seen(frame, 1.0), imu=samples)
        here = int(np.searchsorted(samples.times_ns, middle))
        late = ImuSamples(samples.times_ns[:here], samples.angular_velocity[:here])
        moved = [tracker.at(middle + half + 1_000_000, heard) for heard in (late, samples)]
        if frame >= 20:
            off.append(np.subtract(*(one.angular_velocity for one in moved)))
    off = np.degrees(np.linalg.norm(off, axis=1)) / Camera().readout_time
    assert np.median(off) < 1.0  # 4.8 deg/s where the motion of the frames so far is carried on
