# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Predicted landmarks against the exact rolling-shutter projection, for every camera."""

from typing import Any

import numpy as np
import pytest

from rs_localizer.core import so3
from rs_localizer.core.camera import Camera, Roi
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.estimation.prior import Prior
from rs_localizer.io.clouds import Keypoints
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.matching import Matcher, predict_visible
from rs_localizer.tools.simulation.scene import room

from ..moving import pinhole  # noqa: TID252 - Python has a package "test"

CAMERAS: dict[str, dict[str, Any]] = {
    "ideal": {},
    "sideways": {"scan_direction": "right_to_left"},
    "distorted": {"D": np.array([-0.25, 0.05, 1e-3, -1e-3, 0.0])},
    "fisheye": {"D": np.array([0.05, -0.01, 0.0, 0.0]), "distortion_model": "equidistant"},
    "part": {"binning": (2, 2), "roi": Roi(100, 60, 400, 300)},
}
MOTION = Motion(
    so3.exp(np.array([0.2, -0.4, 0.1])), *np.array([[0.3, -0.1, 0.4], [0.1, -0.2, 0.3],
                                                    [0.05, -0.03, 0.1]]),
)  # fmt: skip
SURE = Prior(motion=MOTION, covariance=1e-10 * np.eye(12))


@pytest.fixture(scope="module")
def points() -> Any:
    return room(np.zeros((1, 3)), np.random.default_rng(0), count=20_000)


@pytest.mark.parametrize("name", list(CAMERAS))
def test_all_that_the_image_shows_is_predicted_where_it_is(name, points):
    view = pinhole(400.0, **CAMERAS[name])
    pixels, _ = project_rolling(view, MOTION.at_rows, points)
    shown = np.flatnonzero(view.inside(pixels))
    assert len(shown) > 300
    found = predict_visible(view, SURE, points, 20.0)
    assert found.gate == 20.0
    assert np.all(np.diff(found.pixels[:, 1]) >= 0.0)
    place = {row: k for k, row in enumerate(found.landmarks.tolist())}
    # A lens model folds what is far outside into the image: of those some are not predicted.
    straight = shown[are_seen(view, points[shown], pixels[shown])].tolist()
    assert len(straight) > 300
    assert set(straight) <= set(place)
    # The camera turns by 21 degrees while the image is read.
    errors = np.abs(found.pixels[[place[row] for row in straight]] - pixels[straight]).max(axis=1)
    assert np.quantile(errors, 0.9) < 0.2
    assert errors.max() < 2.0
    # And not much else: not the whole room.
    assert len(found.landmarks) < 3 * len(shown) < 0.9 * len(points)


def are_seen(view: Camera, points: Any, pixels: Any) -> Any:
    """Whether each pixel's bearing, at its own row, meets its point."""
    rotations, translations = MOTION.at_rows(view.row_time(pixels))
    x, y, z = (np.einsum("nij,nj->ni", rotations, points) + translations).T
    return (z > 0.0) & (np.abs(view.rays(pixels) - np.c_[x / z, y / z]).max(axis=1) < 1e-3)


def test_a_prediction_tells_apart_what_looks_the_same(points):
    """Only a hundred kinds of landmarks: by their looks alone none is recognized."""
    view = pinhole(400.0)
    rng = np.random.default_rng(1)
    descriptors = rng.integers(0, 256, (100, 32), dtype=np.uint8)[rng.integers(0, 100, len(points))]
    pixels, _ = project_rolling(view, MOTION.at_rows, points)
    shown = rng.permutation(np.flatnonzero(view.inside(pixels)))[:200]
    seen = pixels[shown] + rng.normal(0.0, 0.5, (200, 2))
    given = Keypoints(0, seen, None, descriptors[shown], None, 0)
    matcher = Matcher(Map(points, None, descriptors, "map"))
    assert len(matcher.match(given)) == 0
    found = matcher.match(given, view, SURE)
    assert len(found) > 120
    assert np.mean(found.landmarks == shown[found.keypoints]) > 0.95
    assert len(set(found.landmarks.tolist())) == len(found)
