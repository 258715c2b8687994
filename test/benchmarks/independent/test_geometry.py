# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The second simulator against SciPy's rotations, OpenCV's lens, and finite differences."""

from functools import partial

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.independent import motions, rotations
from benchmarks.independent.cameras import Camera, Scan

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
