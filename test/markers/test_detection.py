# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Corners of rendered markers and boards: where they are, their order, and which are left out."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.markers.dictionaries import pattern
from rs_localizer.markers.edges import refine
from rs_localizer.markers.families import FAMILIES, Family, family
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.markers.prints import Charuco, Chessboard, Marker, Pose

from .prints import chessboard_cells, look, project, rectangle, render

SIZE = 0.1


def printed(one: Family) -> Any:
    """Cells of id 0 as its authors print it, from its code and not by OpenCV."""
    bits = [one.first >> k & 1 for k in reversed(range(one.bits**2))]
    return np.pad(np.array(bits, bool).reshape(one.bits, one.bits), one.border)


AVAILABLE = [name for name, one in FAMILIES.items() if hasattr(cv2.aruco, one.constant)]


@pytest.mark.parametrize("name", AVAILABLE)
def test_corners_of_every_family_are_those_of_the_upright_print(name):
    marker = Marker.at(name, 0, SIZE)
    detector = MarkerDetector(MarkerMap((marker,)))
    # The camera upright, and turned by a bit more than each quarter.
    for roll in (0.0, 100.0, 195.0, 290.0):
        pose = look(roll)
        found = detector.detect(render([(printed(marker.family), marker.corners)], pose))
        assert found.ids.tolist() == [0, 1, 2, 3]
        np.testing.assert_allclose(found.pixels, project(marker.corners, pose), atol=0.1)
        np.testing.assert_allclose(found.points, marker.corners)


def test_april_tags_are_the_published_ones():
    # tag36h11 0 inside its black border, # is white: code 0xd7e00984b of tag36h11.c of
    # github.com/AprilRobotics/apriltag, its bits at the places of bit_x and bit_y.
    rows = ("##.#.#", ".###.#", ".##...", "#.#...", ".#.##.", "...#..")
    white = [[cell == "#" for cell in row] for row in rows]
    assert (pattern(family("36h11"), 0)[1:-1, 1:-1] == white).all()


@pytest.mark.parametrize("blur", [0.5, 1.0])
def test_corners_have_no_bias(blur):
    rng = np.random.default_rng(5)
    errors, outward = [], []
    for index in range(40):
        name = ("5x5_100", "apriltag_36h11")[index % 2]
        marker = Marker.at(name, index % 20, SIZE)
        pose = look(*rng.uniform([0, -30, 0.3, -0.03, -0.03], [360, 30, 0.6, 0.03, 0.03]))
        cells = pattern(marker.family, marker.id)
        image = render([(cells, marker.corners)], pose, blur=blur, noise=2.0, seed=index)
        found = MarkerDetector(MarkerMap((marker,))).detect(image)
        assert len(found.ids) == 4
        true = project(marker.corners, pose)
        away = true - true.mean(axis=0)
        errors.append(found.pixels - true)
        outward.append(np.sum(errors[-1] * away / np.linalg.norm(away, axis=1)[:, None], axis=1))
    error = np.concatenate(errors)
    assert np.abs(error.mean(axis=0)).max() < 0.01
    assert abs(np.mean(outward)) < 0.02  # cv2.cornerSubPix: -0.2 to -0.4
    assert np.sqrt(np.mean(error**2)) < 0.06


def test_what_covers_a_corner_does_not_move_it():
    marker = Marker.at("4x4_50", 3, SIZE)
    pose = look()
    image = render([(pattern(marker.family, 3), marker.corners)], pose)
    pixels = project(marker.corners, pose)
    x, y = np.rint(pixels[1]).astype(int)
    for covered, expected in ((25, [0, 1, 2, 3]), (60, [0, 3])):
        image[y - 5 : y + covered, x - 5 : x + 12] = 120
        quads = pixels[None] + 0.5
        found = refine(image, quads, marker.family.cells)
        assert np.flatnonzero(found[0]).tolist() == expected
        np.testing.assert_allclose(quads[found], pixels[found[0]], atol=0.25)


def test_ids_are_rows_of_the_maps_points():
    turned = Pose(np.array([0.0, 0.0, 0.0]), np.diag([-1.0, -1.0, 1.0]))
    walls = wall("4x4_50", (2, 2), 0.06, 0.02, first_id=10, pose=turned)
    board = Chessboard(4, 3, 0.02, pose=Pose(np.array([0.0, 0.13, 0.0])))
    marker_map = MarkerMap(walls, (board,), "hall")
    prints = [(pattern(m.family, m.id), m.corners) for m in walls]
    prints.append((chessboard_cells(5, 4), rectangle(0.1, 0.08) + np.array([0.0, 0.13, 0.0])))
    pose = look(roll=20.0, distance=0.5, y=0.05)
    image = render(prints, pose)
    found = MarkerDetector(marker_map).detect(image)
    assert found.ids.tolist() == list(range(16 + 12))
    np.testing.assert_allclose(found.points, marker_map.points)
    np.testing.assert_allclose(found.pixels, project(found.points, pose), atol=0.12)
    assert found.scores.min() > 5.0
    assert [name for name, _ in found.boards] == ["chessboard 4x3"]
    again = MarkerDetector(marker_map).detect(image)
    np.testing.assert_array_equal(again.pixels, found.pixels)


def test_noise_shows_nothing():
    noise = np.random.default_rng(0).integers(0, 256, (240, 320), np.uint8)
    marker_map = MarkerMap(
        wall("apriltag_36h11", (10, 10), 0.1, 0.1),
        (Charuco(5, 7, 0.04, 0.03, family("5x5_100")), Chessboard(6, 4, 0.03)),
    )
    assert len(MarkerDetector(marker_map).detect(noise).ids) == 0


# -- boards -------------------------------------------------------------------------------------


def board_image(columns: int, rows: int, pose: Any) -> Any:
    outline = rectangle(0.03 * (columns + 1), 0.03 * (rows + 1))
    return render([(chessboard_cells(columns + 1, rows + 1), outline)], pose)


def detect_board(board: Chessboard, *images: Any) -> list[Any]:
    detector = MarkerDetector(MarkerMap(boards=(board,)))
    return [detector.detect(image, index * 10**8) for index, image in enumerate(images)]


def test_corners_inside_of_squares_are_looked_for_again(monkeypatch):
    board, find = Chessboard(6, 4, 0.03), cv2.findChessboardCorners
    image = board_image(6, 4, look(25.0))

    def mistaken(image, size):
        complete, corners = find(image, size)
        corners[[0, 9, 22], 0] += 0.35 * (corners[7, 0] - corners[0, 0])
        return complete, corners

    monkeypatch.setattr(cv2, "findChessboardCorners", mistaken)
    (found,) = detect_board(board, image)
    np.testing.assert_allclose(found.pixels, project(board.points, look(25.0)), atol=0.12)


def test_large_images_are_searched_in_a_small_one():
    # 50 megapixels; squares of 300 px, the first inner corner between pixels 1299 and 1300.
    image = np.full((6144, 8192), 200, np.uint8)
    drawn = np.kron(chessboard_cells(7, 5), np.ones((300, 300)))
    image[1000:2500, 1000:3100] = np.where(drawn > 0, 220, 30)
    square = Marker.at("4x4_50", 5, SIZE)
    cells = np.kron(pattern(square.family, 5), np.ones((100, 100)))
    image[4000:4600, 7000:7600] = np.where(cells > 0, 220, 30)
    detector = MarkerDetector(MarkerMap((square,), (Chessboard(6, 4, 0.03),)))
    found = detector.detect(image)
    assert found.ids.tolist() == list(range(4 + 24))
    corners = [[7000, 4000], [7600, 4000], [7600, 4600], [7000, 4600]]
    np.testing.assert_allclose(found.pixels[:4], np.array(corners) - 0.5, atol=0.05)
    y, x = np.mgrid[:4, :6]
    expected = np.stack([1300 + 300 * x, 1300 + 300 * y], axis=-1).reshape(-1, 2) - 0.5
    np.testing.assert_allclose(found.pixels[4:], expected, atol=0.05)


def test_order_of_a_symmetric_board_is_kept_through_a_full_turn():
    board, rolls = Chessboard(6, 4, 0.03), np.arange(0.0, 360.0, 30.0)
    poses = [look(roll) for roll in rolls]
    images = [board_image(6, 4, p) for p in poses]
    for found, pose in zip(detect_board(board, *images), poses, strict=True):
        errors = found.pixels - project(board.points, pose)
        assert np.abs(errors).max() < 0.15  # the squares are 25 px wide
        assert np.abs(errors.mean(axis=0)).max() < 0.03
    # Alone, or a second after the board was seen last, it is read as text.
    upside_down = images[6]
    (found,) = detect_board(board, upside_down)
    np.testing.assert_allclose(found.pixels, project(board.points, poses[6])[::-1], atol=0.12)
    detector = MarkerDetector(MarkerMap(boards=(board,)))
    detector.detect(images[0], 0)
    found = detector.detect(upside_down, 10**9 + 1)
    np.testing.assert_allclose(found.pixels, project(board.points, poses[6])[::-1], atol=0.12)


def test_order_of_other_boards_follows_from_their_colors():
    for columns, rows in ((5, 4), (4, 5)):
        board = Chessboard(columns, rows, 0.03)
        for roll in (0.0, 80.0, 180.0):
            image = board_image(columns, rows, look(roll))
            (found,) = detect_board(board, image)
            np.testing.assert_allclose(found.pixels, project(board.points, look(roll)), atol=0.15)


def charuco_cells(board: Charuco) -> Any:
    """The board as OpenCV draws it, 12 x 12 dots per square and 8 x 8 per marker."""
    aruco = cv2.aruco
    dictionary = aruco.getPredefinedDictionary(getattr(aruco, board.family.constant))
    size, dots = (board.columns, board.rows), (12 * board.columns, 12 * board.rows)
    if hasattr(aruco, "CharucoBoard_create"):
        drawn = aruco.CharucoBoard_create(*size, 3.0, 2.0, dictionary).draw(dots)
    else:
        drawing = aruco.CharucoBoard(size, 3.0, 2.0, dictionary)
        if board.legacy:
            drawing.setLegacyPattern(True)
        drawn = drawing.generateImage(dots)
    return drawn > 127


@pytest.mark.parametrize(("rows", "legacy"), [(5, False), (6, False), (6, True)])
def test_charuco_corners_are_those_of_opencvs_board(rows, legacy):
    if legacy and not hasattr(cv2.aruco.CharucoBoard, "setLegacyPattern"):
        return  # before OpenCV 4.8, it draws one kind only
    board = Charuco(4, rows, 0.03, 0.02, family("6x6_250"), legacy=legacy)
    cells, outline = charuco_cells(board), rectangle(0.12, 0.03 * rows)
    detector = MarkerDetector(MarkerMap(boards=(board,)))
    for roll in (0.0, 130.0):
        pose = look(roll, distance=0.32)
        found = detector.detect(render([(cells, outline)], pose))
        assert found.ids.tolist() == list(range(3 * (rows - 1)))
        np.testing.assert_allclose(found.pixels, project(board.points, pose), atol=0.15)
    # Half of it is enough.
    pose = look(10.0, distance=0.25, x=0.12)
    found = detector.detect(render([(cells, outline)], pose))
    assert 3 <= len(found.ids) < 3 * (rows - 1)
    np.testing.assert_allclose(found.pixels, project(board.points[found.ids], pose), atol=0.15)


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("told", ["layout", "exchanged", "both"])
def test_a_charuco_board_that_is_another_one_is_named(legacy, told):
    """Its corners would be a square off in every second row, or anywhere."""
    if not hasattr(cv2.aruco.CharucoBoard, "setLegacyPattern"):
        return
    true = Charuco(6, 4, 0.03, 0.02, family("6x6_250"), legacy=legacy)
    wrong = Charuco(4, 6, 0.03, 0.02, true.family, legacy=legacy)
    if told != "exchanged":
        wrong = replace(true if told == "layout" else wrong, legacy=not legacy)
    image = render([(charuco_cells(true), rectangle(0.18, 0.12))], look(8.0, distance=0.3))
    found = MarkerDetector(MarkerMap(boards=(wrong,))).detect(image)
    assert len(found.ids) == 0
    (said,) = found.faults
    assert f"columns: 6, rows: 4, legacy: {str(legacy).lower()}; it is not used" in said
    assert MarkerDetector(MarkerMap(boards=(true,))).detect(image).faults == ()


KALIBR = "target_type: 'aprilgrid'\ntagCols: 3\ntagRows: 2\ntagSize: 0.05\ntagSpacing: 0.3\n"


def test_an_aprilgrid_of_kalibr(tmp_path):
    """Its tags have borders of two cells, and black squares between their corners."""
    (tmp_path / "target.yaml").write_text(KALIBR)
    target = read_marker_map(tmp_path / "target.yaml")
    # The lower left corner of tag 0 is the origin, x is right, y up.
    np.testing.assert_allclose(target.markers[0].corners[3], 0.0, atol=1e-12)
    np.testing.assert_allclose(target.markers[5].corners[1], [0.18, 0.115, 0.0], atol=1e-12)
    cells = np.ones((29, 42), bool)  # of 5 mm: tags of 10, and 3 between them
    for i, j in np.ndindex(4, 3):
        cells[13 * j : 13 * j + 3, 13 * i : 13 * i + 3] = False
    for marker in target.markers:
        i, j = marker.id % 3, 1 - marker.id // 3
        place = slice(13 * j + 3, 13 * j + 13), slice(13 * i + 3, 13 * i + 13)
        cells[place] = pattern(marker.family, marker.id)
    rotation, translation = look(5.0, distance=0.3)
    seen = rotation, translation - rotation @ [0.09, 0.0575, 0.0]
    image = render([(cells, rectangle(0.21, 0.145))], (rotation, translation), noise=1.0)
    found = MarkerDetector(target).detect(image)
    assert len(found.ids) >= 22
    np.testing.assert_allclose(found.pixels, project(found.points, seen), atol=0.5)


def square(left: float, top: float, side: float, blur: float = 0.0) -> np.ndarray:
    """A black square on white (80, 80), each pixel the mean of the light that falls on it."""
    inside = [
        np.clip(np.minimum(np.arange(80) + 0.5, start + side) -
                np.maximum(np.arange(80) - 0.5, start), 0.0, 1.0)
        for start in (left, top)
    ]  # fmt: skip
    image = 220.0 - 190.0 * inside[1][:, None] * inside[0]
    return cv2.GaussianBlur(image, (0, 0), blur) if blur > 0.0 else image


def error(image: np.ndarray, left: float, top: float, side: float, cells: int = 8) -> float:
    unit = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    return moved(image, [left, top] + side * unit, cells)


def moved(image: np.ndarray, truth: np.ndarray, cells: int) -> float:
    """The largest error (px) of corners (4,2), from a start that is half a pixel off."""
    quads = (truth + np.array([[0.4, -0.3], [-0.5, 0.2], [0.3, 0.5], [-0.2, -0.4]]))[None]
    gray = np.ascontiguousarray(np.clip(np.rint(image), 0, 255).astype(np.uint8))
    assert np.all(refine(gray, quads, cells))
    return float(np.abs(quads[0] - truth).max())


@pytest.mark.parametrize("blur", [0.0, 0.5, 1.0])
def test_an_edge_along_the_pixels_is_where_it_is(blur):
    """Weights by the squared slope draw a sharp edge to the middle of a pixel: 0.15 px."""
    for offset in np.linspace(0.0, 0.95, 20):
        left, top, side = 20.0 + offset, 22.0 - 0.7 * offset, 36.3
        assert error(square(left, top, side, blur), left, top, side) < 0.015


def ring(left: float, top: float, side: float, smear: tuple[float, float]) -> np.ndarray:
    """A square with a border of a cell, a sixth of its side, which moves by ``smear`` cells."""
    cell, steps = side / 6.0, (np.arange(60) + 0.5) / 60 - 0.5
    images = [
        square(left + dx, top + dy, side)
        + 220.0
        - square(left + dx + cell, top + dy + cell, side - 2.0 * cell)
        for dx, dy in cell * steps[:, None] * np.array(smear)
    ]
    return np.mean(images, axis=0)


@pytest.mark.parametrize("smear", [(0.7, 0.0), (1.05, 0.4), (0.7, -0.8)])
@pytest.mark.parametrize("side", [30.0, 45.3])
def test_a_smeared_edge_is_where_it_was_amid_the_exposure(smear, side):
    """Smeared by a cell, hardly any black is left between the white of both sides."""
    for offset in np.linspace(0.0, 0.9, 4):
        left, top = 18.0 + offset, 17.0 - 0.7 * offset
        image = ring(left, top, side, smear)
        assert error(image, left, top, side, cells=6) < 0.1


def test_the_sides_of_a_slanted_marker_keep_clear_of_each_other():
    """A rhomb of 25 degrees: its rows are a sixth of its height apart, not of its sides."""
    angle, side = np.deg2rad(25.0), 40.0
    along = side * np.array([[1.0, 0.0], [np.cos(angle), np.sin(angle)]])
    for shift in ((0.0, 0.0), (0.3, 0.6), (0.7, 0.2)):
        corner = np.array([3.0, 30.0]) + shift
        fine = (np.arange(640) + 0.5) / 8.0 - 0.5
        x, y = np.meshgrid(fine, fine)
        a, b = np.tensordot(np.linalg.inv(along.T), np.stack([x, y]) - corner[:, None, None], 1)
        inside = np.maximum(abs(a - 0.5), abs(b - 0.5)) < 1 / 2
        hole = np.maximum(abs(a - 0.5), abs(b - 0.5)) < 1 / 3
        image = 220.0 - 190.0 * (inside & ~hole).reshape(80, 8, 80, 8).mean(axis=(1, 3))
        truth = corner + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) @ along
        assert moved(image, truth, cells=6) < 0.2


def test_the_sides_of_a_fisheyes_marker_are_curves():
    """Equidistant, f = 260 px: straight lines through sides of 35 px meet too far outside."""
    focal, side, outward = 260.0, 46.0, []
    fine = (np.arange(640) + 0.5) / 8.0 - 0.5
    pixels = np.stack(np.meshgrid(fine, fine), -1)
    for shift in np.linspace(0.0, 0.9, 4):
        middle = np.array([-120.0 + shift, -60.0 - 0.7 * shift])
        about = pixels - middle
        away = np.linalg.norm(about, axis=-1, keepdims=True)
        plane = focal * np.tan(away / focal) * about / away
        a, b = np.moveaxis((plane - plane[320, 320]) / side, -1, 0)
        inside = np.maximum(abs(a), abs(b)) < 1 / 2
        image = 220.0 - 190.0 * inside.reshape(80, 8, 80, 8).mean(axis=(1, 3))
        corners = plane[320, 320] + side * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) / 2
        far = np.linalg.norm(corners, axis=1, keepdims=True)
        truth = middle + focal * np.arctan(far / focal) * corners / far
        quads = truth[None] + 0.3
        assert refine(np.rint(image).astype(np.uint8), quads, 6).all()
        outward.append(np.sum((quads[0] - truth) * (truth - middle), axis=1) / far[:, 0])
    assert abs(np.mean(outward)) < 0.03
