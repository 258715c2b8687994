"""What an image shows, for those whose map has nothing of it."""

import pytest

from rs_localizer.markers.recognition import chessboard_size, recognized


@pytest.mark.parametrize(("columns", "rows"), [(7, 5), (4, 3), (6, 6)])
def test_the_size_of_a_chessboard(columns, rows, render, look, rectangle, chessboard_cells):
    cells = chessboard_cells(columns + 1, rows + 1)
    image = render([(cells, rectangle(0.22, 0.22 * (rows + 1) / (columns + 1)))], look(8.0))
    assert chessboard_size(image) == (columns, rows)
    assert recognized(image) == [f"a chessboard of {columns}x{rows} inner corners"]
