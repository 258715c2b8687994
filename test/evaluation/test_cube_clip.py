# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The cube is drawn where its points are, each at its own row's pose; the clip can be played."""

import numpy as np

from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.prints import Marker
from rs_localizer.tools import cube_clip

CAMERA = Camera(
    640, 480, np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]),
    D=[-0.1, 0.02, 0.0, 0.0], readout_time=0.03,
)  # fmt: skip
# Before the camera, facing it: x to the right, y up, z toward the viewer.
MARKER = Marker.at("4x4_50", 0, 0.4, Pose([0.1, 0.0, 3.0], np.diag([1.0, -1.0, -1.0])))
MOVING = Motion(np.eye(3), np.zeros(3), np.array([0.05, 0.2, -0.1]), np.array([0.05, 0.0, 0.02]))


def test_every_edge_is_drawn_where_the_rows_see_it():
    corners, picture = cube_clip.cube_on(MARKER), np.zeros((480, 640, 3), np.uint8)
    sides = np.linalg.norm(corners[[1, 2, 4]] - corners[0], axis=1)
    np.testing.assert_allclose(sides, 0.6)
    np.testing.assert_allclose(corners.mean(axis=0), [0.1, 0.0, 2.7])
    cube_clip.draw_cube(picture, CAMERA, MOVING, corners, (255, 0, 0))
    assert not picture[..., 1:].any()
    share = np.linspace(0.0, 1.0, 15)[:, None]
    for a in range(8):
        for b in (a ^ 1, a ^ 2, a ^ 4):
            edge = corners[a] + share * (corners[b] - corners[a])
            seen, _ = project_rolling(CAMERA, MOVING.at_rows, edge)
            for u, v in np.rint(seen).astype(int):
                assert picture[v - 1 : v + 2, u - 1 : u + 2, 0].max() > 200
    # Nothing is drawn far away.
    v, u = np.nonzero(picture[..., 0])
    seen = project_rolling(CAMERA, MOVING.at_rows, corners)[0]
    assert u.min() > seen[:, 0].min() - 5
    assert u.max() < seen[:, 0].max() + 5
    assert v.max() < seen[:, 1].max() + 5
