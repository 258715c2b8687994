# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pages are true to scale and hold what their map says: the detector reads them."""

import re

import cv2
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.markers.families import family
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.markers.prints import Charuco, Chessboard
from rs_localizer.tools.printing import PAGES, Page, draw, largest_side, plan, write_pages

PIXEL = 0.0254 / 300  # m, of the pictures


def picture(page: Page) -> np.ndarray:
    canvas = FigureCanvasAgg(draw(page, "page 1 of 1"))
    canvas.figure.set_dpi(300)
    canvas.draw()
    return cv2.cvtColor(np.asarray(canvas.buffer_rgba()), cv2.COLOR_RGBA2GRAY)


@pytest.mark.parametrize(
    "marker_map",
    [
        MarkerMap(wall("apriltag_36h11", (2, 3), 0.055, 0.02, first_id=100)),
        MarkerMap(boards=(Chessboard(6, 5, 0.029),)),
        MarkerMap(boards=(Charuco(5, 6, 0.035, 0.025, family("5x5_100"), 7, True),)),
    ],
)
def test_a_page_is_as_its_map(marker_map):
    (page,) = plan(marker_map)
    image = picture(page)
    np.testing.assert_allclose(sorted(image.shape), np.array(PAGES["a4"]) / 25.4 * 300, atol=1)
    found = MarkerDetector(marker_map).detect(image)
    assert len(found.ids) == len(marker_map.points)
    # In print: x to the right, y up.
    printed = found.pixels * [PIXEL, -PIXEL]
    expected = found.points[:, :2]
    offset = (printed - expected).mean(axis=0)
    np.testing.assert_allclose(printed - offset, expected, atol=4e-5)
    assert (image.shape[0] > image.shape[1]) == (page.height > page.width)


def test_markers_that_do_not_fit_together_get_pages_of_their_own():
    marker_map = MarkerMap(wall("4x4_50", (3, 1), 0.12, 0.1))
    pages = plan(marker_map)
    assert len(pages) == 3
    found = MarkerDetector(marker_map).detect(picture(pages[1]))
    assert found.ids.tolist() == [4, 5, 6, 7]
    side = np.linalg.norm(found.pixels[0] - found.pixels[1]) * PIXEL
    assert side == pytest.approx(0.12, abs=3e-5)
    with pytest.raises(ValueError, match="takes 400 x 400 mm, more than a4 has room for"):
        plan(MarkerMap(wall("4x4_50", (1, 1), 0.4, 0.1)))


@pytest.mark.parametrize(("page", "side"), [("a4", 0.07), ("a3", 0.1), ("letter", 0.065)])
def test_the_largest_markers_fill_the_page(page, side):
    found = largest_side(page, 2 + 1 / 3, 3 + 2 / 3)
    assert found == pytest.approx(side)
    assert len(plan(MarkerMap(wall("4x4_50", (2, 3), found, found / 3)), page)) == 1
    larger = found + 0.0051
    assert len(plan(MarkerMap(wall("4x4_50", (2, 3), larger, larger / 3)), page)) == 6


def test_pdf_has_the_size_of_the_paper(tmp_path):
    pages = plan(MarkerMap(wall("4x4_50", (3, 1), 0.12, 0.1)), "letter")
    file = tmp_path / "wall.pdf"
    write_pages(pages, file)
    boxes = re.findall(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+) ?\]", file.read_bytes())
    assert len(boxes) == 3
    for width, height in boxes:
        assert float(width) == pytest.approx(215.9 / 25.4 * 72, abs=0.01)
        assert float(height) == pytest.approx(279.4 / 25.4 * 72, abs=0.01)
