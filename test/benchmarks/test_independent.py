# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The second simulator against SciPy's rotations, OpenCV's lens, and finite differences."""

import re
import sys
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import benchmarks.independent
from benchmarks.frames.conditions import Condition, moving
from benchmarks.frames.judged import judge
from benchmarks.independent import motions, rotations
from benchmarks.independent.cameras import Camera, Scan
from benchmarks.independent.frames import simulate
from benchmarks.independent.motions import rest
from benchmarks.independent.scenes import Board, Rich

STEP = 1e-5


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.99e-4, 1.01e-4, 0.1, 3.0])
def test_rotations_are_those_of_scipy(angle):
    rng = np.random.default_rng(0)
    vectors = angle * motions.directions(20, rng)
    found = rotations.exponential(vectors)
    np.testing.assert_allclose(found, Rotation.from_rotvec(vectors).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(rotations.logarithm(found), vectors, atol=1e-12, rtol=1e-8)


def test_the_lens_is_that_of_opencv():
    rng = np.random.default_rng(0)
    camera = Camera()
    points = np.column_stack([rng.uniform(-0.7, 0.7, (50, 2)), np.ones(50)])
    expected = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera.matrix, np.array(camera.distortion)
    )[0][:, 0]
    pixels = camera.project(points)
    np.testing.assert_allclose(pixels, expected, atol=1e-9)
    np.testing.assert_allclose(camera.bearings(pixels), points[:, :2], atol=1e-11)
    assert np.all(np.isnan(camera.project(-points)))


def samples() -> np.ndarray:
    """Of a recorded trajectory (n,8) that has a gap."""
    times = np.delete(np.arange(0.0, 6.0, 0.01), slice(250, 300))
    turn = np.column_stack([np.sin(times), 0.5 * np.cos(2.0 * times), times])
    quaternions = Rotation.from_rotvec(turn).as_quat()
    return np.column_stack([times, np.cos(turn), quaternions * np.sign(quaternions[:, 3:])])


MOTIONS = {
    "rest": motions.rest,
    "hand": motions.hand,
    "vibration": partial(motions.vibration, degrees=1.0, hertz=20.0),
    "steady": partial(motions.steady, rate=3.0, speed=1.0),
    "stop": partial(motions.sudden_stop, earliest=-0.02, latest=0.02),
    "coloured": partial(motions.coloured, degrees=0.3, hertz=(20.0, 60.0)),
    "struck": partial(motions.struck, degrees=0.3, earliest=-0.1, latest=0.0),
    "recorded": lambda count, rng: motions.Recorded(samples(), count, rng, around=0.2),
}


@pytest.mark.parametrize("name", MOTIONS)
def test_twists_are_the_change_of_the_poses(name):
    rng = np.random.default_rng(1)
    moving = MOTIONS[name](40, rng)
    which, time = np.arange(40), rng.uniform(-0.1, 0.1, 40)
    states = moving.states(which, time)
    before, after = (moving.poses(which, time + step) for step in (-STEP, STEP))
    turn = rotations.logarithm(np.swapaxes(before[0], 1, 2) @ after[0]) / (2 * STEP)
    way = np.einsum("nji,nj->ni", states.rotation, after[1] - before[1]) / (2 * STEP)
    np.testing.assert_allclose(states.angular, turn, atol=1e-5)
    np.testing.assert_allclose(states.linear, way, atol=1e-6)
    assert np.any(turn != 0.0) == (name != "rest")


@pytest.mark.parametrize("scan", list(Scan))
def test_every_point_is_seen_when_its_row_is_exposed(scan):
    camera = Camera(scan=scan)
    rng = np.random.default_rng(4)
    moving = motions.hand(1, rng)
    local = np.column_stack([rng.uniform(-1.0, 1.0, (60, 2)), rng.uniform(2.0, 4.0, 60)])
    places = local @ moving.rotation[0].T + moving.position[0]

    def local_at(delay: np.ndarray) -> np.ndarray:
        rotation, position = moving.poses(np.zeros(60, int), delay)
        return np.einsum("nji,nj->ni", rotation, places - position)

    pixels = camera.project_rolling(local_at, (60,))
    edge = {Scan.DOWN: 0.0, Scan.UP: camera.height - 1.0}
    along = pixels[:, 1] if scan in edge else pixels[:, 0]
    size = (camera.height if scan in edge else camera.width) - 1.0
    forward = scan in (Scan.DOWN, Scan.RIGHT)
    delay = camera.readout_time * (along if forward else size - along) / size
    np.testing.assert_allclose(camera.project(local_at(delay)), pixels, atol=1e-8)
    still = camera.project(local_at(np.zeros(60)))
    assert np.abs(still - pixels).max() > 1.0


def test_a_bent_board_is_flat_in_its_map_only():
    flat, bent = (simulate(Camera(), rest, Board(bend=bend), 5, 1, 0) for bend in (0.0, 0.002))
    np.testing.assert_array_equal(flat.points, bent.points)
    moved = np.linalg.norm(flat.exact - bent.exact, axis=-1)
    sides = [0, 8, 45, 53]  # corners of the 9 x 6 grid
    assert moved[:, sides].max() < 1e-9
    assert moved.max() > 0.05


@pytest.mark.parametrize("scan", list(Scan))
def test_the_estimator_finds_the_truth_of_exact_pixels(scan):
    # Steady motion, which every version of the estimator models: signs, axes and moments agree.
    motion = moving("steady", rate=1.5, speed=0.7)
    condition = Condition("exact", "any", motion, Rich(), 0.0, camera=Camera(scan=scan))
    found = judge(condition, 4, 0, {})
    assert found.localized.all()
    for name, most in {"deg_s": 2e-3, "deg": 2e-3, "mm": 0.1, "deg/s": 0.3, "m/s": 0.01}.items():
        assert found.of(name).max() < most, name


def test_nothing_of_the_package_is_imported():
    files = sorted(Path(benchmarks.independent.__file__).parent.glob("*.py"))
    assert len(files) > 4
    for path in files:
        for name in re.findall(r"^ *(?:from|import) ([.\w]+)", path.read_text(), re.MULTILINE):
            fine = name.split(".")[0] in {"numpy", "scipy", *sys.stdlib_module_names}
            assert fine or name.startswith("benchmarks.independent"), f"{path.name} imports {name}"
