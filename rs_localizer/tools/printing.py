# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A board or a wall of markers as PDF, true to scale."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.markers.dictionaries import pattern
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.prints import Board, Chessboard, Pose

# Upright, in mm.
PAGES = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
# mm: printers leave about 5 white; the foot holds a bar to measure and what is said.
_MARGIN, _FOOT, _BAR = 10.0, 16.0, 100.0
_MM, _INCH = 1000.0, 25.4


@dataclass(frozen=True, slots=True, eq=False)
class Page:
    """Black rectangles on a sheet, in mm from its lower left corner."""

    width: float
    height: float
    black: Array  # (n,4) left, bottom, width, height
    text: str  # at its foot


def largest_side(page: str, across: float, down: float) -> float:
    """Return the side (m, whole 5 mm) of the largest squares of which this many fit on a page.

    Args:
        page: one of :data:`PAGES`, upright or on its side.
        across, down: how many sides the print is wide and high.
    """
    rooms = (_room(width, height) for width, height in (PAGES[page], PAGES[page][::-1]))
    side = max(min(width / across, height / down) for width, height in rooms)
    return side // 5.0 * 5.0 / _MM


def plan(marker_map: MarkerMap, page: str = "a4") -> list[Page]:
    """Return a page for a board or a wall of markers, or one per marker if they do not fit.

    Args:
        marker_map: what is printed: one board, or markers in one plane that face the same way.
        page: one of :data:`PAGES`.

    Raises:
        ValueError: when something is larger than the page.
    """
    if marker_map.boards:
        (board,) = marker_map.boards
        black, label = _board(board)
        return [_page(black, page, f"{label}; mount it on something flat", board.pose)]
    markers = marker_map.markers
    first = markers[0].pose
    of = f"{markers[0].family.name}, {markers[0].size * _MM:g} mm"
    parts = []  # around the middle of each
    for marker in markers:
        side = marker.size * _MM
        black = _rectangles(pattern(marker.family, marker.id), side / marker.family.cells)
        parts.append(black - np.array([0.5 * side, 0.5 * side, 0.0, 0.0]))
    places = [(marker.pose.position - first.position) @ first.rotation * _MM for marker in markers]
    moved = [(x, y, 0.0, 0.0) for x, y, _ in places]
    black = np.concatenate([part + to for part, to in zip(parts, moved, strict=True)])
    if _paper(black, page) is not None:
        return [_page(black, page, f"{of}, {len(markers)} from id {markers[0].id} on", first)]
    pages = []
    for marker, part in zip(markers, parts, strict=True):
        place = ", ".join(f"{value:g}" for value in np.round(marker.pose.position, 4) + 0.0)
        text = f"{of}, id {marker.id}: its middle goes to ({place}) m of the map"
        pages.append(_page(part, page, text, marker.pose))
    return pages


def _page(black: Array, page: str, text: str, pose: Pose) -> Page:
    """Return a page with the rectangles in its middle."""
    paper = _paper(black, page)
    low, high = black[:, :2].min(axis=0), (black[:, :2] + black[:, 2:]).max(axis=0)
    if paper is None:
        width, height = high - low
        of = text.partition(": its")[0].partition(";")[0]
        raise ValueError(
            f"{of} takes {width:.0f} x {height:.0f} mm, more than {page} has room for; choose a "
            "larger page or a smaller size"
        )
    room = np.array([paper[0], paper[1] + _FOOT])
    axes = np.abs(pose.rotation).argmax(axis=0)
    right, up, out = (
        f"{'+' if pose.rotation[axis, k] > 0 else '-'}{'xyz'[axis]}" for k, axis in enumerate(axes)
    )
    text += f"\nmap: {right} to the right, {up} up, {out} out of the paper"
    moved = black + np.array([*(0.5 * (room - low - high)), 0.0, 0.0])
    return Page(*paper, moved, text)


def _paper(black: Array, page: str) -> tuple[float, float] | None:
    """Return the page, upright or on its side, on which rectangles fit."""
    size = (black[:, :2] + black[:, 2:]).max(axis=0) - black[:, :2].min(axis=0)
    for width, height in (PAGES[page], PAGES[page][::-1]):
        if np.all(size <= np.array(_room(width, height)) + 1e-9):
            return width, height
    return None


def _room(width: float, height: float) -> tuple[float, float]:
    """Return the part of a sheet (mm) that is left between its margins and above its foot."""
    return width - 2 * _MARGIN, height - 2 * _MARGIN - _FOOT


def _board(board: Board) -> tuple[Array, str]:
    """Return the rectangles of a board, and its description."""
    square, label = board.square * _MM, f"{board.name}, squares {board.square * _MM:g} mm"
    if isinstance(board, Chessboard):
        places = np.indices((board.rows + 1, board.columns + 1)).sum(axis=0)
        return _rectangles(places % 2 == 1, square), label
    white = np.zeros((board.rows, board.columns), bool)
    white[tuple(np.transpose(board.cells)[::-1])] = True
    black, side = [_rectangles(white, square)], board.marker * _MM
    rim, cell = 0.5 * (square - side), side / board.family.cells
    for index, (column, row) in enumerate(board.cells):
        inside = _rectangles(pattern(board.family, board.first_id + index), cell)
        x, y = column * square + rim, (board.rows - 1 - row) * square + rim
        black.append(inside + np.array([x, y, 0.0, 0.0]))
    return np.concatenate(black), f"{label}, markers {side:g} mm"


def _rectangles(white: NDArray[np.bool_], cell: float) -> Array:
    """Return the black cells as rectangles (n,4), as few as runs along the rows make them."""
    rectangles = []
    for row, cells in enumerate(white[::-1]):
        edges = np.flatnonzero(np.diff(np.concatenate([[True], cells, [True]]).astype(int)))
        for start, end in edges.reshape(-1, 2).tolist():
            rectangles.append([start * cell, row * cell, (end - start) * cell, cell])
    return np.array(rectangles, np.float64).reshape(-1, 4)


def write_pages(pages: list[Page], path: Path) -> None:
    """Write a PDF."""
    from matplotlib.backends.backend_pdf import PdfPages

    with PdfPages(path) as document:
        for k, page in enumerate(pages):
            document.savefig(draw(page, f"page {k + 1} of {len(pages)}"))


def draw(page: Page, number: str) -> Any:
    """Return the figure of a page, true to scale, with its number at the foot."""
    from matplotlib.figure import Figure
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    figure = Figure(figsize=(page.width / _INCH, page.height / _INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, page.width), ylim=(0.0, page.height))
    axes.set_axis_off()
    # One path: between several, a viewer would show hairlines. Snapped to pixels, sizes are wrong.
    outline = Outline.make_compound_path(
        *(Outline([[x, y], [x + w, y], [x + w, y + h], [x, y + h], [x, y]], closed=True)
          for x, y, w, h in page.black)
    )  # fmt: skip
    axes.add_patch(PathPatch(outline, facecolor="black", edgecolor="none", snap=False))
    axes.plot([_MARGIN, _MARGIN + _BAR], [_MARGIN, _MARGIN], color="black", linewidth=0.5)
    for k in range(11):
        x, tick = _MARGIN + 0.1 * _BAR * k, 2.0 if k % 5 else 3.0
        axes.plot([x, x], [_MARGIN, _MARGIN + tick], color="black", linewidth=0.5)
    said = f"{page.text}\nprint at 100 %: this bar is {_BAR:.0f} mm long; {number}"
    axes.text(_MARGIN, _MARGIN + 4.0, said, fontsize=6.0)
    return figure
