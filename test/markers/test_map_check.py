# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Maps that cannot be true are recognized, alone or by what images show; true ones are not."""

import re
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.markers.boards import flat_misfit
from rs_localizer.markers.detection import Detections
from rs_localizer.markers.families import family
from rs_localizer.markers.map_check import Fit, MapCheck, other_units, still_fit
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.prints import Charuco, Marker
from rs_localizer.offline.detect import _RollingFit


def marker(id_: int, x: float, size: float = 0.1) -> Marker:
    return Marker.at("4x4_50", id_, size, Pose(np.array([x, 0.0, 0.0])))


@pytest.mark.parametrize(
    ("markers", "boards", "text"),
    [
        ([marker(k, 0.5 * k) for k in range(3)] + [marker(3, 9.0, 4.0)], [], "another unit"),
        ([marker(0, 0, 60.0), marker(1, 90.0, 60.0)], [], "markers of 60 m: are sizes"),
        (
            [],
            [Charuco(5, 7, 30.0, 20.0, family("5x5_50"))],
            "30 m from corner to corner: sizes are",
        ),
    ],
)
def test_sizes_in_other_units(markers, boards, text):
    (found,) = other_units(MarkerMap(tuple(markers), tuple(boards)))
    assert text in found


K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(640, 480, K)
MARKERS = MarkerMap(wall("4x4_50", (3, 2), 0.07, 0.03))


def said(
    shift: Any, marker=4, spin=0.0, noise=0.1, fit: Fit = still_fit, corners=24, images=30
) -> str | None:
    """What is said when a marker was mounted elsewhere, of a camera that turns (deg/readout)."""
    rng = np.random.default_rng(1)
    true = MARKERS.points.copy()
    true[4 * marker : 4 * marker + 4] += shift
    check = MapCheck(MARKERS, fit)
    for _ in range(images):
        angles = rng.uniform(-35.0, 35.0, 3) * [0.3, 1.0, 1.0]
        turn = Rotation.from_euler("ZYX", angles, degrees=True).as_matrix()
        motion = Motion(
            turn @ np.diag([1.0, -1.0, -1.0]),
            np.array([*rng.normal(0.0, 0.02, 2), 0.5]),
            np.radians(spin) * rng.normal(size=3),
            np.zeros(3),
        )
        pixels, _ = project_rolling(CAMERA, motion.at_rows, true)
        pixels += rng.normal(0.0, noise, pixels.shape)
        found = np.arange(corners), MARKERS.points[:corners], pixels[:corners], np.ones(corners)
        check.add(CAMERA, Detections(*found, (), (), (), ()))
    return check.misplaced()


def test_a_centimetre_is_named():
    text = said([0.01, 0.0, 0.0])
    assert text.startswith("marker 4x4_50 4 is misplaced in the map")
    assert float(re.search(r"([\d.]+) cm or more", text)[1]) == pytest.approx(1.0, abs=0.2)
    assert said([0.0, -0.006, 0.004], marker=0).startswith("marker 4x4_50 0 ")


def test_a_right_map_is_not_blamed_for_noise_or_the_shutter():
    assert said(0.0) is None
    assert said(0.0, noise=1.0) is None
    assert said(0.0, spin=4.0) is None


def test_a_shaking_rolling_shutter_hides_no_marker():
    """The fit of detect: what the shutter does is tens of times what the marker does."""
    text = said([0.01, 0.0, 0.0], spin=4.0, fit=_RollingFit(), images=12)
    assert text.startswith("marker 4x4_50 4 is misplaced in the map")
    assert float(re.search(r"([\d.]+) cm or more", text)[1]) == pytest.approx(1.0, abs=0.2)
    assert said(0.0, spin=4.0, fit=_RollingFit(), images=12) is None


def test_with_two_markers_nobody_knows_which_is_off():
    assert said([0.01, 0.0, 0.0], marker=0, corners=12) is not None
    assert said([0.01, 0.0, 0.0], marker=0, corners=8) is None


def test_corners_in_another_order_fit_no_homography():
    turn = Rotation.from_euler("xyz", [160.0, -15.0, 20.0], degrees=True).as_matrix()
    points = np.concatenate([some.corners for some in MARKERS.markers[:2]])
    seen = points @ turn.T + [0.0, 0.0, 0.6]
    pixels = 500.0 * seen[:, :2] / seen[:, 2:]
    assert flat_misfit(points, pixels) < 1e-6
    for order in ([1, 2, 3, 0], [3, 2, 1, 0]):
        assert flat_misfit(points, pixels.reshape(2, 4, 2)[:, order].reshape(-1, 2)) > 0.25
    points[4:, 2] += 0.05
    assert np.isnan(flat_misfit(points, pixels))
