# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The cube is drawn where its points are, each at its own row's pose; animations can be played."""

import io
from dataclasses import replace

import cv2
import numpy as np
from PIL import Image as Pillow

from rs_localizer import data
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.io.trajectories import read_tum
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.prints import Marker
from rs_localizer.tools.evaluation import cube_clip
from rs_localizer.tools.evaluation.cube_clip import (
    clip_cube,
    clip_stamps,
    cube_errors,
    cube_on,
    draw_cube,
    gif,
    side_by_side,
)
from rs_localizer.tools.simulation.frames import middle_stamp

CAMERA = Camera(
    640, 480, np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]),
    D=[-0.1, 0.02, 0.0, 0.0], readout_time=0.03,
)  # fmt: skip
# Before the camera, facing it: x to the right, y up, z toward the viewer.
MARKER = Marker.at("4x4_50", 0, 0.4, Pose([0.1, 0.0, 3.0], np.diag([1.0, -1.0, -1.0])))
MOVING = Motion(np.eye(3), np.zeros(3), np.array([0.05, 0.2, -0.1]), np.array([0.05, 0.0, 0.02]))
STILL = Motion(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
BLUE = (255, 0, 0)


def drawn(motion: Motion) -> np.ndarray:
    picture = np.zeros((480, 640, 3), np.uint8)
    draw_cube(picture, CAMERA, motion.at_rows, cube_on(MARKER), BLUE)
    assert not picture[..., 1:].any()
    return picture[..., 0]


def test_cube_stands_on_the_marker_toward_the_viewer():
    corners = cube_on(MARKER)
    sides = np.linalg.norm(corners[[1, 2, 4]] - corners[0], axis=1)
    np.testing.assert_allclose(sides, 0.6)
    np.testing.assert_allclose(corners.mean(axis=0), [0.1, 0.0, 2.7])
    np.testing.assert_allclose(corners[:4].mean(axis=0), MARKER.pose.position)


def test_every_edge_is_drawn_where_the_rows_see_it():
    picture, corners = drawn(MOVING), cube_on(MARKER)
    share = np.linspace(0.0, 1.0, 15)[:, None]
    for a in range(8):
        for b in (a ^ 1, a ^ 2, a ^ 4):
            edge = corners[a] + share * (corners[b] - corners[a])
            seen, _ = project_rolling(CAMERA, MOVING.at_rows, edge)
            for u, v in np.rint(seen).astype(int):
                assert picture[v - 1 : v + 2, u - 1 : u + 2].max() > 100
    # It is not where a camera at rest would see it.
    rest, _ = project_rolling(CAMERA, STILL.at_rows, corners)
    assert np.linalg.norm(project_rolling(CAMERA, MOVING.at_rows, corners)[0] - rest) > 20.0
    # The front is filled, and nothing is drawn far away.
    v, u = np.nonzero(picture)
    inside, _ = project_rolling(CAMERA, MOVING.at_rows, corners[4:].mean(axis=0)[None])
    column, row = np.rint(inside[0]).astype(int)
    assert 60 < picture[row, column] < 110
    all_seen = project_rolling(CAMERA, MOVING.at_rows, corners)[0]
    assert u.min() > all_seen[:, 0].min() - 5
    assert u.max() < all_seen[:, 0].max() + 5
    assert v.max() < all_seen[:, 1].max() + 5


def test_animation_can_be_played():
    pictures = []
    for k in range(6):
        left = np.full((48, 64, 3), 200, np.uint8)
        cv2.circle(left, (10 + 8 * k, 20), 6, (0, 0, 255), -1)
        right = np.full((48, 64, 3), 90, np.uint8)
        captions = (("left", "1"), ("right", "2"))
        pictures.append(side_by_side([left, right], captions, [(0, 0, 0), (255, 0, 0)], 128))
    assert pictures[0].shape[1] == 2 * 128 + 6
    played = Pillow.open(io.BytesIO(gif(pictures, 12.5)))
    assert played.n_frames == 6
    assert played.info["duration"] == 80
    assert played.info["loop"] == 0
    for k in range(6):
        played.seek(k)
        shown = np.asarray(played.convert("RGB"))[..., ::-1].astype(int)
        assert np.abs(shown - pictures[k]).mean() < 4.0


def test_a_turned_pose_puts_the_cube_off():
    walls = cube_clip.MarkerWalls(read_tum(data.path(data.HAND_MOTION)), 0)
    middle, away = (middle_stamp(cube_clip.CAMERA, clip_stamps(walls)[k]) for k in (90, 60))
    state, cube = walls.motion.state(middle, np.zeros(1)), clip_cube(walls)
    rotation, readout = state.rotations[0].T, cube_clip.CAMERA.readout_time
    true = Motion(
        rotation, -rotation @ state.positions[0],
        readout * state.angular[0], readout * state.linear[0],
    )  # fmt: skip
    still = replace(true, angular_velocity=np.zeros(3), linear_velocity=np.zeros(3))
    off = cube_errors(walls.motion, middle, cube, {"true": true, "still": still, "none": None})
    # The true motion is no constant velocity, and yet nearly one during a readout.
    assert off["true"] < 0.5
    assert off["still"] > 3.0
    assert off["none"] == np.inf
    assert cube_errors(walls.motion, away, cube, {"true": true}) == {}
