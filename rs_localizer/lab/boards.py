"""Corners of a chessboard in images, in the same order from image to image."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from rs_localizer.core.so3 import Array
from rs_localizer.lab.video import Image

# Half the window of the sub-pixel search, as a share of the smallest distance between corners:
# the next corner must stay outside, and more of the edges inside means less noise.
_WINDOW_SHARE = 0.45
_WINDOW_RANGE = (2, 15)
_SMOOTHING = 1.0  # px
_REFINE_CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)


@dataclass(frozen=True, slots=True)
class Board:
    """A chessboard by its inner corners."""

    columns: int
    rows: int
    square: float  # m

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:  # OpenCV's own limit
            raise ValueError(f"a board needs 3x3 inner corners, got {self.columns}x{self.rows}")
        if not 0.0 < self.square < np.inf:
            raise ValueError(f"the squares must have a size in metres, got {self.square}")

    @property
    def points(self) -> Array:
        """Corners (n,3), row by row: x along a row, y from row to row, z away from the viewer."""
        y, x = np.mgrid[: self.rows, : self.columns]
        corners = np.stack([x, y, np.zeros_like(x)], axis=-1)
        return np.asarray(corners.reshape(-1, 3) * self.square, np.float64)


def find_corners(image: Image, board: Board, previous: Array | None = None) -> Array | None:
    """Pixels (n,2) of the board's inner corners in the order of ``Board.points``.

    A board looks the same turned by half (a square one by a quarter): the order is the one that
    is closest to the ``previous`` corners; without them, the one that reads as text does.

    Returns:
        None when the whole board is not seen.
    """
    size = (board.columns, board.rows)
    found, corners = cv2.findChessboardCorners(image, size)
    if not found:
        return None
    grid = corners.reshape(board.rows, board.columns, 2)
    gaps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
    window = int(np.clip(_WINDOW_SHARE * min(gaps), *_WINDOW_RANGE))
    # The gradients of the raw image are those of its noise and of JPEG's blocks, too.
    smooth = cv2.GaussianBlur(image, (0, 0), _SMOOTHING)
    refined = cv2.cornerSubPix(
        smooth, np.asarray(corners, np.float32), (window, window), (-1, -1), _REFINE_CRITERIA
    )
    grid = np.asarray(refined, np.float64).reshape(board.rows, board.columns, 2)
    return _ordered(grid, previous).reshape(-1, 2)


def _ordered(grid: Array, previous: Array | None) -> Array:
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0.0:
        grid = grid[:, ::-1]  # a mirrored order would show the board from behind
    turns = range(4) if grid.shape[0] == grid.shape[1] else range(0, 4, 2)
    candidates = [np.rot90(grid, turn) for turn in turns]
    if previous is not None:
        reference = previous.reshape(grid.shape)
        costs = [float(np.abs(candidate - reference).sum()) for candidate in candidates]
    else:
        costs = [float(candidate[0, 0].sum()) for candidate in candidates]
    return candidates[int(np.argmin(costs))]
