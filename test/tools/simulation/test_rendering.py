# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rendered images against plain ray casting, OpenCV's warping and analytic projections."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from rs_localizer.core import so3
from rs_localizer.core.camera import Camera
from rs_localizer.tools.simulation.renderer import ImageSettings, Renderer
from rs_localizer.tools.simulation.true_motion import ConstantVelocity
from rs_localizer.tools.simulation.walls import TexturedPlane

K = np.array([[80.0, 0.0, 47.0], [0.0, 82.0, 36.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(96, 72, K, readout_time=0.04)
MOTION = ConstantVelocity(
    np.array([1.0, -2.0, 3.0]), np.array([0.5, -0.3, 1.0]), 1.0, position=np.array([0.1, 0.2, 0.0])
)
LENSES = {
    "none": {},
    "plumb_bob": {"D": [-0.2, 0.05, 0.01, -0.01, 0.002]},
    "rational_polynomial": {"D": [0.1, 0.02, 0.001, -0.002, 0.0, 0.3, 0.05, 0.01],
                            "distortion_model": "rational_polynomial"},
    "equidistant": {"D": [0.02, -0.01, 0.003, 0.0], "distortion_model": "equidistant"},
}  # fmt: skip


def waves(width: int, height: int, period: float = 40.0) -> np.ndarray:
    """A picture so smooth that its sampling does not matter, only where it is."""
    y, x = np.mgrid[:height, :width] + 0.5
    grey = 128 + 60 * np.sin(2 * np.pi * x / period) + 60 * np.cos(2 * np.pi * y / (1.3 * period))
    return np.rint(grey).astype(np.uint8)


def corner_of_a_room() -> list[TexturedPlane]:
    """Two walls and a floor, with some of the background in sight."""
    x, y, z = np.eye(3)
    return [
        TexturedPlane(np.array([2.0, 0.8, 1.2]), -y, -z, 0.01, waves(250, 200)),
        TexturedPlane(np.array([2.0, -1.7, 1.2]), -x, -z, 0.01, waves(300, 200, 30.0)),
        TexturedPlane(np.array([2.0, 0.8, -0.8]), -y, -x, 0.01, waves(250, 300, 50.0)),
    ]


def cast(camera: Camera, planes: list[TexturedPlane], motion: ConstantVelocity, stamp_ns: int):
    """Ray by ray: the grey level that each pixel's middle sees, and how deep (NaN: nothing)."""
    width, height = camera.size
    image, nearest = np.full((height, width), 60.0), np.full((height, width), np.nan)
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(float)
    rays = camera.rays(pixels.reshape(-1, 2)).reshape(height, width, 2)
    since = (camera.row_time(pixels.reshape(-1, 2)) - camera.first_row_time) * camera.readout_time
    seconds = 1e-9 * (stamp_ns - motion.start_ns) + since.reshape(height, width)
    for row in range(height):
        for column in range(width):
            elapsed = seconds[row, column]
            rotation = motion.rotation @ so3.exp(elapsed * motion.angular_velocity)
            centre = motion.position + elapsed * motion.rotation @ motion.linear_velocity
            ray = rotation @ [*rays[row, column], 1.0]
            for plane in planes:
                normal = np.cross(plane.right, plane.down)
                depth = normal @ (plane.corner - centre) / (normal @ ray)
                met = centre + depth * ray - plane.corner
                x, y = met @ plane.right / plane.texel, met @ plane.down / plane.texel
                inside = 0 < x < plane.texture.shape[1] and 0 < y < plane.texture.shape[0]
                if depth > 0.0 and inside and not depth > nearest[row, column]:
                    nearest[row, column] = depth
                    map_x, map_y = np.array([[x - 0.5]]), np.array([[y - 0.5]])
                    image[row, column] = cv2.remap(
                        plane.texture.astype(np.float32), map_x.astype(np.float32),
                        map_y.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE,
                    )[0, 0]  # fmt: skip
    return image, nearest


def away_from_edges(depths: np.ndarray) -> np.ndarray:
    """Pixels around which the depth changes little: a pixel on an edge is a mixture."""
    filled = np.nan_to_num(depths)
    smooth = np.abs(cv2.Laplacian(filled, cv2.CV_64F)) < 0.08
    return cv2.erode(smooth.astype(np.uint8), np.ones((3, 3))) > 0


@pytest.mark.parametrize(
    ("lens", "direction"),
    [
        ("plumb_bob", "right_to_left"),
        ("none", "top_to_bottom"),
        ("rational_polynomial", "bottom_to_top"),
        ("equidistant", "left_to_right"),
    ],
)
def test_every_line_is_seen_from_its_own_pose(lens, direction):
    camera = replace(CAMERA, scan_direction=direction, **LENSES[lens])
    planes = corner_of_a_room()
    image = Renderer(camera, planes).image(MOTION, 300_000_000)
    expected, depths = cast(camera, planes, MOTION, 300_000_000)
    compared = away_from_edges(depths)
    assert compared.mean() > 0.75
    difference = (image - expected)[compared]
    assert np.abs(difference).mean() < 1.0
    assert np.percentile(np.abs(difference), 99) < 6.0
    # A row late, or a wrong sign, would be seen.
    still = replace(camera, readout_time=0.04 * 71 / 70)
    late = Renderer(still, planes).image(MOTION, 301_000_000)
    assert np.abs((late - expected)[compared]).mean() > 2.0 * np.abs(difference).mean()


def test_exposure_blurs_along_the_motion_and_shifts_nothing():
    """An edge that passes by at v px per exposure is a ramp of that width, in the same place."""
    edge = np.full((400, 800), 20, np.uint8)
    edge[:, 400:] = 220
    plane = TexturedPlane(
        np.array([2.0, 4.0, 2.0]), np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -1.0]), 0.01,
        edge,
    )  # fmt: skip
    camera = replace(CAMERA, readout_time=0.0)
    passing = ConstantVelocity(np.zeros(3), np.array([5.0, 0.0, 0.0]), 1.0)

    def row(exposure: float) -> np.ndarray:
        settings = ImageSettings(exposure=exposure)
        return Renderer(camera, [plane], settings).image(passing, 10_000_000)[36].astype(float)

    sharp, blurred = row(0.0), row(0.05)
    travel = 80.0 * 5.0 * 0.05 / 2.0
    ramp = np.flatnonzero((blurred > 30) & (blurred < 210))
    assert len(ramp) == pytest.approx(0.9 * travel, abs=2)
    np.testing.assert_allclose(np.diff(blurred[ramp]).mean(), 200.0 / travel, rtol=0.1)
    assert (blurred - sharp).sum() == pytest.approx(0.0, abs=100.0)  # half a pixel
