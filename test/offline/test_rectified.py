# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images as a global shutter would have taken them, against rendered ones."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from rs_localizer.core.camera import Camera
from rs_localizer.tools.rectified import (
    FlatError,
    map_depths,
    motion_between,
    plane_depths,
    rectified,
)
from rs_localizer.tools.simulation.frames import middle_stamp
from rs_localizer.tools.simulation.planes import TexturedPlane
from rs_localizer.tools.simulation.renderer import Renderer
from rs_localizer.tools.simulation.true_motion import ConstantVelocity
from rs_localizer.tools.simulation.walls import collage

READOUT = 0.03
K = np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(320, 240, K, [0.05, -0.02, 0.001, 0.0], readout_time=READOUT)
MOTION = ConstantVelocity(np.array([0.8, 1.5, -1.0]), np.array([0.8, 0.3, 0.3]), 0.3)
STAMP = MOTION.start_ns + 100_000_000
START = MOTION.state(STAMP, np.zeros(1))
X, Y, Z = START.rotations[0].T
PICTURE = collage(400, 300, np.random.default_rng(0))


def plane(x: float, y: float, z: float, texel: float) -> TexturedPlane:
    """A picture that faces the camera, its corner at x, y, z in the camera's axes."""
    corner = START.positions[0] + START.rotations[0] @ [x, y, z]
    return TexturedPlane(corner, X, Y, texel, PICTURE)


def points_on(item: TexturedPlane, count: int) -> np.ndarray:
    """A grid of points (n,3) on it."""
    height, width = item.texture.shape
    u, v = np.meshgrid(np.linspace(0, width, count), np.linspace(0, height, count))
    steps = item.texel * np.stack([u.ravel(), v.ravel()], axis=1)
    return item.corner + steps @ [item.right, item.down]


WALL = plane(-2.0, -1.5, 1.5, 0.01)
BOX = plane(-0.1, -0.6, 0.75, 0.002)


def shot(planes, direction="top_to_bottom", tau=0.0):
    """A rolling-shutter image, that of a global shutter at a row's time, and the motion."""
    camera = replace(CAMERA, scan_direction=direction)
    middle = middle_stamp(camera, STAMP)
    ends = MOTION.state(middle, np.array([-0.5, 0.5]) * READOUT)
    return SimpleNamespace(
        camera=camera,
        motion=motion_between(*((ends.rotations[k], ends.positions[k]) for k in range(2))),
        rolling=Renderer(camera, planes).image(MOTION, STAMP),
        still=Renderer(replace(camera, readout_time=0.0), planes).image(
            MOTION, middle + round(1e9 * tau * READOUT)
        ),
    )


def error(image, still, known):
    return float(np.mean(np.abs(image.astype(float) - still)[known]))


@pytest.mark.parametrize(
    ("direction", "tau"), [("top_to_bottom", 0.0), ("right_to_left", 0.0), ("bottom_to_top", -0.5)]
)
def test_a_wall_by_its_plane(direction, tau):
    found = shot((WALL,), direction, tau)
    before = error(found.rolling, found.still, np.ones((240, 320), bool))
    depths = plane_depths(points_on(WALL, 2))
    image, known = rectified(found.camera, found.rolling, found.motion, depths, tau)
    far, also = rectified(found.camera, found.rolling, found.motion, tau=tau)
    errors = before, error(far, found.still, also), error(image, found.still, known)
    # 9.3, 3.6 and 0.3 grey levels (7.5, 3.3 and 0.3 sideways) when this was written.
    assert (errors[2] < 0.25 * errors[1]) & (errors[1] < 0.8 * errors[0]), errors
    assert 0.75 < known.mean() < 1.0
    assert (image[~known] == 0).all()


def test_depths_of_a_map():
    found = shot((WALL, BOX))
    wall, box = points_on(WALL, 40), points_on(BOX, 20)
    # What the box hides is in no map that was made from here.
    rays = (wall - START.positions[0]) @ START.rotations[0]
    x, y = 0.75 * (rays[:, :2] / rays[:, 2:]).T
    hidden = (x > -0.12) & (x < 0.72) & (y > -0.62) & (y < 0.02)
    depths = map_depths(np.concatenate([wall[~hidden], box]))
    image, known = rectified(found.camera, found.rolling, found.motion, depths)
    far, also = rectified(found.camera, found.rolling, found.motion)
    errors = error(far, found.still, also), error(image, found.still, known)
    assert errors[1] < 0.6 * errors[0], errors


def test_what_has_no_plane_is_refused():
    with pytest.raises(FlatError, match="points of the map lie in no plane: "):
        plane_depths(np.random.default_rng(0).uniform(size=(20, 3)))
    behind = plane_depths(points_on(WALL, 2) - 3.0 * Z)
    found = shot((WALL,))
    image, known = rectified(found.camera, found.rolling, found.motion, behind)
    assert not known.any()
    assert not image.any()
