# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What frames after frames say of lens, map and pace: named with both numbers, or nothing."""

import re
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from benchmarks.frames.gross import frame
from benchmarks.independent.cameras import Camera
from benchmarks.independent.cameras import Camera as TrueCamera
from benchmarks.kinds import judged, kinds
from rs_localizer.config import CalibrationErrors, LocalizerConfig
from rs_localizer.core.reasons import Reason
from rs_localizer.core.types import Failure
from rs_localizer.lens_watch import LensWatch
from rs_localizer.pace_watch import PaceWatch
from rs_localizer.tracking import Tracker

from .moving import Moving, before, board, camera_of, squared

WELL = CalibrationErrors(0.1, 4e-4, 0.05, 4e-4)


def watched(bend: float, calibration: CalibrationErrors) -> LensWatch:
    """After 20 images of a volume whose corners are bent by so many px."""
    random = np.random.default_rng(1)
    camera, points, pixels, _ = frame("volume", "right", random)
    away = (pixels - camera.K[:2, 2]) / camera.focal_length
    bent = pixels + bend * (away**2).sum(axis=1)[:, None] * away
    tracker = Tracker(rsl.Localizer(camera, calibration=calibration), remembers_motion=False)
    for k in range(20):
        noisy = bent + random.normal(0.0, 0.05, bent.shape)
        assert tracker.localize(10**9 + 33_000_000 * k, points, noisy)
    return tracker.lens


def test_a_calibration_is_held_to_what_it_promises():
    """Of an ordinary one 0.2 px are no wonder, of a good one they are, and both are named."""
    fault = watched(3.5, WELL).fault
    assert "px rms), more than the deviations of calibration and map allow (0." in fault
    assert all(word in fault for word in ("another mode", "rectified", "stabilized"))
    usual = CalibrationErrors()
    for bend, calibration in ((3.5, usual), (0.0, usual), (0.0, WELL)):
        assert watched(bend, calibration).fault == ""


def test_two_frames_that_another_matrix_explains_refuse_all_until_they_are_old():
    watch = LensWatch(None, LocalizerConfig())
    other = Failure(Reason.CALIBRATION, "K is that of another image")
    random = np.random.default_rng(1)
    camera, *seen, _ = frame("volume", "right", random)
    found = rsl.Localizer(camera).localize(*seen)
    for _ in range(2):
        assert watch.refusal == ""
        watch.add(0, other, *seen)
        watch.add(0, found, *seen)
        watch.add(0, replace(other, reason=Reason.UNCERTAIN), *seen)
    assert watch.refusal == other.detail
    for _ in range(30):
        watch.add(0, found, *seen)
    assert watch.refusal == ""


@pytest.mark.parametrize(
    ("name", "published", "beyond", "said"),
    [
        ("right: board", 110, 0, ""),
        ("f of 1.9 times, board", 0, 9, "a focal length 0.5"),
        ("f of 0.6 times, facing board", 0, 50, "a focal length 1.6"),
        ("right: facing board", 110, 0, ""),
        ("f of 1.1 times, facing board", 110, 80, ""),
        ("K of 640 x 640, board", 15, 2, "a principal point"),
        ("K of 640 x 640, facing board", 110, 0, "a principal point"),
        ("squeezed by 2 %, corner", 110, 2, "fy over fx 0.98 times K's"),
        ("squeezed by 25 %, corner", 0, 6, "fy over fx 0.75"),
        ("map stretched by 1 %, wall", 110, 10, "a map that is longer by"),
    ],
)
def test_what_motion_hides_within_a_frame_frames_together_tell(name, published, beyond, said):
    """At least so many of 120 frames are published, and at most so many are beyond five.

    Three neighbours before a board that stays face-on fit any focal length.
    """
    (kind,) = [kind for kind in kinds() if kind.name == name]
    tallies = [judged(kind, seed) for seed in (3, 4)]
    assert sum(tally.published for tally in tallies) >= published
    assert sum(tally.beyond for tally in tallies) <= beyond
    texts = [text for tally in tallies for text in tally.texts.values() if "successive" in text]
    assert any(said in text for text in texts) if said else not texts


TRUE = TrueCamera(1280, 720, focal=900.0, distortion=(0.0,) * 5, readout_time=0.02)
CAMERA = camera_of(TRUE)
WALL = np.random.default_rng(1).uniform(-1.0, 1.0, (60, 3)) * [1.1, 0.7, 0.0]


def miscalibrated(focal: float = 1.0, across: float = 0.0) -> rsl.Camera:
    """The camera as K has it with so many times the focal length, and so many px beside."""
    K = CAMERA.K * np.diag([focal, focal, 1.0]) + CAMERA.K * (1.0 - np.eye(3))
    K[0, 2] += across
    return replace(CAMERA, K=K)


def board_before(moved: np.ndarray) -> Moving:
    """Of a board that moves: place (3,), angles (3,), and both per second."""
    place, angles, velocity, rates = moved.reshape(4, 3)
    way = before(lambda t: (Rotation.from_rotvec(angles + rates * t), place + velocity * t))
    return Moving(way, TRUE)


def followed(
    camera: rsl.Camera, points: np.ndarray, moved: np.ndarray, noise: float, longer: Any = 0.0
) -> Iterator[tuple[Tracker, Any, np.ndarray]]:
    """The tracker after each of 24 images, what it found, and its error (6,)."""
    random, tracker = np.random.default_rng(2), Tracker(rsl.Localizer(camera))
    moving = board_before(moved)
    for k in range(24):
        pixels = moving.pixels(k / 30 - 0.4, points)
        noisy = pixels + random.normal(0.0, noise, pixels.shape)
        found = tracker.localize(10**12 + 33_333_333 * k, points + longer, noisy)
        yield tracker, found, moving.error(found, k / 30 - 0.4)[:6] if found else None


@pytest.mark.parametrize("lost", [False, True])
def test_a_recording_with_gaps_shows_no_other_matrix(lost):
    """Stamps run on while the camera is elsewhere, or an image is lost: no parabola fits."""
    random, corners = np.random.default_rng(1), board(8, 6, 0.35, 0.25)
    usual, gaps = np.repeat([0.12, 0.2, 0.2, 0.3], 3), (2, 5)
    for _ in range(8):
        tracker = Tracker(rsl.Localizer(CAMERA))
        for k in range(6):
            if k == 0 or (k in gaps and not lost):
                moving = board_before(random.normal(0.0, usual) + np.eye(12)[2] * 0.6)
            image = k + (sum(k >= gap for gap in gaps) if lost else 0)
            pixels = moving.pixels(image / 30, corners)
            pixels += random.normal(0.0, 0.3, pixels.shape)
            tracker.localize(10**12 + 33_333_333 * k, corners, pixels)
            assert tracker.lens.fault == ""


@pytest.mark.parametrize(("angle", "surely"), [(0.7, True), (1.57, False)])
def test_a_map_that_is_longer_one_way_moves_as_frames_tell(angle, surely):
    """Errors of a map of a board of 1 m, which is longer by 1 % at this angle, before 1.6 m."""
    corners, along = board(9, 6, 1.0, 0.6), np.array([np.cos(angle), np.sin(angle), 0.0])
    moved = np.r_[0.0, 0.0, 1.6, 0.2, -0.3, 0.1, -0.2, 0.2, 0.1, 0.5, 0.6, -0.3]
    *_, (right, _, _) = followed(CAMERA, corners, moved, 0.1)
    assert right.lens.fault == ""
    stretch = right.lens.errors_of(None)
    assert stretch is None or np.abs(stretch.sizes).max() < 0.003
    longer = 0.01 * np.outer(corners @ along, along)
    *_, (tracker, _, _) = followed(CAMERA, corners, moved, 0.1, longer)
    # One half of it is a stretch that frames show, the other half that all is larger. Along the
    # columns fy over fx may have half of it.
    off = tracker.lens.errors_of(None).at(corners + longer).sum(axis=2) - longer
    assert np.linalg.norm(off) < (0.35 if surely else 0.6) * np.linalg.norm(longer)
    found = re.search(r"longer by (\S+) % along \((\S+), (\S+), (\S+)\)", tracker.lens.fault)
    assert (found is not None) == surely
    if found is not None:
        size, *way = map(float, found.groups())
        assert 0.8 < size < 1.2
        assert abs(way @ along) > 0.98


def test_a_wrong_lens_before_a_wall_is_no_part_of_it_that_moved():
    """Frames leave 3 px, as of errors that nobody knows, and looked like a part that moved."""
    moved, said = np.r_[0.0, 0.0, 2.0, 0.4, 0.3, 0.0, 0.4, 0.2, 0.1, 0.05, 0.2, 0.1], []
    for tracker, _, _ in followed(miscalibrated(0.8), WALL, moved, 0.3):
        assert tracker.moved is None
        said.append(tracker.lens.fault)
    assert "a focal length 1.2" in said[-1]
    assert all("a focal length 1.2" in each for each in said if each), said


@pytest.mark.parametrize("across", [0.0, 70.0])
def test_another_principal_point_before_a_wall_is_named(across):
    moved = np.r_[0.0, 0.0, 2.0, 0.5, 0.2, 0.0, 0.3, 0.2, 0.1, 0.6, 0.6, 0.3]
    *_, (tracker, _, _) = followed(miscalibrated(across=across), WALL, moved, 0.1)
    fault = tracker.lens.fault
    assert re.search(r"a principal point -[67]\d, ", fault) if across else not fault, fault


@pytest.mark.parametrize("share", [0.6, 0.8, 1.25])
def test_poses_allow_for_a_matrix_that_frames_doubt(share):
    """From there on no pose is beyond five deviations, and few are outside their regions."""
    moved = np.r_[0.0, 0.0, 1.0, 0.2, 0.35, 0.0, 0.3, 0.0, 0.1, 0.05, 0.2, 0.1]
    far = list[float]()
    for tracker, found, off in followed(miscalibrated(share), board(9, 6, 0.5, 0.3), moved, 0.3):
        if found and tracker.lens.doubted:
            far.append(squared(off, found.covariance))
    assert tracker.lens.doubted
    # Five deviations of six numbers; of 0.8, no pose is certain enough any more.
    assert max(far, default=0.0) < 42.0, far
    assert np.quantile(far or [0.0], 0.75) < 12.6, far


@pytest.mark.parametrize("seed", [1, 2])
def test_a_board_that_no_hypothesis_explains_is_refused(seed):
    (kind,) = [kind for kind in kinds() if kind.name == "f of 1.9 times, board"]
    assert judged(kind, seed).published < 30


SECOND = 10**9


@pytest.mark.parametrize(
    ("unit", "depth", "speed", "noise", "to_and_fro", "told"),
    [
        (1000.0, 2.0, 0.2, 0.01, True, "millimetres"),
        (1000.0, 2.0, 0.2, 0.01, False, "millimetres"),
        (100.0, 4.0, 0.4, 0.01, True, "centimetres"),
        (1000.0, 2.0, 0.0, 0.01, False, ""),
        (1.0, 100.0, 40.0, 0.1, False, ""),  # a car
        (1.0, 50.0, 4.0, 0.1, True, ""),  # a drone, 40 m/s^2
        (1.0, 100.0, 0.0, 30.0, False, ""),
    ],
)
def test_the_unit_of_a_map_is_named(unit, depth, speed, noise, to_and_fro, told):
    rng = np.random.default_rng(0)
    watch, told_of = PaceWatch(LocalizerConfig()), set()
    for i in range(90):
        # A hand at 1 Hz is after a second where it was: its mean speed is the same.
        way = speed * np.sin(2.0 * np.pi * i / 30.0) / 4.0 if to_and_fro else speed * i / 30.0
        place = np.array([way, 0.0, 2.0]) + rng.normal(0.0, noise, 3)
        covariance = np.diag(np.full(12, (unit * noise) ** 2))
        estimate: Any = SimpleNamespace(
            position=unit * place, rotation=np.eye(3), covariance=covariance, inliers=[0, 1, 2]
        )
        points = estimate.position + unit * depth * np.eye(3)[[2, 2, 2]]
        watch.add(i * SECOND // 30, estimate, points, lambda of=estimate: of)
        told_of |= {watch.fault} - {""}
    assert (watch.is_odd, watch.notice == "map_scale") == (bool(told), bool(told))
    for text in told_of:
        assert f"{unit * depth:.0f} m from the points: is the map in {told}?" in text
        assert f"by a factor of {1.0 / unit:g} (map align --scale)" in text
    if told:
        speeds = [float(text.split(" m/s")[0].split()[-1]) for text in told_of]
        assert np.median(speeds) == pytest.approx(unit * speed, rel=0.25)


def test_what_happened_while_nothing_was_seen_is_no_speed():
    """A robot that was carried elsewhere, or a map that was exchanged."""
    watch, covariance = PaceWatch(LocalizerConfig()), np.diag(np.full(12, 1e-4))
    for i in range(6):
        estimate: Any = SimpleNamespace(
            position=np.full(3, 1e3 * i),
            rotation=np.eye(3),
            covariance=covariance,
            inliers=[0, 1, 2],
        )
        points = estimate.position + 100.0 * np.eye(3)[[2, 2, 2]]
        watch.add(round(0.6 * i * SECOND), estimate, points, lambda of=estimate: of)
        assert watch.fault == ""


@pytest.mark.parametrize(
    ("unit", "apart", "said"),
    [
        (1.0, None, ""),
        (1000.0, None, "is the map in millimetres"),
        (1.0, 1.0, "alternate between two places, 1 m and"),
    ],
)
def test_a_tracker_names_the_unit_of_a_map_and_a_second_camera(unit, apart, said):
    true = Camera(1280, 720, focal=900.0, distortion=(0.0,) * 5, readout_time=0.02)
    rng, tracker = np.random.default_rng(1), rsl.Tracker(rsl.Localizer(camera_of(true)))
    room = rng.uniform([-1.5, -1.0, 2.0], [1.5, 1.0, 4.0], (60, 3))
    ways = [
        Moving(lambda t, x=x: (Rotation.from_rotvec([[0.0, 0.1, 0.0]] * t),
                               [x, 0.0, 0.0] + [0.2, 0.0, 0.0] * np.sin(2.0 * t)), true)
        for x in ((0.0,) if apart is None else (0.0, apart))
    ]  # fmt: skip
    for k in range(30):
        pixels = ways[k % len(ways)].pixels(k / 30.0, room)
        pixels += rng.normal(0.0, 0.3, pixels.shape)
        tracker.localize(10**12 + k * SECOND // 30, unit * room, pixels)
    assert (said in tracker.pace.fault) if said else not tracker.pace.fault
    assert tracker.lens.fault == ""
