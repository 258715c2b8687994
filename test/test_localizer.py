# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The whole method on frames of the independent projector; rotations are SciPy's."""

import copy
import gc
import multiprocessing
import pathlib
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import rs_localizer as rsl
from benchmarks.independent.cameras import Camera, Scan
from rs_localizer.config import NodeConfig
from rs_localizer.solvers.table import SOLVERS

from .moving import Moving, camera_of, resting, shown, squared

TRUE = Camera(focal=600.0, distortion=(-0.1, 0.02, 0.001, 0.001, 0.0))
READOUT = TRUE.readout_time
ROLLING = [name for name, row in SOLVERS.items() if row.rolling_shutter]


def camera(**changes):
    return camera_of(TRUE, **changes)


class Path(Moving):
    """A camera that turns at a constant body rate (rad/s) and moves straight (m/s, map axes)."""

    def __init__(self, seed=0, turn=2.0, speed=2.0, true=TRUE):
        rng = np.random.default_rng(seed)
        start = Rotation.random(random_state=seed)  # map_from_camera
        rate = turn * rng.normal(size=3) / np.sqrt(3)
        velocity = speed * rng.normal(size=3) / np.sqrt(3)
        centre = rng.uniform(-1, 1, 3)
        super().__init__(
            lambda t: (start * Rotation.from_rotvec(t * rate), centre + t * velocity), true
        )


def frame(path, count=80, noise=0.0, outliers=0.0, seed=0, depth=(2.0, 5.0)):
    """Points (n,3), raw pixels (n,2) and which are no outliers."""
    rng = np.random.default_rng(seed)
    local = np.column_stack([rng.uniform(-0.45, 0.45, (4 * count, 2)), np.ones(4 * count)])
    (rotation,), (position,) = path.pose([0.0])
    points = rotation.apply(local * rng.uniform(*depth, (4 * count, 1))) + position
    seen = path.frame(0.0, points, count, noise, outliers, seed)
    return *seen, np.arange(count) >= outliers * count


def angle(rotation, other):
    return np.degrees(Rotation.from_matrix(rotation @ other.T).magnitude())


def test_a_first_guess_of_infinite_variances_is_no_prediction():
    bent = replace(TRUE, distortion=(-0.08, *TRUE.distortion[1:]))
    points, pixels, _ = frame(Path(3, true=bent), noise=0.1)
    localizer = rsl.Localizer(camera())
    alone = localizer.localize(points, pixels)
    guess = rsl.Motion(
        alone.rotation, alone.translation, alone.angular_velocity, alone.linear_velocity
    )
    guessed = localizer.localize(
        points, pixels, prior=rsl.Prior(guess, np.diag(np.full(12, np.inf)))
    )
    assert alone.model_error > 0.2
    deviations = [np.sqrt(np.diag(found.covariance)) for found in (alone, guessed)]
    np.testing.assert_allclose(deviations[1], deviations[0], rtol=0.05)


@pytest.mark.parametrize("scan", Scan)
def test_pose_and_velocities_without_noise_have_the_right_size_sign_and_frame(scan):
    path = Path(1, true=replace(TRUE, scan=scan))
    localizer = rsl.Localizer(camera_of(path.true), velocity_prior=rsl.VelocityPrior(0.0, 0.0))
    result = localizer.localize(*frame(path)[:2])
    assert result
    np.testing.assert_allclose(path.error(result, 0.0), 0.0, atol=1e-6)
    np.testing.assert_allclose(result.translation, -result.rotation @ result.position, atol=1e-12)
    for tau in (-0.5, 0.3):
        truth, (rotation, translation) = path.motion(tau * READOUT), result.at(tau)
        assert angle(rotation, truth.rotation) < 1e-5
        position = -truth.rotation.T @ truth.translation
        np.testing.assert_allclose(-rotation.T @ translation, position, atol=1e-6)


@pytest.mark.parametrize("solver", ROLLING)
def test_every_rolling_shutter_solver_finds_inliers_and_pose(solver):
    localizer = rsl.Localizer(camera(), solver=solver)
    for seed in range(3):
        path = Path(seed)
        points, pixels, inliers = frame(path, 120, noise=0.5, outliers=0.4, seed=seed)
        result = localizer.localize(points, pixels)
        assert result, str(result)
        assert (result.inliers == inliers).mean() > 0.97
        turn, place, rate, _ = path.error(result, 0.0).reshape(4, 3)
        assert np.degrees(np.linalg.norm(turn)) < 0.3
        assert np.linalg.norm(place) < 0.03
        assert np.degrees(np.linalg.norm(rate)) < 0.8
        assert 0.3 < result.residual_rms / np.sqrt(2) < 0.7


def test_p3p_is_a_global_shutter_and_knows_no_motion():
    still, moving = Path(3, 0.0, 0.0), Path(3, 3.0, 2.0)
    localizer = rsl.Localizer(camera(), solver="p3p")
    points, pixels, inliers = frame(still, 100, noise=0.5, outliers=0.3)
    result = localizer.localize(points, pixels)
    assert (result.inliers == inliers).mean() > 0.97
    assert angle(result.rotation, still.motion(0.0).rotation) < 0.2
    np.testing.assert_allclose(result.angular_velocity, 0.0, atol=1e-12)
    np.testing.assert_allclose(result.linear_velocity, 0.0, atol=1e-12)
    points, pixels, inliers = frame(moving, 100, noise=0.5, outliers=0.3)
    lost = localizer.localize(points, pixels)
    assert not lost or lost.inliers.sum() < 0.5 * inliers.sum()
    assert rsl.Localizer(camera()).localize(points, pixels).inliers.sum() > 0.95 * inliers.sum()


FRAMES = [frame(Path(seed), 60, 0.5, 0.3, seed)[:2] for seed in (1, 2)]


def assert_same_bits(found):
    expected = [rsl.Localizer(camera()).localize(*each) for each in FRAMES]
    assert not np.array_equal(expected[0].rotation, expected[1].rotation)
    for given, wanted in zip(found, expected, strict=True):
        for name in ("rotation", "translation", "angular_velocity", "linear_velocity",
                     "covariance", "inliers", "residuals"):  # fmt: skip
            np.testing.assert_array_equal(getattr(given, name), getattr(wanted, name))


def test_arrays_that_are_read_only_or_anywhere_in_memory_are_taken():
    anywhere = [
        np.concatenate([[np.uint8(0)], each.ravel().view(np.uint8)])[1:].view(float)
        for each in FRAMES[0]
    ]
    assert not any(each.flags.aligned for each in anywhere)
    points, pixels = anywhere[0].reshape(-1, 3), anywhere[1].reshape(-1, 2)
    read_only = [each.copy() for each in FRAMES[1]]
    for each in read_only:
        each.flags.writeable = False
    localizer = rsl.Localizer(camera())
    for _ in range(2):  # and no frame remembers one before
        assert_same_bits([localizer.localize(points, pixels), localizer.localize(*read_only)])


def test_two_threads_on_one_localizer_get_what_each_would_get_alone():
    localizer = rsl.Localizer(camera())
    with ThreadPoolExecutor(2) as pool:
        for _ in range(20):
            work = [pool.submit(localizer.localize, *each) for each in FRAMES]
            assert_same_bits([each.result() for each in work])


@pytest.mark.parametrize("how", ["fork", "spawn"])
@pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning")
def test_other_processes_get_the_same_from_a_localizer_that_is_sent(how):
    localizer = rsl.Localizer(camera())
    localizer.localize(*FRAMES[0])  # which does not go along
    with multiprocessing.get_context(how).Pool(1) as pool:
        assert_same_bits(pool.starmap_async(localizer.localize, FRAMES).get(60))


def resident():
    """kB of this process that are in memory."""
    return int(re.search(r"VmRSS:\s+(\d+)", pathlib.Path("/proc/self/status").read_text())[1])


@pytest.mark.parametrize("count", [1000, pytest.param(10_000, marks=pytest.mark.bench)])
def test_memory_stays_as_it_is_from_frame_to_frame(count):
    localizer = rsl.Localizer(camera())
    tracker, rng = rsl.Tracker(localizer), np.random.default_rng(0)
    nonsense = FRAMES[0][0], rng.uniform([0, 0], [639, 479], (60, 2))
    before = 0
    for k in range(count):
        localizer.localize(*FRAMES[k % 2])
        tracker.localize(33_000_000 * k, *(nonsense if k % 10 == 9 else FRAMES[0]))
        if k == 200:
            gc.collect()
            before = resident()
    gc.collect()
    assert resident() < before + 2000


def test_a_far_origin_and_turned_map_change_nothing_but_the_map():
    points, pixels, _ = frame(Path(4), 80, 0.5, 0.3)
    here = rsl.Localizer(camera()).localize(points, pixels)
    turn, shift = Rotation.random(random_state=5).as_matrix(), np.array([5e6, -4e6, 3e5])
    there = rsl.Localizer(camera()).localize(points @ turn.T + shift, pixels)
    assert angle(there.rotation, here.rotation @ turn.T) < 1e-4
    np.testing.assert_allclose(there.position, turn @ here.position + shift, atol=1e-5)
    np.testing.assert_allclose(there.linear_velocity, here.linear_velocity, atol=1e-5)
    np.testing.assert_array_equal(there.inliers, here.inliers)


def test_numbers_of_other_types_are_those_of_the_settings():
    points, pixels = FRAMES[0]
    given = {
        "inlier_threshold": 2, "confidence": np.float32(0.5), "map_deviation": Fraction(1, 128),
        "solver_iterations": np.int32(50), "min_inliers": np.int64(9),
    }  # fmt: skip
    plain = {name: type(getattr(NodeConfig(), name))(value) for name, value in given.items()}
    found = [
        rsl.Localizer(camera(readout_time=time), **numbers).localize(points, pixels)
        for time, numbers in ((Fraction(1, 32), given), (1 / 32, plain))
    ]
    later = [found[0].at_time(seconds) for seconds in (np.float32(0.25), 0.25)]
    for one, other in (found, later):
        np.testing.assert_array_equal(one.rotation, other.rotation)
        np.testing.assert_array_equal(one.covariance, other.covariance)


def test_random_matches_have_no_pose():
    rng = np.random.default_rng(0)
    localizer = rsl.Localizer(camera())
    for count, times in [(100, 1)] * 8 + [(30, 3)] * 8:
        points = rng.uniform([-2, -2, 3], [2, 2, 7], (count, 3)).repeat(times, axis=0)
        pixels = rng.uniform([0, 0], [639, 479], (count, 2)).repeat(times, axis=0)
        result = localizer.localize(points, pixels + (times > 1) * rng.normal(size=pixels.shape))
        assert not result
        assert result.reason == rsl.Reason.RESIDUAL or (
            "8 are needed" in result.detail or "fit by chance" in result.detail
        )


def test_few_points_with_much_noise_have_a_pose_that_says_so():
    squares = []
    for seed in range(24):
        path = Path(seed, turn=0.5, speed=0.5)
        points, pixels, _ = frame(path, 8 + seed % 3, 3.0, seed=seed)
        found = rsl.Localizer(camera()).localize(points, pixels)
        if found:
            squares.append(squared(path.error(found, 0.0)[:6], found.covariance))
    assert len(squares) > 21
    assert np.mean(np.array(squares) < chi2.ppf(0.95, 6)) > 0.85


def test_near_and_far_points_together_have_a_pose():
    rng = np.random.default_rng(1)
    for seed in range(60):
        path = Path(seed, turn=0.5, speed=0.1)
        depth = np.where(np.arange(150) < 75, 0.15, 100.0) * rng.uniform(0.7, 1.0, 150)
        local = np.column_stack([rng.uniform(-0.45, 0.45, (150, 2)), np.ones(150)])
        (rotation,), (position,) = path.pose([0.0])
        points = rotation.apply(local * depth[:, None]) + position
        assert rsl.Localizer(camera()).localize(*path.frame(0.0, points, 150, 0.5, seed=seed))


RNG = np.random.default_rng(0)
ANYWHERE, NORMAL = RNG.uniform([0, 0], [639, 479], (30, 2)), RNG.normal(size=(30, 3))
ADVERSARIAL = {
    "one point": (np.ones((30, 3)), ANYWHERE),
    "one pixel": (NORMAL, np.full((30, 2), 100.0)),
    "all the same": (np.ones((30, 3)), np.full((30, 2), 100.0)),
    "a line": (np.outer(np.arange(30), [1.0, 2.0, 3.0]), ANYWHERE),
    "one row": (NORMAL, np.column_stack([ANYWHERE[:, 0], np.full(30, 7.0)])),
    "huge points": (1e200 * NORMAL, ANYWHERE),
    "tiny points": (1e-200 * NORMAL, ANYWHERE),
    "far pixels": (NORMAL, 1e12 * ANYWHERE),
}


@pytest.mark.parametrize("name", ADVERSARIAL)
@pytest.mark.parametrize("solver", ["p3p", "r6p_vcwt", "r9p", "joint"])
def test_no_input_crashes_or_warns(solver, name):
    result = rsl.Localizer(camera(D=np.zeros(0)), solver=solver).localize(*ADVERSARIAL[name])
    if result:
        assert np.isfinite(result.covariance).all()
        assert np.isfinite(result.rotation).all()


def test_points_on_a_line_leave_no_rotation_that_is_none():
    rng = np.random.default_rng(0)
    along = rng.uniform(-0.4, 0.4, 60)
    line = np.column_stack([along, 0.75 * along, np.full(60, 1.2)])
    pixels = shown(TRUE, resting, line)
    for seed in (*range(50, 80), *range(250, 280)):
        noise = 0.4 * np.random.default_rng(seed).normal(size=pixels.shape)
        found = rsl.Localizer(camera()).localize(line, pixels + noise)
        if found:
            np.testing.assert_allclose(found.rotation @ found.rotation.T, np.eye(3), atol=1e-6)


@pytest.mark.parametrize("distinct", [6, 20])
def test_copies_of_points_are_no_further_evidence(distinct):
    points, pixels, _ = frame(Path(), count=distinct, noise=1.0)
    localizer = rsl.Localizer(camera())
    once = localizer.localize(points, pixels)
    copied = localizer.localize(np.repeat(points, 10, axis=0), np.repeat(pixels, 10, axis=0))
    assert bool(copied) == bool(once) == (distinct > 8)
    if once and copied:
        np.testing.assert_allclose(copied.covariance, once.covariance, rtol=1e-9)
        assert np.array_equal(copied.inliers, np.repeat(once.inliers, 10))


def test_a_landmark_that_is_matched_wrongly_again_and_again_is_one_witness():
    """Detectors find a corner on several scales: some were a body that turned by 26 deg."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        points, pixels, right = frame(Path(), count=120, noise=0.3, outliers=0.05, seed=seed)
        several = np.repeat(pixels, 3, axis=0) + 0.3 * rng.normal(size=(360, 2))
        found = rsl.Localizer(camera()).localize(np.repeat(points, 3, axis=0), several)
        once = rsl.Localizer(camera()).localize(points, several[::3])
        np.testing.assert_allclose(found.covariance, once.covariance, rtol=1e-9)
        assert np.mean(found.inliers == np.repeat(right, 3)) > 0.97


def test_gravity_that_contradicts_the_points_is_named():
    points, pixels, _ = frame(Path(1), noise=0.3)
    localizer = rsl.Localizer(camera())
    down = localizer.localize(points, pixels).rotation @ [0.0, 0.0, -1.0]
    across = np.cross(down, [1.0, 0.0, 0.3])
    wrong = rsl.Prior(gravity=across, gravity_deviation=1e-3)
    failure = localizer.localize(points, pixels, prior=wrong)
    assert failure.reason == rsl.Reason.PRIOR
    assert "1.6 rad off gravity, given to 0.001" in failure.detail
    right = rsl.Prior(gravity=down, gravity_deviation=0.02)
    assert localizer.localize(points, pixels, prior=right)


def test_what_users_mistake_is_named():
    points, pixels, _ = frame(Path())
    localizer = rsl.Localizer(camera(), inlier_threshold=3.0)
    assert "640x480, " in repr(localizer)
    assert "inlier_threshold=3.0" in repr(localizer)
    of_a_node = rsl.Localizer(camera(), NodeConfig(inlier_threshold=3.0, readout_time=0.01))
    assert repr(of_a_node) == repr(localizer)
    degrees = rsl.Prior(angular_velocity=(0.0, 30.0, 0.0), angular_velocity_deviation=0.1)
    with pytest.raises(ValueError, match="is it in rad/s, or in degrees"):
        localizer.localize(points, pixels, prior=degrees)
    with pytest.raises(TypeError, match="positional"):
        localizer.localize(points, pixels, None, degrees)
    normalized = localizer.localize(points, (pixels - TRUE.centre) / TRUE.focal)
    assert normalized.reason == rsl.Reason.DEGENERATE
    assert "normalized coordinates" in normalized.detail
    failure = localizer.localize(points[:5], pixels[:5])
    assert copy.deepcopy(failure) == failure


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((np.zeros((4, 2)), np.zeros((4, 2))), r"points must be \(n,3\)"),
        ((np.zeros((4, 3)), np.zeros((5, 2))), r"got \(4, 3\) and \(5, 2\)"),
        ((np.zeros((4, 3)), np.full((4, 2), np.nan)), "pixels must be finite"),
        ((np.zeros((4, 3)), np.ma.masked_equal(np.eye(4, 2), 1)), "pixels must .* masked"),
        ((None, np.zeros((4, 2))), "points must be numbers, got None"),
        (([[1, 2, 3], [1, 2]], np.zeros((2, 2))), r"points must be numbers, got \[\[1, 2, 3\]"),
        ((np.zeros((4, 3)), np.zeros((4, 2)), rsl.Prior()), r"scores must be .* got Prior\("),
        ((np.full((4, 3), np.inf), np.zeros((4, 2))), "points must be finite"),
        ((np.zeros((4, 3)), np.zeros((4, 2)), np.zeros(3)), r"scores must be \(4,\), got \(3,\)"),
    ],
)
def test_wrong_arrays_are_refused_with_what_was_found(arguments, said):
    with pytest.raises(ValueError, match=said):
        rsl.Localizer(camera()).localize(*arguments)


def test_points_that_a_map_of_known_deviation_has_elsewhere_are_inliers():
    deviation, rng = 0.02, np.random.default_rng(5)
    points, pixels, _ = frame(Path(), count=120, noise=0.3, depth=(2.5, 4.0))
    localizer = rsl.Localizer(camera(), rsl.LocalizerConfig(map_deviation=deviation))
    result = localizer.localize(points + deviation * rng.normal(size=points.shape), pixels)
    assert result
    # 3.7 px of each coordinate: a gate of 3 px, or of twice that, would keep a half of them.
    assert result.inliers.mean() > 0.95
