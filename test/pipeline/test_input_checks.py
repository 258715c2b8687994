# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What is odd about a frame is said, and what is usual is not."""

import numpy as np
import pytest

from rs_localizer.core.camera import Camera, Roi
from rs_localizer.io.clouds import Correspondences
from rs_localizer.pipeline.cloud_checks import oddities, stale_landmarks

K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(640, 480, K)
PART = Camera(640, 480, K, binning=(2, 2), roi=Roi(100, 60, 400, 300))


def cloud(
    largest: float = 5.0,
    kind: str = "<f4",
    pixel: tuple[float, float] = (639.4, -0.4),
    frame: str = "map",
) -> Correspondences:
    points = np.array([[0.0, 1.0, 2.0], [1.0, -largest, 3.0]])
    pixels = np.array([(320.0, 240.0), pixel])
    table = np.zeros(2, [(name, kind) for name in "xyz"])
    return Correspondences(0, frame, points, pixels, None, 0, table)


@pytest.mark.parametrize(
    ("odd", "told", "figures"),
    [
        ({"largest": 8000.0}, None, ()),
        ({"largest": 9000.0}, "coarse_coordinates", ("9000 m", "1 mm")),
        ({"largest": 500e3}, "coarse_coordinates", ("500000 m", "31 mm")),
        ({"largest": 4e6, "kind": "<f8"}, None, ()),
        ({"pixel": (640.2, 480.1)}, None, ()),  # a tracker's slack
        ({"pixel": (1200.0, 700.0)}, "pixels_outside", ("1 of 2", "640 x 480", "(1200, 700)")),
        ({"pixel": (300.0, 100.0), "of": PART}, "pixels_outside", ("2 of 2", "200 x 150")),
    ],
)
def test_coarse_coordinates_and_pixels_of_another_resolution_are_told(odd, told, figures):
    camera = odd.pop("of", CAMERA)
    found = oddities(cloud(**odd), camera, "camera", 20_000)
    assert list(found) == ([] if told is None else [told])
    assert all(figure in found[told] for figure in figures)


def test_landmarks_that_are_gone_are_named():
    both, none = np.ones(2, np.bool_), np.zeros(2, np.bool_)
    assert stale_landmarks(cloud(), none) == ""
    assert stale_landmarks(cloud(), both).endswith(": (0.00, 1.00, 2.00), (1.00, -5.00, 3.00)")
    table = np.zeros(40, [("id", "<u4")])
    table["id"] = np.arange(40) // 4  # corners of markers
    seen = Correspondences(0, "map", np.zeros((40, 3)), np.zeros((40, 2)), None, 0, table)
    assert stale_landmarks(seen, table["id"] > 7).endswith("matched: 8, 9")
    assert stale_landmarks(seen, table["id"] > 7, "abcdefghij").endswith("matched: i, j")
    seen.table["id"] = 2 * np.arange(40)
    assert stale_landmarks(seen, np.ones(40, np.bool_)).endswith(" 20, 22 ...")
