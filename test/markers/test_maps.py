# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Map files, our own and of other programs, and printed pages: what is written is read."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from matplotlib.backends.backend_agg import FigureCanvasAgg
from scipy.spatial.transform import Rotation

from rs_localizer.markers.boards import flat_misfit
from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.markers.families import family
from rs_localizer.markers.map_files import read_any, read_marker_map, write_marker_map
from rs_localizer.markers.maps import MarkerMap, MarkerMapError, wall
from rs_localizer.markers.prints import Charuco, Chessboard, Marker, Pose
from rs_localizer.tools.printing import PAGES, Page, draw, largest_side, plan, write_pages

TURN = Rotation.from_euler("xyz", [20.0, -35.0, 110.0], degrees=True)
IDENTITY = {"position": [0, 0, 0], "quaternion": [0, 0, 0, 1]}
MARKER = {"family": "4x4_50", "id": 3, "size": 0.2, **IDENTITY}
CHESSBOARD = {"type": "chessboard", "columns": 6, "rows": 4, "square": 0.03, **IDENTITY}
GRID = {"type": "charuco", "columns": 3, "rows": 4, "square": 0.04, "marker": 0.03}
CHARUCO = {**GRID, "family": "5x5_100", **IDENTITY}


def read(tmp_path: Path, tree: Any) -> MarkerMap:
    path = tmp_path / "map.yaml"
    path.write_text(yaml.safe_dump(tree))
    return read_marker_map(path)


def test_corners_are_those_of_the_print_seen_from_its_front(tmp_path):
    tree = {"map_frame": "hall", "markers": [MARKER]}
    found = read(tmp_path, tree)
    # From the top left one clockwise; z out of the paper, so that y is up.
    expected = [[-0.1, 0.1, 0], [0.1, 0.1, 0], [0.1, -0.1, 0], [-0.1, -0.1, 0]]
    np.testing.assert_allclose(found.points, expected)
    assert found.map_frame == "hall"


def test_pose_moves_the_print(tmp_path):
    place = {"position": [1, 2, 3], "quaternion": TURN.as_quat().tolist()}
    by_matrix = {"position": [1, 2, 3], "rotation": TURN.as_matrix().tolist()}
    still = read(tmp_path, {"map_frame": "map", "markers": [MARKER], "boards": [CHESSBOARD]})
    for moved in (place, by_matrix):
        entry = {key: MARKER[key] for key in ("family", "id", "size")} | moved
        board = {k: CHESSBOARD[k] for k in ("type", "columns", "rows", "square")} | moved
        found = read(tmp_path, {"map_frame": "map", "markers": [entry], "boards": [board]})
        expected = TURN.apply(still.points) + np.array([1, 2, 3])
        np.testing.assert_allclose(found.points, expected, atol=1e-12)


def test_boards_go_row_by_row_from_the_top_left():
    points = Chessboard(6, 4, 0.03).points
    np.testing.assert_allclose(points[0], [-0.075, 0.045, 0], atol=1e-12)
    np.testing.assert_allclose(points[5], [0.075, 0.045, 0], atol=1e-12)
    np.testing.assert_allclose(points[-1], [0.075, -0.045, 0], atol=1e-12)
    charuco = Charuco(3, 4, 0.04, 0.03, family("5x5_100"), first_id=7)
    np.testing.assert_allclose(charuco.points[0], [-0.02, 0.04, 0], atol=1e-12)
    assert [marker.id for marker in charuco.markers] == list(range(7, 13))
    # The top left square is black: the first marker is in the middle of the first row.
    np.testing.assert_allclose(charuco.markers[0].points.mean(axis=0), [0, 0.06, 0], atol=1e-12)
    legacy = Charuco(3, 4, 0.04, 0.03, family("5x5_100"), legacy=True)
    np.testing.assert_allclose(legacy.markers[0].points.mean(axis=0), [-0.04, 0.06, 0], atol=1e-12)


def test_what_is_written_is_read(tmp_path):
    pose = Pose(np.array([0.3, -2.0, 1.0]), TURN.as_matrix())
    measured = Marker.at("aruco_original", 1000, 0.1, pose).corners + 1e-3 * np.eye(4, 3)
    written = MarkerMap(
        markers=(
            *wall("4x4_50", (4, 3), 0.16, 0.04, first_id=5, pose=pose),
            Marker(family("aruco_original"), 1000, measured),
        ),
        boards=(
            Chessboard(6, 4, 0.03, pose=pose),
            Charuco(5, 7, 0.04, 0.03, family("36h11"), 10, True, pose=pose),
        ),
        map_frame="hall",
    )
    write_marker_map(tmp_path / "map.yaml", written)
    read_back = read_marker_map(tmp_path / "map.yaml")
    np.testing.assert_allclose(read_back.points, written.points, atol=1e-9)
    assert read_back.map_frame == "hall"
    names = [(marker.name, owner) for marker, owner in read_back.all_markers()]
    assert names == [(marker.name, owner) for marker, owner in written.all_markers()]
    # Poses are easier to read than corners, where they say the same.
    entries = yaml.safe_load((tmp_path / "map.yaml").read_text())["markers"]
    assert "size" in entries[0]
    assert "corners" in entries[-1]


PLAIN = {"family": "4x4_50", "id": 1, "size": 1, "position": [0, 0, 0]}
CORNERS = [[0, 1, 0], [1, 1, 0], [1, 0, 0], [0, 0, 0]]


def hung(*markers: Any) -> Any:
    return {"map_frame": "map", "markers": list(markers)}


@pytest.mark.parametrize(
    ("tree", "text"),
    [
        (hung(MARKER | {"family": "4x4_51"}), "unknown family '4x4_51'; did you mean 4x4_50?"),
        (hung(MARKER | {"id": 50}), r"marker 1 \(4x4_50 50\): 4x4_50 has the ids 0 to 49, found"),
        (hung(MARKER | {"position": [0, 0, float("nan")]}), "position must be finite"),
        (hung({"family": "4x4_50"}), "marker 1 has no id; it has nothing else"),
        (hung(PLAIN | {"rotation": np.diag([-1.0, 1.0, 1.0]).tolist()}), "the rotation mirrors"),
        (hung({"family": "4x4_50", "id": 1, "corners": [CORNERS[k] for k in (0, 2, 1, 3)]}),
         "the corners are not a square in the order top left, top right"),
        (hung(), "neither markers nor boards"),
        # The small dictionaries are the beginning of the large ones.
        (hung(MARKER, MARKER | {"family": "4x4_1000"}),
         "there twice: as marker 4x4_50 3 and as marker 4x4_1000 3"),
        ({"map_frame": "map", "boards": [CHESSBOARD, CHESSBOARD]},
         "2 boards without markers .*, which cannot be told apart"),
        ({"tags": [{"ID": 3}]}, "its format is not known"),
    ],
)  # fmt: skip
def test_faults(tmp_path, tree, text):
    with pytest.raises(MarkerMapError, match=text) as error:
        read(tmp_path, tree)
    assert str(tmp_path / "map.yaml") in str(error.value)


def test_points_of_a_board_are_known_as_paper_is_unless_its_file_says_better(tmp_path):
    paper = read(tmp_path, {"map_frame": "map", "boards": [CHESSBOARD]})
    x, y = np.mgrid[-2.5:3, -1.5:2] * 0.03
    rms = np.sqrt(np.mean(x**2 + y**2))
    assert paper.settings == pytest.approx({"map_deviation": 0.002 * rms})
    measured = paper.with_points(paper.points + np.array([0.0, 0.0, 1e-3]), 3.21e-4)
    write_marker_map(tmp_path / "again.yaml", measured)
    again = read_marker_map(tmp_path / "again.yaml")
    assert again.settings == pytest.approx({"map_deviation": 3.21e-4})
    np.testing.assert_allclose(again.points, measured.points)
    exact = [CHESSBOARD | {"deviation": 0}, CHARUCO]
    mean = read(tmp_path, {"map_frame": "map", "boards": exact}).settings["map_deviation"]
    alone = read(tmp_path, {"map_frame": "map", "boards": [CHARUCO]}).settings["map_deviation"]
    assert mean == pytest.approx(np.sqrt(6 / 30) * alone)
    # Markers are exact: what their places are worth is their survey's to say.
    assert read(tmp_path, {"map_frame": "map", "markers": [MARKER]}).settings == {}
    with pytest.raises(MarkerMapError, match="deviation must be 0 or more metres, found -1"):
        read(tmp_path, {"map_frame": "map", "boards": [CHESSBOARD | {"deviation": -1}]})


SIZE = 0.16

# At x = 1, 2 m up: faces along -x, so that its viewer looks along +x and has y to the left.
BUNDLE = """
standalone_tags: []
tag_bundles:
  [
    {name: 'wall', layout: [
      {id: 0, size: 0.16, x: 0.0, y: 0.0, z: 0.0, qw: 1.0, qx: 0.0, qy: 0.0, qz: 0.0},
      {id: 3, size: 0.08, x: 0.5, qw: 0.7071068, qz: 0.7071068}]},
  ]
"""


def as_file(folder: Path, text: str, name: str = "map.yaml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_bundles_of_apriltag_ros(tmp_path):
    found, kind = read_any(as_file(tmp_path, BUNDLE))
    assert (kind, [marker.id for marker in found.markers]) == ("apriltag_ros", [0, 3])
    # x to the right, y up: turned by a quarter, up is to the left.
    np.testing.assert_allclose(found.markers[1].corners[0], [0.46, -0.04, 0.0], atol=1e-7)
    two = BUNDLE.replace("  ]\n", "    {name: floor, layout: []},\n  ]\n")
    with pytest.raises(MarkerMapError, match="2 bundles, each in a frame of its own"):
        read_any(as_file(tmp_path, two))


def test_the_family_of_a_bundle_is_that_of_its_file(tmp_path):
    named = BUNDLE + "tag_family: tag25h9\n"
    (first, _) = read_any(as_file(tmp_path, named))[0].markers
    assert first.family.name == "apriltag_25h9"
    with pytest.raises(MarkerMapError, match="unknown family 'tag9h9'"):
        read_any(as_file(tmp_path, named.replace("tag25h9", "tag9h9")))


def test_deviations_of_a_survey_are_kept(tmp_path):
    known = np.array([0.001, 0.002, 0.0031, 0.01, 0.02, 0.03])
    pose = Pose(np.array([0.5, 1.0, 2.0]), TURN.as_matrix())
    marker = replace(Marker.at("36h11", 0, SIZE, pose), deviations=known)
    path = tmp_path / "map.yaml"
    write_marker_map(path, MarkerMap((marker,)))
    (found,) = read_any(path)[0].markers
    np.testing.assert_allclose(found.deviations, known)
    broken = path.read_text().replace("rotation_deviation: [0.01", "rotation_deviation: [-0.01")
    with pytest.raises(MarkerMapError, match="deviations must not be negative"):
        read_any(as_file(tmp_path, broken))


@pytest.mark.parametrize("make", [
    lambda: Marker.at("4x4_50", 0, 100.0), lambda: Charuco(5, 7, 30.0, 20.0, family("5x5_50")),
])  # fmt: skip
def test_sizes_in_millimetres(make):
    with pytest.raises(ValueError, match="up to 10 metres"):
        make()


def test_corners_in_another_order_fit_no_homography():
    turn = Rotation.from_euler("xyz", [160.0, -15.0, 20.0], degrees=True).as_matrix()
    points = np.concatenate([some.corners for some in wall("4x4_50", (3, 2), 0.07, 0.03)[:2]])
    seen = points @ turn.T + [0.0, 0.0, 0.6]
    pixels = 500.0 * seen[:, :2] / seen[:, 2:]
    assert flat_misfit(points, pixels) < 1e-6
    for order in ([1, 2, 3, 0], [3, 2, 1, 0]):
        assert flat_misfit(points, pixels.reshape(2, 4, 2)[:, order].reshape(-1, 2)) > 0.25
    points[4:, 2] += 0.05
    assert np.isnan(flat_misfit(points, pixels))


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
    with pytest.raises(ValueError, match="id 0 takes 400 x 400 mm, more than a4 has room for"):
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
