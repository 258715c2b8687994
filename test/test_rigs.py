# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses of rigs, against the independent simulator, which shares no line with the estimator."""

import copy
import pickle
import re
from dataclasses import fields, replace
from functools import partial

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from benchmarks.aided import believed
from benchmarks.independent.cameras import Camera as TrueCamera
from benchmarks.independent.cameras import Scan
from benchmarks.independent.motions import hand, steady
from benchmarks.independent.rigs import Mounted, Scene, middle_of, noisy_frames, views
from benchmarks.independent.rotations import exponential, logarithm
from benchmarks.independent.scenes import visible
from rs_localizer.config import CalibrationErrors
from rs_localizer.core.types import Estimate
from rs_localizer.inertial.gyro_prior import GyroscopeTrack
from rs_localizer.inertial.status import InertialSettings

from .moving import AT_REST, error_of, squared

UPRIGHT, TURNED = np.eye(3), np.diag([-1.0, -1.0, 1.0])
ASKEW = exponential(np.array([0.2, -2.5, 0.4]))
BESIDE = np.array([-0.1, 0.02, 0.03])
TRUE = TrueCamera()


def pair(rotation=TURNED, translation=BESIDE, start=0.0, **camera):
    """Two cameras, the second of which is turned and begins later."""
    return {
        "one": Mounted(TRUE, UPRIGHT, np.zeros(3)),
        "other": Mounted(replace(TRUE, **camera), rotation, translation, start),
    }


def rig_of(mounted, **more):
    cameras = {name: believed(each.camera) for name, each in mounted.items()}
    places = {name: (each.rotation, each.translation) for name, each in mounted.items()}
    return rsl.Rig(cameras, places, **more)


def frames(mounted, make, count, points=40, noise=0.0, scene=Scene.RICH, seed=0, outliers=0.0):
    """Frames of {name: (points, pixels)}, and motions with the times at which these begin."""
    rng = np.random.default_rng(seed)
    motions, begin = make(count, rng), np.zeros(count)
    seen = views(mounted, motions, begin, points, scene, rng)
    return list(noisy_frames(seen, noise, outliers, rng)), motions


def fast(count, rng):
    return steady(count, rng, 1.5, 0.8)


def stamps_of(mounted):
    return {name: 100.0 + each.start for name, each in mounted.items()}


def errors(result, motions, frame, time):
    """rad, m, rad/s and m/s."""
    states = motions.states(np.array([frame]), np.array([time]))
    turn = logarithm(result.rotation @ states.rotation[0])
    return np.array([
        np.linalg.norm(turn), np.linalg.norm(result.position - states.position[0]),
        np.linalg.norm(result.angular_velocity / result.span - states.angular[0]),
        np.linalg.norm(result.linear_velocity / result.span - states.linear[0]),
    ])  # fmt: skip


@pytest.mark.parametrize("scan", Scan)
def test_exact_points_of_askew_cameras_give_the_motion(scan):
    """Any mounting, scan direction, readout and delay; the wrong sign of a lever arm does not."""
    mounted = pair(ASKEW, BESIDE, 0.012, scan=scan, readout_time=0.02)
    made, motions = frames(mounted, fast, 3)
    rig, stamps = rig_of(mounted), stamps_of(mounted)
    for frame, parts in enumerate(made):
        result = rsl.Localizer(rig).localize(parts, stamps=stamps)
        assert result, result
        assert result.span == pytest.approx(0.032)
        assert result.time == pytest.approx(100.0 + middle_of(mounted))
        off = errors(result, motions, frame, middle_of(mounted))
        assert np.all(off < [1e-4, 3e-4, 2e-2, 2e-2]), off
        assert all(result.inliers[name].all() for name in parts)
        for copied in (pickle.loads(pickle.dumps(result)), copy.deepcopy(result)):
            for name in parts:
                np.testing.assert_array_equal(copied.residuals[name], result.residuals[name])
        there = result.at_time(100.0)  # not the middle
        assert there.time == 100.0
        state = motions.states(np.array([frame]), np.zeros(1))
        np.testing.assert_allclose(there.position, state.position[0], atol=1e-3)
        si = rsl.camera_state(result, rig)
        np.testing.assert_allclose(si.angular_velocity * result.span, result.angular_velocity)
    wrong = rig_of(pair(ASKEW, -BESIDE, 0.012, scan=scan, readout_time=0.02))
    result = rsl.Localizer(wrong).localize(made[0], stamps=stamps)
    assert not result or errors(result, motions, 0, middle_of(mounted))[1] > 0.01


def test_the_estimate_is_that_of_plain_least_squares():
    mounted = pair(ASKEW, BESIDE, 0.012, scan=Scan.UP, readout_time=0.02)
    config, middle = rsl.LocalizerConfig(calibration=CalibrationErrors(0.0, 0.0, 0.0, 0.0)), 0.016
    speed, change = config.velocity_prior, config.acceleration
    known = np.repeat([speed.angular, speed.linear, change.angular, change.linear], 3)
    for parts in frames(mounted, fast, 3, noise=0.5)[0]:
        result = rsl.Localizer(rig_of(mounted), config).localize(parts, stamps=stamps_of(mounted))
        assert result, result
        first = Rotation.from_matrix(result.rotation.T)

        def errors_of(x, parts=parts, first=first, near=result.position):
            turn, move, rate, velocity, twist, push = x.reshape(6, 3)
            of = [x[6:] / known]
            for name, (points, pixels) in parts.items():
                camera = mounted[name].camera
                down = pixels[:, 1] / (camera.height - 1)
                rows = 1.0 - down if camera.scan == Scan.UP else down
                t = (mounted[name].start + camera.readout_time * rows - middle)[:, None]
                turned = first * Rotation.from_rotvec(turn)
                there = near + move + turned.apply(velocity * t + 0.5 * push * t**2)
                now = turned * Rotation.from_rotvec(rate * t + 0.5 * twist * t**2)
                local = now.inv().apply(points - there) @ mounted[name].rotation.T
                lens, nowhere = np.array(camera.distortion), np.zeros(3)
                local += mounted[name].translation
                seen, _ = cv2.projectPoints(local, nowhere, nowhere, camera.matrix, lens)
                of.append((seen.reshape(-1, 2) - pixels).ravel() / 0.5)
            return np.concatenate(of)

        best = least_squares(errors_of, np.zeros(18)).x
        velocities = np.concatenate([result.angular_velocity, result.linear_velocity])
        apart = np.concatenate([
            best[:3], result.rotation @ best[3:6], best[6:12] * result.span - velocities
        ])  # fmt: skip
        # A fifth of a deviation of each, by mounts and lenses that are known to a tenth of a pixel.
        assert squared(apart, result.covariance) < 0.6


def test_a_camera_alone_is_a_rig_of_one():
    alone = {"one": Mounted(TRUE, UPRIGHT, np.zeros(3))}
    rig = rig_of(alone)
    camera = rig.cameras["one"]
    for scene in (Scene.RICH, Scene.WALL):
        made, _ = frames(alone, hand, 4, 80, 0.7, scene, outliers=0.3)
        for parts in made:
            points, pixels = parts["one"]
            scores = np.arange(len(points), dtype=float)
            plain = rsl.Localizer(camera).localize(points, pixels, scores)
            result = rsl.Localizer(rig).localize({"one": (points, pixels, scores)})
            assert bool(plain) == bool(result)
            for each in fields(Estimate) if plain else ():
                expected, got = getattr(plain, each.name), getattr(result, each.name)
                if isinstance(expected, np.ndarray):
                    assert np.asarray(got).tobytes() == expected.tobytes(), each.name


def test_opposed_shutters_know_the_motion_before_a_wall():
    """A single image of a plane does not determine it; nor do two that are mounted alike."""
    off = {}
    for name, rotation in (("opposed", TURNED), ("alike", UPRIGHT)):
        mounted = pair(rotation)
        faster = partial(steady, rate=3.0, speed=2.0)
        made, motions = frames(mounted, faster, 12, 76, 1.0, Scene.WALL, seed=3)
        localizer = rsl.Localizer(rig_of(mounted))
        results = [localizer.localize(parts) for parts in made]
        off[name] = np.array([
            errors(result, motions, frame, middle_of(mounted))
            for frame, result in enumerate(results) if result
        ])  # fmt: skip
        if name == "opposed":
            assert all(results), [str(result) for result in results if not result]
    middle = np.median(off["opposed"], axis=0)
    # The bound of 152 points at 1 px, without a prior: 0.09 deg, 4.3 mm, 9.7 deg/s, 0.48 m/s.
    assert np.all(middle < [np.radians(0.12), 6e-3, np.radians(13.0), 0.65]), middle
    assert np.all(np.median(off["alike"], axis=0)[:2] > 2.0 * middle[:2])


def test_tracking_carries_a_rig_from_frame_to_frame():
    """Frames whose cameras are now in step and now not, so that velocities are per other spans; the
    motion of one predicts the next, and before a wall makes it better.
    """
    rng = np.random.default_rng(5)
    motions = fast(1, rng)
    alone, tracked = [], []
    rig = rig_of(pair(UPRIGHT))
    localizer = rsl.Localizer(rig)
    tracker = rsl.Tracker(localizer)
    for frame in range(12):
        mounted = pair(UPRIGHT, start=0.01 * (frame % 3))
        begin = frame / 30.0
        seen = views(mounted, motions, np.array([begin]), 40, Scene.WALL, rng)
        parts = {
            name: (view.points[0], view.exact[0] + 0.5 * rng.normal(size=view.exact[0].shape))
            for name, view in seen.items()
        }
        stamps = {name: each.start for name, each in mounted.items()}
        single = localizer.localize(parts, stamps=stamps)
        result = tracker.localize(round(1e9 * begin) + 10**12, parts, stamps=stamps)
        assert result, result
        assert result.time == pytest.approx(middle_of(mounted))
        for each, found in ((single, alone), (result, tracked)):
            if each and frame > 2:
                found.append(errors(each, motions, 0, begin + middle_of(mounted)))
        assert result.tracked == (frame > 0)
    assert np.all(np.mean(tracked, axis=0)[:2] < 0.7 * np.mean(alone, axis=0)[:2])
    with pytest.raises(ValueError, match="several cameras"):
        rsl.Tracker(localizer, GyroscopeTrack(InertialSettings(1e-3, 1e-4), 0.03))


@pytest.mark.parametrize(("wrong", "said"), [
    (lambda camera: camera, ""),
    (lambda camera: replace(camera, translation=np.array([0.0, 0.03, 0.0]) + camera.translation),
     r"other is 0\.0(2[5-9]|3[0-5]?) m from its mount"),
    (lambda camera: replace(camera, rotation=exponential(np.array([0.0, 0.0, 0.02]))),
     r"other is rotated by 1\.\d+ deg"),
    (lambda camera: replace(camera, start=0.008), r"other is exposed [78](\.\d+)? ms later"),
    (lambda camera: replace(camera, camera=replace(TRUE, focal=1.02 * TRUE.focal)), ""),
])  # fmt: skip
def test_what_one_camera_has_wrong_widens_and_is_named(wrong, said):
    """Errors of its mount, lens and clock are errors that its points share."""
    rng, told = np.random.default_rng(7), pair(UPRIGHT)
    true = {**told, "other": wrong(told["other"])}
    motions = hand(1, rng)
    landmarks = views(told, motions, np.zeros(1), 80, Scene.RICH, rng)
    tracker, far = rsl.Tracker(rsl.Localizer(rig_of(told))), []
    for frame in range(-12, 12):
        parts, begin = {}, frame / 30.0
        for name, each in true.items():
            points = landmarks[name].points[0]
            pixels = each.seen(motions, np.zeros(1, int), np.array([begin]), points[None])[0]
            shown = visible(each.camera, pixels[None])[0]
            noise = rng.normal(0.0, 0.3, (shown.sum(), 2))
            parts[name] = points[shown], pixels[shown] + noise
        result = tracker.localize(round(1e9 * begin) + 10**15, parts)
        assert result, result
        state = motions.states(np.zeros(1, int), np.array([begin + middle_of(told)]))
        rotation = state.rotation[0].T
        truth = replace(AT_REST, rotation=rotation, translation=-rotation @ state.position[0])
        far.append(squared(error_of(result, truth)[:6], result.covariance))
    assert np.mean(np.array(far) < 12.6) > 0.9, far
    assert max(far) < 25.0
    assert re.search(said, tracker.cameras.fault) if said else not tracker.cameras.fault
