# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Chessboards and ChArUco boards in images, by OpenCV's own detectors."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.markers.dictionaries import Gray
from rs_localizer.markers.prints import Charuco, Chessboard

# Half the window of the sub-pixel search, as a share of the smallest distance between corners:
# the next corner must stay outside, and more of the edges inside means less noise.
_WINDOW_SHARE = 0.45
_WINDOW_RANGE = (2, 15)
_SMOOTHING = 1.0  # px
# The squares around a corner are sampled at this share of the way to the next corner. By the median
# contrast of all corners, 57 false corners of two public videos are below 0.37 and the others above
# 0.65; true corners behind a reflection have 0.38.
_BESIDE, _LEAST_CONTRAST = 0.12, 0.5
_SAME = 1.0  # px; the sub-pixel search ends at a saddle to a hundredth of this
# A chessboard is looked for in an image whose longer side is this (px) or less: where there is
# none, the search takes 50 ms in 640x480, and its time grows with more than the area.
# (cv2.checkChessboard and the flag for it are fast, and overlook small boards.)
_LARGEST_SEARCH = 1024
# OpenCV's search fails in smaller ones (px), which cannot show a board.
_SMALLEST_SEARCH = 16
_REFINE_CRITERIA = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)


def find_chessboard(image: Gray, board: Chessboard, previous: Array | None = None) -> Array | None:
    """Return the pixels (n,2) of a chessboard's inner corners, in the order of ``board.points``.

    The top left square of the board is assumed to be black. If the board looks the same rotated by
    half (columns + rows is even; a square board also by a quarter), the order closest to the
    ``previous`` corners is taken; without them, the order that reads like text.

    Returns:
        None when the whole board is not seen.
    """
    small, scale = _shrunk(image)
    if min(small.shape) < _SMALLEST_SEARCH:
        return None
    complete, corners = cv2.findChessboardCorners(small, (board.columns, board.rows))
    if not complete:
        return None
    corners = scale * np.asarray(corners, np.float64) + 0.5 * (scale - 1)
    grid = corners.reshape(board.rows, board.columns, 2)
    gaps = [np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1)]
    window = int(np.clip(_WINDOW_SHARE * min(gaps), *_WINDOW_RANGE))
    smooth = _smooth(image)
    refined = _repaired(smooth, board, _refine(smooth, grid, window), window)
    if refined is None:
        return None
    return ordered(
        refined.reshape(board.rows, board.columns, 2),
        previous,
        lambda candidate: _starts_black(candidate, image),
    )


def _repaired(smooth: Gray, board: Chessboard, corners: Array, window: int) -> Array | None:
    """Return corners (n,2) with those that OpenCV put inside of squares searched again.

    The others say where; None: there are none.
    """
    strayed = _no_saddles(smooth, board, corners)
    if not strayed.any():
        return corners
    places = np.indices((board.columns, board.rows), np.float32).T.reshape(-1, 2)
    to_image, _ = cv2.findHomography(places[~strayed], corners[~strayed])
    if to_image is None:
        return None
    predicted = cv2.perspectiveTransform(places[None], to_image)[0]
    if not all(_inside(smooth, pixel, 0) for pixel in predicted[strayed]):
        return None
    repaired = corners.copy()
    repaired[strayed] = _refine(smooth, predicted[strayed], window)
    # Corners in a shadow or a reflection stay in place.
    moved = np.linalg.norm(repaired - corners, axis=1) > _SAME
    return None if np.any(moved & _no_saddles(smooth, board, repaired)) else repaired


def _no_saddles(smooth: Gray, board: Chessboard, corners: Array) -> NDArray[np.bool_]:
    """Return a mask (n,) of corners whose opposite squares differ or whose neighbours are alike."""
    grid = corners.reshape(board.rows, board.columns, 2)
    along, down = (np.asarray(np.gradient(grid, axis=axis)) for axis in (1, 0))

    def beside(i: int, j: int) -> Array:
        x, y = np.moveaxis(grid + _BESIDE * (i * along + j * down), -1, 0).astype(np.float32)
        values = cv2.remap(smooth, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(values, np.float64)

    row, column = np.indices(grid.shape[:2])
    opposite, other = beside(1, 1) + beside(-1, -1), beside(1, -1) + beside(-1, 1)
    contrast = (-1.0) ** (row + column) * (opposite - other)
    typical = np.median(contrast)
    return np.asarray(contrast * np.sign(typical) < _LEAST_CONTRAST * abs(typical)).ravel()


def find_charuco(
    image: Gray, board: Charuco, ids: NDArray[np.int64], quads: Array
) -> tuple[NDArray[np.int64], Array]:
    """Return the ids of visible inner corners of a ChArUco board, and their pixels.

    Args:
        image: gray.
        board: the board.
        ids: (m,) of the board's markers that are seen.
        quads: (m,4,2) their corners.

    Returns:
        rows (k,) of ``board.points`` and their pixels (k,2).
    """
    predicted: dict[int, list[Array]] = {}
    limits: dict[int, float] = {}
    for id_, quad in zip(ids.tolist(), quads, strict=True):
        for corner, pixel, limit in _around(board, id_ - board.first_id, quad):
            predicted.setdefault(corner, []).append(pixel)
            limits[corner] = min(limit, limits.get(corner, np.inf))
    rows, pixels = [], []
    smooth = _smooth(image) if predicted else image
    for corner in sorted(predicted):
        start = np.mean(predicted[corner], axis=0)
        window = int(np.clip(limits[corner], *_WINDOW_RANGE))
        if not _inside(image, start, window):
            continue
        refined = _refine(smooth, start, window)[0]
        if np.abs(refined - start).max() <= window:
            rows.append(corner)
            pixels.append(refined)
    return np.array(rows, np.int64), np.array(pixels, np.float64).reshape(-1, 2)


# Thickness of a plane, as a share of its smaller extent.
_FLAT = 0.02
# Distance of markers from their places by a homography, in their sides: for the right board (also
# by a fisheye lens), and for one whose markers are a square away.
_FITS, _MISFITS = 0.1, 0.25
_LEAST_MARKERS = 3


def flat_misfit(points: Array, pixels: Array) -> float:
    """Return how far coplanar markers lie from a homography, in their sides.

    No calibration is needed. NaN: the points are not of one plane; infinite: corners go the other
    way round, as of a mirrored map.

    Args:
        points: (4m,3) of their corners.
        pixels: (4m,2)
    """
    centred = points - points.mean(axis=0)
    _, extents, axes = np.linalg.svd(centred, full_matrices=False)
    if extents[2] > _FLAT * extents[1]:
        return np.nan
    quads = pixels.reshape(-1, 4, 2)
    x, y = np.moveaxis(quads, -1, 0)
    if np.any(np.sum(x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y, axis=1) <= 0.0):
        return np.inf
    flat = centred @ axes[:2].T
    homography, _ = cv2.findHomography(flat, pixels)
    if homography is None:
        return np.inf
    mapped = cv2.perspectiveTransform(flat[None], homography)[0]
    side = np.linalg.norm(np.roll(quads, -1, axis=1) - quads, axis=2).mean()
    return float(np.sqrt(np.mean(np.sum((mapped - pixels) ** 2, axis=1))) / side)


def charuco_fault(board: Charuco, ids: NDArray[np.int64], quads: Array) -> str | None:
    """Describe the layout that fits instead, if markers (m,) lie elsewhere: (m,4,2) px.

    The other layout or exchanged sizes put each marker one square or more beside its place.
    """
    if len(ids) < _LEAST_MARKERS:
        return None

    def misfit(of: Charuco) -> float:
        rows = ids - of.first_id
        if rows.max() >= len(of.cells):
            return np.inf
        corners = np.array([marker.corners for marker in of.markers])[rows]
        return flat_misfit(corners.reshape(-1, 3), quads.reshape(-1, 2))

    flat = replace(board, shape=None)
    if not misfit(flat) > _MISFITS:
        return None
    turned = replace(flat, columns=board.rows, rows=board.columns)
    for other in (replace(flat, legacy=not board.legacy), turned,
                  replace(turned, legacy=not board.legacy)):  # fmt: skip
        if misfit(other) < _FITS:
            said = (
                f"columns: {other.columns}, rows: {other.rows}, legacy: {str(other.legacy).lower()}"
            )
            return f"the images show {board.name} with {said}; it is not used as the map has it"
    return None


def _shrunk(image: Gray) -> tuple[Gray, int]:
    """Return a smaller image, in which a board is found soon, and the factor."""
    height, width = image.shape
    scale = -(-max(height, width) // _LARGEST_SEARCH)
    if scale == 1:
        return image, 1
    # A pixel becomes of scale x scale whole ones: pixel centres stay exact.
    size = (max(1, width // scale), max(1, height // scale))
    whole = image[: size[1] * scale, : size[0] * scale]
    return np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_AREA), np.uint8), scale


def _around(board: Charuco, index: int, quad: Array) -> list[tuple[int, Array, float]]:
    """Return inner corners at the square of a marker: row in the board, predicted pixel, window."""
    column, row = board.cells[index]
    # Corners of the square in units of the marker, which is the unit square here.
    rim = 0.5 * (board.square / board.marker - 1.0)
    unit = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], np.float32)
    square = np.array([[-rim, -rim], [1 + rim, -rim], [1 + rim, 1 + rim], [-rim, 1 + rim]])
    to_image = cv2.getPerspectiveTransform(unit, quad.astype(np.float32))
    corners = cv2.perspectiveTransform(square[None], to_image)[0]
    side = float(np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1).min())
    # The window must not reach the marker's own corner, nor the next corner of the board.
    limit = side * min(rim, _WINDOW_SHARE)
    places = ((column - 1, row - 1), (column, row - 1), (column, row), (column - 1, row))
    return [
        (y * (board.columns - 1) + x, pixel, limit)
        for (x, y), pixel in zip(places, corners, strict=True)
        if 0 <= x < board.columns - 1 and 0 <= y < board.rows - 1
    ]


def _inside(image: Gray, pixel: Array, window: int) -> bool:
    height, width = image.shape
    margin = window + 1
    return bool(margin <= pixel[0] < width - margin and margin <= pixel[1] < height - margin)


def _smooth(image: Gray) -> Gray:
    # The gradients of the raw image are those of its noise and of JPEG's blocks, too.
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _SMOOTHING), np.uint8)


def _refine(smooth: Gray, corners: Array, window: int) -> Array:
    """Return the saddles (n,2) near the corners, to a fraction of a pixel."""
    start = np.ascontiguousarray(np.reshape(corners, (-1, 1, 2)), np.float32)
    refined = cv2.cornerSubPix(smooth, start, (window, window), (-1, -1), _REFINE_CRITERIA)
    return np.asarray(refined, np.float64).reshape(-1, 2)


def ordered(
    grid: Array, previous: Array | None, possible: Callable[[Array], bool] = lambda grid: True
) -> Array:
    """Return the pixels (n,2) of a grid (rows,columns,2) in the order of its print, row by row.

    Of the orders that are ``possible``, the one that is closest to the ``previous`` pixels (n,2);
    without them, the one that reads as text does.
    """
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0.0:
        grid = grid[:, ::-1]  # a mirrored order would show the board from behind
    turns = range(4) if grid.shape[0] == grid.shape[1] else range(0, 4, 2)
    candidates = [np.rot90(grid, turn) for turn in turns]
    agreed = [candidate for candidate in candidates if possible(candidate)]
    if previous is not None:
        reference = previous.reshape(grid.shape)
        costs = [float(np.abs(candidate - reference).sum()) for candidate in agreed or candidates]
    else:
        costs = [float(candidate[0, 0].sum()) for candidate in agreed or candidates]
    return (agreed or candidates)[int(np.argmin(costs))].reshape(-1, 2)


def _starts_black(grid: Array, image: Gray) -> bool:
    """Return True if the first square between the corners, and the one before it, is black."""
    first = grid[0:2, 0:2].mean(axis=(0, 1))
    second = grid[0:2, 1:3].mean(axis=(0, 1))
    (x, y), (u, v) = np.rint(first).astype(int), np.rint(second).astype(int)
    return bool(image[y, x] < image[v, u])
