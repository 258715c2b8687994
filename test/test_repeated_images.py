# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images that come again bit for bit: of a camera that rests, or of a stream that hangs."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from rs_localizer.inertial.gyro_prior import GyroscopeTrack
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.status import InertialSettings
from rs_localizer.tracking import Tracker

from .moving import PLAIN, Moving, camera_of, resting

RATE = 30.0
CAMERA = camera_of(PLAIN)
MAP = np.random.default_rng(0).uniform([-2.0, -1.5, 2.5], [2.0, 1.5, 5.0], (300, 3))
STILL = Moving(resting)


def swaying(t, shift=(0.0, 0.0, 0.0)):
    """Some 0.9 rad/s all the time; of a camera that is mounted beside the hand by ``shift``."""
    rotation = Rotation.from_rotvec(0.12 * np.sin(2.0 * np.pi * t + np.arange(3)))
    place = 0.05 * np.sin(1.6 * np.pi * t + np.array([2.0, 0.0, 1.0]))
    return rotation, place - rotation.apply(shift)


HAND = Moving(swaying)
# s. One that ends as an image is exposed counts as hung: one in four (docs/limits.md).
STOP = 0.32


def stopping(t):
    """60 deg/s and 0.5 m/s that end within STOP."""
    late = np.clip((t - 0.5) / STOP, 0.0, 1.0)
    gone = np.minimum(t, 0.5) + STOP * late * (1.0 - 0.5 * late)
    return Rotation.from_rotvec(np.radians(60.0) * gone * [0.6, 0.0, 0.8]), gone * [0.5, 0.0, 0.0]


def frame(moving, t, noise=0.0, seed=0):
    return moving.frame(t, MAP, 60, noise, seed=seed)


def ns(t):
    return round((t + 1.0) * 1e9)


def results(tracker, times, frames):
    """Result of each frame, or the reason why there is none."""
    found = [tracker.localize(ns(t), *frame) for t, frame in zip(times, frames, strict=True)]
    return [result if result else result.reason for result in found]


@pytest.fixture(scope="module")
def held():
    times = np.arange(60) / 20.0
    return times, [frame(HAND, t, 0.3, k) for k, t in enumerate(times)]


def test_a_still_scene_without_noise_is_used_and_grows_no_surer():
    times = np.arange(300) / RATE  # 10 s
    found = results(Tracker(rsl.Localizer(CAMERA)), times, [frame(STILL, 0.0)] * 300)
    assert all(isinstance(result, rsl.Estimate) for result in found)
    deviations = [result.orientation_deviation for result in found]
    assert min(deviations) > 0.999 * deviations[0]
    assert [result.time_ns for result in found] == [ns(t) for t in times]


def test_noise_that_repeats_counts_once():
    """The same noisy image for a second; beside it, new ones make the orientation surer."""
    times = np.arange(30) / RATE
    tracker = Tracker(rsl.Localizer(CAMERA))
    found = results(tracker, times, [frame(STILL, 0.0, 0.3)] * 30)
    assert tracker.repeats
    new = results(tracker, times + 1.0, [frame(STILL, 0.0, 0.3, seed) for seed in range(1, 31)])
    assert not tracker.repeats
    # Of what noise does to the orientation; errors of the calibration stay.
    first, last, newest = (
        it.joint_covariance[:3, :3].trace() for it in (found[0], found[-1], new[-1])
    )
    assert last > 0.999 * first
    assert newest < 0.5 * first


@pytest.mark.parametrize(
    "source",
    [lambda i: i - i % 2, lambda i: 20 if 20 <= i < 40 else i, lambda i: min(i, 20)],
    ids=["each twice", "hung for a second", "hung for ever"],
)
def test_a_moving_camera_cannot_see_the_same_image_again(held, source):
    times, frames = held
    found = results(Tracker(rsl.Localizer(CAMERA)), times, [frames[source(i)] for i in range(60)])
    first = [source(i) == i and (i == 0 or source(i - 1) != i) for i in range(60)]
    assert [reason == "repeated_image" for reason in found] == [not it for it in first]
    poses = [(result, t) for result, t, new in zip(found, times, first, strict=True) if new]
    turns = [np.linalg.norm(HAND.error(*each)[:3]) for each in poses]
    assert np.degrees(max(turns)) < 0.3  # 17 where they were used
    # The track goes on over one that is refused.
    assert sum(result.tracked for result, _ in poses) >= len(poses) - 2


def test_a_sudden_stop_is_no_hanging_stream():
    times, moving = np.arange(45) / RATE, Moving(stopping)
    frames = [frame(moving, min(t, 0.5 + STOP)) for t in times]
    found = results(Tracker(rsl.Localizer(CAMERA)), times, frames)
    assert all(isinstance(result, rsl.Estimate) for result in found)


@pytest.mark.parametrize(("rate", "found"), [(0.0, 10), (0.3, 5)])
def test_a_gyroscope_tells_a_resting_image_from_a_hanging_one(rate, found):
    times, stamps = np.arange(10) / 20.0, np.arange(ns(-1.0), ns(1.0), 2_000_000)
    settings = InertialSettings(1e-4, 1e-5, time_offset_deviation=1e-3)
    tracker = Tracker(rsl.Localizer(CAMERA), GyroscopeTrack(settings, CAMERA.readout_time))
    turning = np.outer(stamps > ns(times[4] + 0.02), [0.0, rate, 0.0])
    localized = []
    for k, t in enumerate(times):
        until = stamps < ns(t + 0.03)
        samples = ImuSamples(stamps[until], turning[until])
        seen = frame(STILL, 0.0, 0.3, min(k, 4))
        localized.append(bool(tracker.localize(ns(t), *seen, readings=samples)))
    assert localized == [True] * found + [False] * (10 - found)


def test_a_camera_of_a_rig_that_hangs_is_named():
    shifts = {"left": np.array([0.1, 0.0, 0.0]), "right": np.array([-0.1, 0.0, 0.0])}
    rig = rsl.Rig(dict.fromkeys(shifts, CAMERA), {k: (np.eye(3), s) for k, s in shifts.items()})
    moving = {k: Moving(lambda t, s=s: swaying(t, s)) for k, s in shifts.items()}
    tracker, times = Tracker(rsl.Localizer(rig)), np.arange(4) / 20.0
    frames = [{k: frame(of, t, 0.3) for k, of in moving.items()} for t in times]
    frames[2] = frames[2] | {"right": frames[1]["right"]}
    found = [tracker.localize(ns(t), parts) for t, parts in zip(times, frames, strict=True)]
    assert [bool(result) for result in found] == [True, True, False, True]
    assert found[2].reason == "repeated_image"
    assert "the pixels of right are those" in found[2].detail


def test_a_frame_without_images_repeats_none():
    rig = rsl.Rig({"a": CAMERA}, {"a": (np.eye(3), np.zeros(3))})
    tracker = Tracker(rsl.Localizer(rig))
    assert tracker.localize(ns(0.0), {"a": frame(HAND, 0.0)})
    with pytest.raises(ValueError, match="the frame has no image"):
        tracker.localize(ns(0.1), {})


def test_what_is_no_image_that_came_before(held):
    """An array that is used again; and any image where no prediction says that the camera moves."""
    times, frames = held
    tracker = Tracker(rsl.Localizer(CAMERA))
    points, pixels = (np.empty_like(part) for part in frames[0])
    for t, seen in zip(times[:4], frames, strict=False):
        points[:], pixels[:] = seen
        assert tracker.localize(ns(t), points, pixels)
        assert not tracker.repeats
    tracker.reset()
    assert tracker.localize(ns(5.0), points, pixels)
    tracker = Tracker(rsl.Localizer(CAMERA), remembers_motion=False)
    assert all(results(tracker, times[:4], [frames[0]] * 4))
