# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Maps that cannot be true are recognized, alone or by what an image shows; true ones are not."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.markers.consistency import problems
from rs_localizer.markers.detection import Detections
from rs_localizer.markers.families import family
from rs_localizer.markers.map_check import Fit, LeaveOneOut, MapCheck, still_fit
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.prints import Charuco, Marker
from rs_localizer.offline.detect import _RollingFit

UPRIGHT = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # z of the print along -y of the map
SIDEWAYS = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])  # z of the print along x of the map


BACK, LEFT = Pose(np.array([0.6, 2.0, 0]), UPRIGHT), Pose(np.array([-0.2, 1.2, 0]), SIDEWAYS)


def corner() -> MarkerMap:
    """Two walls at a right angle."""
    back = wall("4x4_50", (3, 2), 0.3, 0.1, pose=BACK)
    return MarkerMap((*back, *wall("4x4_50", (3, 2), 0.3, 0.1, first_id=20, pose=LEFT)))


def fault(told: MarkerMap, pixels: Any) -> str | None:
    """That of a map of which an image shows all corners at these pixels."""
    ids = np.arange(len(pixels))
    found = Detections(ids, told.points, pixels, np.ones(len(ids)), (), (), (), ())
    return MapCheck(told).fault(found)


def shown(told: MarkerMap, true: MarkerMap) -> str | None:
    """The fault of a map, of which a camera at the origin that looks along y sees another one."""
    turn = Rotation.from_euler("xyz", [3, -4, 8], degrees=True).as_matrix()
    camera = turn @ np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    local = (true.points - np.array([0.5, -0.3, 0.1])) @ camera.T
    assert local[:, 2].min() > 0.2
    pixels = local[:, :2] / local[:, 2:] * 400.0 + [320, 240]
    # A shutter that shears the image.
    pixels[:, 0] += 0.05 * pixels[:, 1]
    return fault(told, pixels + np.random.default_rng(0).normal(0.0, 0.3, pixels.shape))


def changed(marker_map: MarkerMap, change: Any) -> MarkerMap:
    return MarkerMap(tuple(Marker(m.family, m.id, change(m.corners)) for m in marker_map.markers))


def test_true_maps_have_no_fault():
    for true in (corner(), MarkerMap(corner().markers[:6]), MarkerMap(corner().markers[:1])):
        assert problems(true) == []
        assert shown(true, true) is None


def test_a_fisheye_lens_is_no_fault_of_the_map():
    back = wall("4x4_250", (11, 7), 0.3, 0.1, pose=Pose(np.array([0.5, 1.2, 0.1]), UPRIGHT))
    left = wall(
        "4x4_250", (3, 7), 0.3, 0.1, first_id=100, pose=Pose(np.array([-1.5, 0.5, 0.1]), SIDEWAYS)
    )
    told = MarkerMap((*back, *left))
    x, z, y = (told.points - np.array([0.5, -0.3, 0.1])).T * [[1], [1], [-1]]
    side = np.hypot(x, y)
    pixels = 300.0 * (np.arctan2(side, z) / side * np.array([x, y])).T + [320, 240]
    assert fault(told, pixels) is None


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda corners: corners[[1, 0, 3, 2]], "the map is mirrored: marker 4x4_50 0, "),
        # Each wall by itself is the true one turned, but no room has both.
        (lambda corners: corners * [-1.0, 1.0, 1.0], "mirrored: only a left-handed room"),
    ],
)
def test_a_mirrored_map_shows_in_an_image(change, text):
    assert text in shown(changed(corner(), change), corner())


def test_a_few_markers_of_many_at_another_place_show_in_an_image():
    true = MarkerMap(
        wall("4x4_250", (9, 6), 0.12, 0.04, pose=Pose(np.array([0.5, 2.0, 0.0]), UPRIGHT))
    )
    places = iter(range(54))
    told = changed(true, lambda corners: corners + np.array([0, 0, 0.12 * (next(places) == 20)]))
    assert "are misplaced" in str(shown(told, true))


def marker(id_: int, x: float, size: float = 0.1, rotation: Any = None) -> Marker:
    place = Pose(np.array([x, 0.0, 0.0]), np.eye(3) if rotation is None else rotation)
    return Marker.at("4x4_50", id_, size, place)


BEHIND = np.diag([-1.0, 1.0, -1.0])


@pytest.mark.parametrize(
    ("markers", "boards", "text"),
    [
        ([marker(0, 0), marker(1, 0.09)], [], "0 and marker 4x4_50 1 overlap by 0.01 m"),
        ([marker(0, 0), marker(1, 0.2, rotation=BEHIND)], [], "face opposite ways: one of them"),
        ([marker(k, 0.5 * k) for k in range(3)] + [marker(3, 9.0, 4.0)], [], "another unit"),
        ([marker(0, 0, 60.0), marker(1, 90.0, 60.0)], [], "markers of 60 m: are sizes"),
        ([marker(0, 0)], [Charuco(5, 7, 0.03, 0.02, family("5x5_50"))], "5x5_50 overlap by"),
    ],
)
def test_problems_of_a_map(markers, boards, text):
    (found,) = problems(MarkerMap(tuple(markers), tuple(boards)))
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
    check = LeaveOneOut(MARKERS, fit)
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
    return check.fault()


def test_a_centimetre_is_named_with_its_direction():
    text = said([0.01, 0.0, 0.0])
    assert text.startswith("marker 4x4_50 4 is misplaced in the map")
    assert "about 1.0 cm (+0.01" in text
    assert said([0.0, -0.006, 0.004], marker=0).startswith("marker 4x4_50 0 ")


def test_a_right_map_is_not_blamed_for_noise_or_the_shutter():
    assert said(0.0) is None
    assert said(0.0, noise=1.0) is None
    assert said(0.0, spin=4.0) is None


def test_a_shaking_rolling_shutter_hides_no_marker():
    """The fit of detect: what the shutter does is tens of times what the marker does."""
    text = said([0.01, 0.0, 0.0], spin=4.0, fit=_RollingFit(), images=12)
    assert text.startswith("marker 4x4_50 4 is misplaced in the map")
    assert "about 1.0 cm (+0.0" in text
    assert said(0.0, spin=4.0, fit=_RollingFit(), images=12) is None


def test_with_two_markers_nobody_knows_which_is_off():
    assert said([0.01, 0.0, 0.0], marker=0, corners=12) is not None
    assert said([0.01, 0.0, 0.0], marker=0, corners=8) is None
