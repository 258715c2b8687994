# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Markers and boards laid out on pages, and printed as PDF or PNG, true to scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.markers.dictionaries import pattern
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.prints import Board, Charuco, Chessboard, CircleGrid, Marker

# Upright, in mm.
PAGES = {"a4": (210.0, 297.0), "a3": (297.0, 420.0), "letter": (215.9, 279.4)}
_TEXT_HEIGHT = 16.0  # mm, at the foot of a page
_MM = 1000.0  # in a metre
# Prints lie in one plane and face the same way to within this.
_FLAT = 1e-6


def plan(marker_map: MarkerMap, page: str = "a4") -> list[Page]:
    """Lay a map out on pages.

    Markers in one plane that fit on a page together are on it as in the map; others get a place
    of their own, to be cut out. A board has a page to itself.

    Raises:
        PrintError: when something is larger than the page.
    """
    pages = [_board_page(board, page) for board in marker_map.boards]
    markers = marker_map.markers
    if markers:
        together = _together(markers, PAGES[page])
        pages += [together] if together is not None else _apart(markers, page)
    return pages


# -- layout -------------------------------------------------------------------------------------


def _room(size: tuple[float, float]) -> tuple[float, float]:
    return size[0] - 2 * MARGIN, size[1] - 2 * MARGIN - _TEXT_HEIGHT


def _paper(size: tuple[float, float], width: float, height: float) -> tuple[float, float] | None:
    """The page, upright or on its side, on which this fits."""
    for paper in (size, size[::-1]):
        room = _room(paper)
        if width <= room[0] + 1e-9 and height <= room[1] + 1e-9:
            return paper
    return None


def _needed(what: str, page: str, width: float, height: float) -> tuple[float, float]:
    """The same, or a PrintError."""
    paper = _paper(PAGES[page], width, height)
    if paper is None:
        room = _room(PAGES[page])
        raise PrintError(
            f"{what} takes {width:.0f} x {height:.0f} mm, but {page} has room for {room[0]:.0f} x "
            f"{room[1]:.0f} mm; choose a larger page or a smaller size"
        )
    return paper


def _board_page(board: Board, page: str) -> Page:
    figure = _board_figure(board)
    paper = _needed(board.name, page, figure.width, figure.height)
    note = f"{figure.label}; mount it on something flat"
    laid = _middle(paper, [(0.0, 0.0, figure)], figure.width, figure.height, note)
    return _with_axes(laid, board.pose)


def _together(markers: tuple[Marker, ...], size: tuple[float, float]) -> Page | None:
    """All markers as in the map, if they lie in one plane, upright, and fit on a page."""
    first = markers[0].pose
    figures = []
    for marker in markers:
        pose = marker.pose
        if np.abs(pose.rotation - first.rotation).max() > _FLAT:
            return None
        x, y, z = (pose.position - first.position) @ first.rotation * _MM
        if abs(z) > _FLAT * _MM:
            return None
        figure = _marker_figure(marker)
        figures.append((x - 0.5 * figure.width, y - 0.5 * figure.height, figure))
    left, bottom = min(x for x, _, _ in figures), min(y for _, y, _ in figures)
    width = max(x + figure.width for x, _, figure in figures) - left
    height = max(y + figure.height for _, y, figure in figures) - bottom
    paper = _paper(size, width, height)
    if paper is None:
        return None
    moved = [(x - left, y - bottom, figure) for x, y, figure in figures]
    note = "all markers are where the map has them" if len(markers) > 1 else ""
    return _with_axes(_middle(paper, moved, width, height, note), first)


def _with_axes(page: Page, pose: Pose) -> Page:
    """The page and how the map's frame lies on it, by the pose of its first print."""
    left, bottom, figure = page.figures[0]
    right, up, out = (_direction(pose.rotation[:, k]) for k in range(3))
    x, y, z = -pose.position @ pose.rotation * _MM
    origin = (left + 0.5 * figure.width + x, bottom + 0.5 * figure.height + y)
    where = f"the middle of the first print is at ({_place(pose)}) m"
    inside = 0 <= origin[0] <= page.width and 0 <= origin[1] <= page.height
    if abs(z) > _FLAT * _MM or not inside:
        axes = Axes(right, up, out, None, f"{where}; the origin is not on this page")
    elif np.hypot(x, y) < _FLAT * _MM:
        axes = Axes(right, up, out, origin, "the origin is in the middle of the print")
    else:
        axes = Axes(right, up, out, origin, where)
    return replace(page, axes=axes)


def _place(pose: Pose) -> str:
    return ", ".join(f"{value:g}" for value in np.round(pose.position, 4) + 0.0)


def _direction(vector: Array) -> str:
    """An axis of the map, or a direction between them."""
    axis = int(np.argmax(np.abs(vector)))
    if abs(vector[axis]) < 1.0 - _FLAT:
        return "(" + " ".join(f"{value:.2g}" for value in vector) + ")"
    return f"{'+' if vector[axis] > 0 else '-'}{'xyz'[axis]}"


def _apart(markers: tuple[Marker, ...], page: str) -> list[Page]:
    """As many markers to a page as fit, to be cut out and put where the map has them."""
    figures = [_marker_figure(marker, placed=True) for marker in markers]
    width = max(figure.width for figure in figures)
    height = max(figure.height for figure in figures)
    _needed(markers[0].name, page, width, height)
    papers = PAGES[page], PAGES[page][::-1]
    columns, rows, paper = max(
        ((int(_room(w)[0] // width), int(_room(w)[1] // height), w) for w in papers),
        key=lambda item: item[0] * item[1],
    )
    pages = []
    for start in range(0, len(figures), columns * rows):
        placed = []
        for k, figure in enumerate(figures[start : start + columns * rows]):
            column, row = k % columns, k // columns
            placed.append((column * width, (rows - 1 - row) * height, figure))
        note = "cut along the lines and put each marker where the map has it"
        pages.append(_middle(paper, placed, columns * width, rows * height, note))
    return pages


def _middle(
    paper: tuple[float, float],
    figures: list[tuple[float, float, Figure]],
    width: float,
    height: float,
    note: str,
) -> Page:
    room = _room(paper)
    x = MARGIN + 0.5 * (room[0] - width)
    y = MARGIN + _TEXT_HEIGHT + 0.5 * (room[1] - height)
    return Page(*paper, tuple((x + a, y + b, figure) for a, b, figure in figures), note)


# -- figures ------------------------------------------------------------------------------------


def _marker_figure(marker: Marker, placed: bool = False) -> Figure:
    cell = marker.size * _MM / marker.family.cells
    black = _rectangles(pattern(marker.family, marker.id), cell) + np.array([cell, cell, 0.0, 0.0])
    side = cell * (marker.family.cells + 2)
    label = f"{marker.family.name}  id {marker.id}  {marker.size * _MM:g} mm"
    if placed:
        label += f"  middle at ({_place(marker.pose)}) m"
    return Figure(black, side, side, cell, label)


def _board_figure(board: Board) -> Figure:
    if isinstance(board, CircleGrid):
        raise PrintError(f"a {board.name} can be detected, but not printed from here")
    square = board.square * _MM
    if isinstance(board, Chessboard):
        columns, rows = board.columns + 1, board.rows + 1
        label = f"{board.name} inner corners  squares {square:g} mm"
    else:
        columns, rows = board.columns, board.rows
        label = f"{board.name}  squares {square:g} mm  markers {board.marker * _MM:g} mm"
    whites = _white_cells(board, columns, rows)
    white = np.zeros((rows, columns), bool)
    for column, row in whites:
        white[row, column] = True
    black = [_rectangles(white, square)]
    if isinstance(board, Charuco):
        side = board.marker * _MM
        rim, cell = 0.5 * (square - side), side / board.family.cells
        for index, (column, row) in enumerate(whites):
            inside = _rectangles(pattern(board.family, board.first_id + index), cell)
            x, y = column * square + rim, (rows - 1 - row) * square + rim
            black.append(inside + np.array([x, y, 0.0, 0.0]))
    return Figure(np.concatenate(black), columns * square, rows * square, 0.0, label)


def _white_cells(board: Chessboard | Charuco, columns: int, rows: int) -> list[tuple[int, int]]:
    if isinstance(board, Charuco):
        return board.cells
    first = 0 if board.inverted else 1
    return [(c, r) for r in range(rows) for c in range(columns) if (c + r) % 2 == first]


def _rectangles(white: NDArray[np.bool_], cell: float) -> Array:
    """The black cells as rectangles (n,4), as few as runs along the rows make them."""
    rows = len(white)
    rectangles = []
    for row in range(rows):
        edges = np.flatnonzero(np.diff(np.concatenate([[True], white[row], [True]]).astype(int)))
        for start, end in edges.reshape(-1, 2).tolist():
            rectangles.append([start * cell, (rows - 1 - row) * cell, (end - start) * cell, cell])
    return np.array(rectangles, np.float64).reshape(-1, 4)


MARGIN = 10.0
"""mm: printers leave about 5 white."""
_BAR = 100.0  # mm, to be measured
_INCH = 25.4  # mm
_FONT = 7.0  # pt
_ARROW, _CLEAR = 5.0, 3.0  # mm, of the axes at the origin, and around them
_PNG_DPI = 300


class PrintError(ValueError):
    """Something that cannot be printed; the message says why."""


@dataclass(frozen=True, slots=True, eq=False)
class Figure:
    """Something on a page: black rectangles, and what it needs around them."""

    black: Array  # (n,4) mm: left, bottom, width, height, from its lower left corner
    width: float  # mm, with the white rim
    height: float
    rim: float  # mm, white, inside the width and height
    label: str


@dataclass(frozen=True, slots=True)
class Axes:
    """How the frame of the map lies on a page."""

    right: str  # the axis that points to the right, as "+x"
    up: str
    out: str  # toward the viewer
    origin: tuple[float, float] | None  # mm; None: on another page
    where: str  # the origin in words


@dataclass(frozen=True, slots=True, eq=False)
class Page:
    """Figures by their lower left corners in mm."""

    width: float
    height: float
    figures: tuple[tuple[float, float, Figure], ...]
    note: str
    axes: Axes | None = None  # None: each figure goes to a place of its own


def write_pages(pages: Sequence[Page], path: Path) -> list[Path]:
    """Write a PDF, or a PNG for each page (by the path's ending); the files.

    Raises:
        PrintError: for another ending.
        OSError: when a file cannot be written.
    """
    count = len(pages)
    figures = [_draw(page, f"page {k + 1} of {count}") for k, page in enumerate(pages)]
    if path.suffix == ".pdf":
        from matplotlib.backends.backend_pdf import PdfPages

        with PdfPages(path) as file:
            for figure in figures:
                file.savefig(figure)
        return [path]
    if path.suffix != ".png":
        raise PrintError(f"{path} must end in .pdf or .png")
    names = page_files(path, count)
    for figure, name in zip(figures, names, strict=True):
        figure.savefig(name, dpi=_PNG_DPI)
    return names


def page_files(path: Path, count: int) -> list[Path]:
    """Where so many pages are written to: one PDF, or a PNG for each."""
    if count == 1 or path.suffix == ".pdf":
        return [path]
    return [path.with_stem(f"{path.stem}_{k + 1}") for k in range(count)]


def _draw(page: Page, number: str) -> Any:
    from matplotlib.figure import Figure
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    figure = Figure(figsize=(page.width / _INCH, page.height / _INCH))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set(xlim=(0.0, page.width), ylim=(0.0, page.height))
    axes.set_axis_off()
    vertices, codes = [], []
    for x, y, item in page.figures:
        for left, bottom, width, height in item.black + np.array([x, y, 0.0, 0.0]):
            right, top = left + width, bottom + height
            corners = [(left, bottom), (right, bottom), (right, top), (left, top), (left, bottom)]
            vertices += corners
            codes += [Outline.MOVETO, *[Outline.LINETO] * 3, Outline.CLOSEPOLY]
        if item.rim > 0.0:
            _add_rim(axes, x, y, item)
    # One path: between several, a viewer would show hairlines. Snapped to pixels, sizes are wrong.
    axes.add_patch(
        PathPatch(Outline(vertices, codes), facecolor="black", edgecolor="none", snap=False)
    )
    if page.axes is not None:
        _frame(axes, page, page.axes)
    _foot(axes, page, number)
    return figure


def _add_rim(axes: Any, x: float, y: float, item: Figure) -> None:
    """Where to cut, and which marker it is."""
    from matplotlib.patches import Rectangle

    axes.add_patch(
        Rectangle((x, y), item.width, item.height, fill=False, edgecolor="0.8", linewidth=0.25)
    )
    # At the edge of the white rim, where it is far from the marker.
    small = {"fontsize": 0.5 * _FONT, "color": "0.5"}
    axes.text(x + 1.0, y + 0.8, item.label, va="bottom", **small)
    right, top = x + item.width - 1.0, y + item.height - 0.8
    axes.text(right, top, "top", ha="right", va="top", **small)


def _frame(axes: Any, page: Page, frame: Axes) -> None:
    """Axes of the map in words, and at its origin, where they cover nothing that is black."""
    text = f"map: {frame.right} to the right, {frame.up} up, {frame.out} out of the paper; "
    free = frame.origin is not None and not any(
        _covers(frame.origin, x, y, item) for x, y, item in page.figures
    )
    arrows = ", the origin where the arrows start" if free else ""
    axes.text(MARGIN, MARGIN + 12.0, text + frame.where + arrows, fontsize=0.8 * _FONT)
    if frame.origin is None or not free:
        return
    x, y = frame.origin
    for along, name in (((_ARROW, 0.0), frame.right), ((0.0, _ARROW), frame.up)):
        end = (x + along[0], y + along[1])
        style = {"arrowstyle": "->", "color": "0.4", "lw": 0.6, "shrinkA": 0.0, "shrinkB": 0.0}
        axes.annotate("", end, (x, y), arrowprops=style)
        axes.text(*end, name, fontsize=0.6 * _FONT, color="0.4", ha="left", va="bottom")


def _covers(origin: tuple[float, float], x: float, y: float, item: Figure) -> bool:
    """Whether what is black of a figure at x, y comes near to arrows that start at an origin."""
    from_figure = np.array(origin) - np.array([x, y])
    low = item.black[:, :2].min(axis=0) - _ARROW - _CLEAR
    high = (item.black[:, :2] + item.black[:, 2:]).max(axis=0) + _CLEAR
    return bool(np.all((low <= from_figure) & (from_figure <= high)))


def _foot(axes: Any, page: Page, number: str) -> None:
    y = MARGIN
    axes.plot([MARGIN, MARGIN + _BAR], [y, y], color="black", linewidth=0.5)
    for k in range(11):
        x = MARGIN + 0.1 * _BAR * k
        axes.plot([x, x], [y, y + (2.0 if k % 5 else 3.0)], color="black", linewidth=0.5)
    note = f"print at 100 % (actual size): this bar is {_BAR:.0f} mm long"
    axes.text(MARGIN, y + 4.0, note, fontsize=_FONT)
    right = "; ".join(text for text in (page.note, number) if text)
    # Above the bar, which it must not cover.
    axes.text(page.width - MARGIN, y + 8.0, right, fontsize=0.8 * _FONT, ha="right")
