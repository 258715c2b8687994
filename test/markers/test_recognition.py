# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What an image shows, for those whose map has nothing of it."""

import numpy as np
import pytest

from rs_localizer.markers.detection import chessboard_size, recognized
from rs_localizer.markers.dictionaries import pattern
from rs_localizer.markers.families import family
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.prints import Marker


@pytest.mark.parametrize("name", ["5x5_250", "apriltag_36h11"])
def test_markers_are_named_with_their_family(name, render, look):
    prints = []
    for x, id_ in ((-0.07, 3), (0.07, 17)):
        marker = Marker.at(name, id_, 0.1, Pose(np.array([x, 0.0, 0.0])))
        prints.append((pattern(family(name), id_), marker.corners))
    # By the smallest family that has such ids: the small ones are the beginning of the large ones.
    assert recognized(render(prints, look(4.0, 5.0))) == [f"{name.replace('250', '50')} 3, 17"]


@pytest.mark.parametrize(("columns", "rows"), [(7, 5), (4, 3), (6, 6)])
def test_the_size_of_a_chessboard(columns, rows, render, look, rectangle, chessboard_cells):
    cells = chessboard_cells(columns + 1, rows + 1)
    image = render([(cells, rectangle(0.22, 0.22 * (rows + 1) / (columns + 1)))], look(8.0))
    assert chessboard_size(image) == (columns, rows)
    assert recognized(image) == [f"a chessboard of {columns}x{rows} inner corners"]
