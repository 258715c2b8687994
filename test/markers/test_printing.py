"""Pages are true to scale and hold what their map says: the detector reads them."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.markers.families import family
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.markers.pages import PrintError, write_pages
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.printing import PAGES, plan
from rs_localizer.markers.prints import Charuco, Chessboard, CircleGrid

PIXEL = 0.0254 / 300  # m, of the PNG files


@pytest.mark.parametrize(
    "marker_map",
    [
        MarkerMap(wall("apriltag_36h11", (2, 3), 0.055, 0.02, first_id=100)),
        MarkerMap(boards=(Chessboard(6, 5, 0.029),)),
        MarkerMap(boards=(Charuco(5, 6, 0.035, 0.025, family("5x5_100"), 7),)),
        MarkerMap(boards=(Charuco(5, 6, 0.035, 0.025, family("5x5_100"), 7, True),)),
    ],
)
def test_a_page_is_as_its_map(marker_map: MarkerMap, tmp_path: Path) -> None:
    (page,) = plan(marker_map)
    (file,) = write_pages([page], tmp_path / "page.png")
    image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    upright = image.shape[0] > image.shape[1]
    np.testing.assert_allclose(sorted(image.shape), np.array(PAGES["a4"]) / 25.4 * 300, atol=1)
    found = MarkerDetector(marker_map).detect(image)
    assert len(found.ids) == len(marker_map.points)
    # In print: x to the right, y up.
    printed = found.pixels * [PIXEL, -PIXEL]
    expected = found.points[:, :2]
    offset = (printed - expected).mean(axis=0)
    np.testing.assert_allclose(printed - offset, expected, atol=4e-5)
    assert upright == (page.height > page.width)


def test_markers_that_do_not_fit_together_get_pages_of_their_own(tmp_path: Path) -> None:
    marker_map = MarkerMap(wall("4x4_50", (3, 1), 0.12, 0.1))
    pages = plan(marker_map)
    assert len(pages) == 3
    files = write_pages(pages, tmp_path / "wall.png")
    assert [file.name for file in files] == ["wall_1.png", "wall_2.png", "wall_3.png"]
    found = MarkerDetector(marker_map).detect(cv2.imread(str(files[1]), cv2.IMREAD_GRAYSCALE))
    assert found.ids.tolist() == [4, 5, 6, 7]
    side = np.linalg.norm(found.pixels[0] - found.pixels[1]) * PIXEL
    assert side == pytest.approx(0.12, abs=3e-5)
    # Small ones share a page, though the map has them on different walls.
    turned = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    other = wall("4x4_50", (2, 1), 0.05, 0.1, first_id=9, pose=Pose(np.zeros(3), turned))
    (page,) = plan(MarkerMap((*wall("4x4_50", (2, 1), 0.05, 0.1), *other)))
    assert len(page.figures) == 4


@pytest.mark.parametrize("name", ["a4", "letter"])
def test_notes_do_not_cover_the_bar(name: str, tmp_path: Path) -> None:
    family_ = family("apriltag_36h11")
    (page,) = plan(MarkerMap(boards=(Charuco(5, 7, 0.03, 0.0225, family_),)), name)
    write_pages([page], tmp_path / "page.png")
    image = cv2.imread(str(tmp_path / "page.png"), cv2.IMREAD_GRAYSCALE)
    # Right of the bar's last tick, along the bar, nothing is printed, nor on the last tenth of it.
    mm = 300 / 25.4
    row = image.shape[0] - round(10.0 * mm)
    assert image[row - round(3.5 * mm) : row + round(mm), round(110.5 * mm) :].min() == 255
    assert image[row - round(3.5 * mm) : row - 5, round(101 * mm) : round(109 * mm)].min() == 255


def test_pdf_has_the_size_of_the_paper(tmp_path: Path) -> None:
    pages = plan(MarkerMap(wall("4x4_50", (3, 1), 0.12, 0.1)), "letter")
    (file,) = write_pages(pages, tmp_path / "wall.pdf")
    boxes = re.findall(rb"/MediaBox \[ ?0 0 ([\d.]+) ([\d.]+) ?\]", file.read_bytes())
    assert len(boxes) == 3
    for width, height in boxes:
        assert float(width) == pytest.approx(215.9 / 25.4 * 72, abs=0.01)
        assert float(height) == pytest.approx(279.4 / 25.4 * 72, abs=0.01)


def test_what_is_too_large_is_refused(tmp_path: Path) -> None:
    with pytest.raises(PrintError, match="4x4_50 0 takes 400 x 400 mm, but a3 has room for 277 x"):
        plan(MarkerMap(wall("4x4_50", (1, 1), 0.3, 0.1)), "a3")
    with pytest.raises(PrintError, match="chessboard 9x6 takes 500 x 350 mm, but a4 has room"):
        plan(MarkerMap(boards=(Chessboard(9, 6, 0.05),)))
    with pytest.raises(PrintError, match=r"must end in .pdf or .png"):
        write_pages(plan(MarkerMap(wall("4x4_50", (1, 1), 0.1, 0.1))), tmp_path / "wall.svg")


def standing() -> Any:
    return Pose(np.zeros(3), np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]))


def test_a_page_tells_how_the_map_lies_on_it() -> None:
    (page,) = plan(MarkerMap(wall("4x4_50", (2, 3), 0.06, 0.02, pose=standing())))
    assert page.axes is not None
    assert (page.axes.right, page.axes.up, page.axes.out) == ("+x", "+z", "-y")
    # In the middle of the grid, which is that of all figures.
    boxes = np.array([(x, y, x + f.width, y + f.height) for x, y, f in page.figures])
    middle = 0.5 * (boxes[:, :2].min(axis=0) + boxes[:, 2:].max(axis=0))
    np.testing.assert_allclose(page.axes.origin, middle, atol=1e-6)
    assert "the first print is at (-0.04, 0, 0.08) m" in page.axes.where
    (page,) = plan(MarkerMap(boards=(Chessboard(6, 4, 0.02),)))
    assert page.axes is not None
    assert (page.axes.right, page.axes.up, page.axes.out) == ("+x", "+y", "+z")
    assert page.axes.where == "the origin is in the middle of the print"


def test_what_is_cut_out_tells_where_it_goes() -> None:
    pages = plan(MarkerMap(wall("4x4_50", (2, 1), 0.1, 0.5)))
    labels = [figure.label for page in pages for _, _, figure in page.figures]
    assert [label.split("  ")[-1] for label in labels] == [
        "middle at (-0.3, 0, 0) m", "middle at (0.3, 0, 0) m",
    ]  # fmt: skip
    assert {page.axes for page in pages} == {None}


def test_circles_are_not_printed() -> None:
    with pytest.raises(PrintError, match="a circle grid 4x5 can be detected, but not printed"):
        plan(MarkerMap(boards=(CircleGrid(4, 5, 0.02),)))
