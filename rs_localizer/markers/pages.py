# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pages of black rectangles, written as PDF or PNG, true to scale."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array

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
    told = f"map: {frame.right} to the right, {frame.up} up, {frame.out} out of the paper; "
    free = frame.origin is not None and not any(
        _covers(frame.origin, x, y, item) for x, y, item in page.figures
    )
    arrows = ", the origin where the arrows start" if free else ""
    axes.text(MARGIN, MARGIN + 12.0, told + frame.where + arrows, fontsize=0.8 * _FONT)
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
    told = f"print at 100 % (actual size): this bar is {_BAR:.0f} mm long"
    axes.text(MARGIN, y + 4.0, told, fontsize=_FONT)
    right = "; ".join(text for text in (page.note, number) if text)
    # Above the bar, which it must not cover.
    axes.text(page.width - MARGIN, y + 8.0, right, fontsize=0.8 * _FONT, ha="right")
