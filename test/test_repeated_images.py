# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images that come again bit for bit: of a camera that rests, or of a stream that hangs.

Frames are those of the independent projector, each point at the time of its own row.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from benchmarks.independent.cameras import Camera
from rs_localizer.inertial.gyro_prior import GyroscopeTrack
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.status import InertialSettings
from rs_localizer.tracking import Tracker

from .moving import camera_of, inside
from .moving import shown as expose

RATE = 30.0
TRUE = Camera(focal=500.0, distortion=(0.0,) * 5)
CAMERA = camera_of(TRUE)
MAP = np.random.default_rng(0).uniform([-2.0, -1.5, 2.5], [2.0, 1.5, 5.0], (300, 3))


def still(t):
    return np.zeros((len(t), 3)), np.zeros((len(t), 3))


def hand(t):
    """Rotation vectors and places, map_from_camera, at t s: some 0.9 rad/s all the time."""
    return (
        0.12 * np.sin(2.0 * np.pi * t[:, None] + np.arange(3)),
        0.05 * np.sin(1.6 * np.pi * t[:, None] + np.array([2.0, 0.0, 1.0])),
    )


# s. One that ends as an image is exposed counts as hung: one in four (docs/limits.md).
STOP = 0.32


def stopping(t):
    """60 deg/s and 0.5 m/s that end within STOP."""
    late = np.clip((t - 0.5) / STOP, 0.0, 1.0)
    gone = (np.minimum(t, 0.5) + STOP * late * (1.0 - 0.5 * late))[:, None]
    return np.radians(60.0) * gone * [0.6, 0.0, 0.8], 0.5 * gone * [1.0, 0.0, 0.0]


def shown(moving, t, noise=0.0, seed=0, shift=(0.0, 0.0, 0.0)):
    """Points (n,3) and pixels (n,2) of an image whose middle row is exposed at t.

    ``shift``: of points, from the axes that move to the camera's.
    """

    def pose(after):
        turns, places = moving(t + after)
        rotations = Rotation.from_rotvec(turns)
        return rotations, places - rotations.apply(shift)

    pixels = expose(TRUE, pose, MAP)
    seen = np.flatnonzero(inside(TRUE, pixels, margin=2.0))[:60]
    pixels = pixels[seen] + noise * np.random.default_rng(seed).normal(size=(len(seen), 2))
    return MAP[seen], pixels


def ns(t):
    return round((t + 1.0) * 1e9)


def results(tracker, times, frames):
    """Result of each frame, or the reason why there is none."""
    found = [tracker.localize(ns(t), *frame) for t, frame in zip(times, frames, strict=True)]
    return [result if result else result.reason for result in found]


@pytest.fixture(scope="module")
def held():
    """Frames of a hand, some of them twice."""
    times = np.arange(60) / 20.0
    return times, [shown(hand, t, 0.3, k) for k, t in enumerate(times)]


def angle(result, t):
    """Error of the orientation, deg."""
    return np.degrees(
        (
            Rotation.from_matrix(result.rotation) * Rotation.from_rotvec(hand(np.array([t]))[0][0])
        ).magnitude()
    )


def test_a_still_scene_without_noise_is_used_and_grows_no_surer():
    times = np.arange(300) / RATE  # 10 s
    found = results(Tracker(rsl.Localizer(CAMERA)), times, [shown(still, 0.0)] * 300)
    assert all(isinstance(result, rsl.Estimate) for result in found)
    deviations = [result.orientation_deviation for result in found]
    assert min(deviations) > 0.999 * deviations[0]
    assert [result.time_ns for result in found] == [ns(t) for t in times]


def test_noise_that_repeats_counts_once():
    """The same noisy image for a second; beside it, new ones make the orientation surer."""
    times = np.arange(30) / RATE
    tracker = Tracker(rsl.Localizer(CAMERA))
    found = results(tracker, times, [shown(still, 0.0, 0.3)] * 30)
    assert tracker.repeats
    new = results(tracker, times + 1.0, [shown(still, 0.0, 0.3, seed) for seed in range(1, 31)])
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
    assert max(angle(result, t) for result, t in poses) < 0.3  # 17 deg where they were used
    # The track goes on over one that is refused.
    assert sum(result.tracked for result, _ in poses) >= len(poses) - 2


def test_a_sudden_stop_is_no_hanging_stream():
    """In a simulator without noise."""
    times = np.arange(45) / RATE
    at = [min(t, 0.5 + STOP) for t in times]
    frames = [shown(stopping, t) for t in at]
    found = results(Tracker(rsl.Localizer(CAMERA)), times, frames)
    assert all(isinstance(result, rsl.Estimate) for result in found)


def test_a_gyroscope_tells_a_resting_image_from_a_hanging_one():
    times = np.arange(10) / 20.0

    def run(rate):
        settings = InertialSettings(1e-4, 1e-5, time_offset_deviation=1e-3)
        aid = GyroscopeTrack(settings, CAMERA.readout_time)
        tracker = Tracker(rsl.Localizer(CAMERA), aid)
        stamps = np.arange(ns(-1.0), ns(1.0), 2_000_000)
        found = []
        for k, t in enumerate(times):
            turning = np.where(stamps[:, None] > ns(times[4] + 0.02), rate, 0.0) * np.array(
                [0.0, 1.0, 0.0]
            )
            until = stamps < ns(t + 0.03)
            samples = ImuSamples(stamps[until], turning[until])
            frame = shown(still, 0.0, 0.3, min(k, 4))
            found.append(bool(tracker.localize(ns(t), *frame, readings=samples)))
        return found

    assert run(0.0) == [True] * 10
    assert run(0.3) == [True] * 5 + [False] * 5


def test_a_camera_of_a_rig_that_hangs_is_named():
    shifts = {"left": np.array([0.1, 0.0, 0.0]), "right": np.array([-0.1, 0.0, 0.0])}
    rig = rsl.Rig(dict.fromkeys(shifts, CAMERA), {k: (np.eye(3), s) for k, s in shifts.items()})
    tracker, times = Tracker(rsl.Localizer(rig)), np.arange(4) / 20.0
    frames = [{k: shown(hand, t, 0.3, 0, s) for k, s in shifts.items()} for t in times]
    frames[2] = frames[2] | {"right": frames[1]["right"]}
    found = [tracker.localize(ns(t), frame) for t, frame in zip(times, frames, strict=True)]
    assert [bool(result) for result in found] == [True, True, False, True]
    assert found[2].reason == "repeated_image"
    assert "the pixels of right are those" in found[2].detail


def test_a_frame_without_images_repeats_none():
    rig = rsl.Rig({"a": CAMERA}, {"a": (np.eye(3), np.zeros(3))})
    tracker = Tracker(rsl.Localizer(rig))
    assert tracker.localize(ns(0.0), {"a": shown(hand, 0.0)})
    with pytest.raises(ValueError, match="the frame has no image"):
        tracker.localize(ns(0.1), {})


def test_what_is_no_image_that_came_before(held):
    """An array that is used again; and any image where no prediction says that the camera moves."""
    times, frames = held
    tracker = Tracker(rsl.Localizer(CAMERA))
    points, pixels = (np.empty_like(part) for part in frames[0])
    for t, frame in zip(times[:4], frames, strict=False):
        count = min(len(pixels), len(frame[1]))
        points[:count], pixels[:count] = frame[0][:count], frame[1][:count]
        assert tracker.localize(ns(t), points[:count], pixels[:count])
        assert not tracker.repeats
    tracker.reset()
    assert tracker.localize(ns(5.0), points[:count], pixels[:count])
    tracker = Tracker(rsl.Localizer(CAMERA), remembers_motion=False)
    assert all(results(tracker, times[:4], [frames[0]] * 4))
