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
    ("largest", "kind", "step"),
    [(8000.0, "<f4", None), (9000.0, "<f4", "1 mm"), (500e3, "<f4", "31 mm"), (4e6, "<f8", None)],
)
def test_coordinates_that_single_precision_cannot_tell(largest, kind, step):
    found = oddities(cloud(largest, kind), CAMERA, "camera")
    if step is None:
        assert found == {}
    else:
        assert found.keys() == {"coarse_coordinates"}
        text = f"coordinates of {largest:.0f} m in FLOAT32 are known to {step} only: send them as"
        assert found["coarse_coordinates"].startswith(text)


def test_pixels_of_another_resolution():
    assert oddities(cloud(), CAMERA, "camera") == {}
    assert oddities(cloud(pixel=(640.2, 480.1)), CAMERA, "camera") == {}  # a tracker's slack
    found = oddities(cloud(pixel=(1200.0, 700.0)), CAMERA, "camera")
    assert found == {
        "pixels_outside": "1 of 2 pixels lie outside the 640 x 480 of camera_info, as (1200, 700): "
        "are both of the same camera and resolution?"
    }
    part = Camera(640, 480, K, binning=(2, 2), roi=Roi(100, 60, 400, 300))
    found = oddities(cloud(pixel=(300.0, 100.0)), part, "camera")
    assert "2 of 2 pixels lie outside the 200 x 150" in found["pixels_outside"]


def test_landmarks_that_are_gone_are_named():
    both, none = np.ones(2, np.bool_), np.zeros(2, np.bool_)
    assert stale_landmarks(cloud(), none) == ""
    assert stale_landmarks(cloud(), both) == (
        "2 landmarks in view are often seen and never matched: (0.00, 1.00, 2.00), "
        "(1.00, -5.00, 3.00)"
    )
    table = np.zeros(40, [("id", "<u4")])
    table["id"] = np.arange(40) // 4  # corners of markers
    seen = Correspondences(0, "map", np.zeros((40, 3)), np.zeros((40, 2)), None, 0, table)
    assert stale_landmarks(seen, table["id"] > 7).endswith("matched: 8, 9")
    seen.table["id"] = np.arange(40)
    assert stale_landmarks(seen, np.ones(40, np.bool_)).endswith(" 10, 11 ...")
