# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Grids of circles and inverted boards: where their points are, and their order."""

from typing import Any

import numpy as np
import pytest

from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.prints import Chessboard, CircleGrid

FINE = 20  # drawn pixels per spacing


def drawn(grid: CircleGrid) -> Any:
    """White paper of the grid's extent with black discs, by its definition in OpenCV's manual."""
    wide = 2 if grid.asymmetric else 1
    y, x = np.mgrid[: FINE * grid.rows, : FINE * wide * grid.columns] + 0.5
    paper = np.ones(x.shape, bool)
    for row in range(grid.rows):
        for column in range(grid.columns):
            shift = row % 2 if grid.asymmetric else 0
            u, v = FINE * (wide * column + shift + 0.5), FINE * (row + 0.5)
            paper &= (x - u) ** 2 + (y - v) ** 2 > (0.35 * FINE) ** 2
    return paper != grid.inverted


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize(
    ("columns", "rows", "asymmetric"), [(5, 4, False), (4, 5, True), (4, 4, True)]
)
def test_centres_are_where_they_were_drawn(
    columns, rows, asymmetric, inverted, render, look, project, rectangle
):
    grid = CircleGrid(columns, rows, 0.03, asymmetric, inverted)
    width, height = grid.extent
    detector = MarkerDetector(MarkerMap(boards=(grid,)))
    pose = look(5.0, 10.0, distance=0.4)
    image = render([(drawn(grid), rectangle(width, height))], pose)
    if inverted:  # black paper around it
        image = 255 - render([(~drawn(grid), rectangle(width, height))], pose)
    seen = detector.detect(image)
    assert seen.ids.tolist() == list(range(columns * rows))
    np.testing.assert_allclose(seen.points, grid.points)
    np.testing.assert_allclose(seen.pixels, project(grid.points, pose), atol=0.4)


def test_an_inverted_chessboard(render, look, project, rectangle, chessboard_cells):
    board = Chessboard(6, 4, 0.03, inverted=True)
    pose = look(10.0)
    cells = chessboard_cells(7, 5)
    image = 255 - render([(cells, rectangle(7 * 0.03, 5 * 0.03))], pose)
    seen = MarkerDetector(MarkerMap(boards=(board,))).detect(image)
    np.testing.assert_allclose(seen.pixels, project(board.points, pose), atol=0.15)
    plain = Chessboard(6, 4, 0.03)
    upright = MarkerDetector(MarkerMap(boards=(plain,))).detect(255 - image)
    np.testing.assert_array_equal(upright.pixels, seen.pixels)
