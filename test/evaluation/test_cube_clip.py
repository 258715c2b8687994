# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The clip of the demo: which markers count as visible, and how far the cube is off."""

from dataclasses import replace

import numpy as np
import pytest

from rs_localizer import data
from rs_localizer.core.shutter import Motion
from rs_localizer.evaluation.cube_clip import clip_cube, clip_stamps, cube_errors
from rs_localizer.io.trajectories import read_tum
from rs_localizer.simulation.frames import middle_stamp
from rs_localizer.simulation.marker_frames import CAMERA, MarkerWalls, visible

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


@pytest.mark.parametrize(
    ("quad", "expected"),
    [
        (100.0 + 20.0 * SQUARE, True),
        (100.0 + 15.0 * SQUARE, False),  # too small
        (100.0 + 20.0 * SQUARE[::-1], False),  # from behind
        (100.0 + np.array([60.0, 17.0]) * (SQUARE @ [[1.0, 0.9], [0.0, 1.0]]), True),
        (100.0 + np.array([60.0, 60.0]) * (SQUARE @ [[1.0, 0.9], [0.9, 1.0]]), False),  # a sliver
        ([1.0, 100.0] + 20.0 * SQUARE, False),  # on the rim
        ([619.0, 100.0] + 20.0 * SQUARE, False),
        (np.where(SQUARE > 0.5, np.nan, 100.0), False),  # behind the camera
    ],
)
def test_what_is_visible(quad, expected):
    assert visible(np.array([quad]), (640, 480)).tolist() == [expected]


def test_a_turned_pose_puts_the_cube_off():
    walls = MarkerWalls(read_tum(data.path(data.HAND_MOTION)), 0)
    middle, away = (middle_stamp(CAMERA, clip_stamps(walls)[k]) for k in (90, 60))
    state, cube = walls.motion.state(middle, np.zeros(1)), clip_cube(walls)
    rotation = state.rotations[0].T
    true = Motion(
        rotation, -rotation @ state.positions[0],
        CAMERA.readout_time * state.angular[0], CAMERA.readout_time * state.linear[0],
    )  # fmt: skip
    still = replace(true, angular_velocity=np.zeros(3), linear_velocity=np.zeros(3))
    off = cube_errors(walls.motion, middle, cube, {"true": true, "still": still, "none": None})
    # The true motion is no constant velocity, and yet nearly one during a readout.
    assert off["true"] < 0.5
    assert off["still"] > 3.0
    assert off["none"] == np.inf
    assert cube_errors(walls.motion, away, cube, {"true": true}) == {}
