"""How all pictures of methods look: colours, markers, lines, axes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from rs_localizer.core.arrays import Array
from rs_localizer.evaluation.metrics import Stamps
from rs_localizer.evaluation.palette import BLUE, ORANGE


@dataclass(frozen=True, slots=True)
class Style:
    color: str
    marker: str
    line: str
    layer: int


# Orange below, dark blue above; the truth is a wide grey road under both.
STYLES = (Style(BLUE, ".", "-", 3), Style(ORANGE, "x", "--", 2))
_DPI = 130
_WIDTH, TITLES = 10.0, 1.1  # inches
# A pause of more frames than this breaks the lines.
_LONGEST_GAP = 4.0


def save(figure: Figure, path: Path) -> None:
    """Write a PNG file; no display is needed."""
    figure.savefig(path)


def new_figure(title: str, height: float) -> Figure:
    figure = Figure(figsize=(_WIDTH, height), dpi=_DPI, layout="constrained")
    figure.suptitle(title)
    return figure


def methods(named: Mapping[str, object]) -> list[tuple[str, Style]]:
    """Names and styles; the first named is the one that matters."""
    return list(zip(named, STYLES, strict=False))


def tidy(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(visible=True, color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)


def legend(axes: Axes, columns: int) -> None:
    """Above the axes, where it covers nothing."""
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, frameon=False, borderaxespad=0.1
    )


def plain_numbers(axes: Axes) -> None:
    """0.1, 0.2, 0.5, 1 instead of powers of ten, on a logarithmic axis."""
    axes.yaxis.set_major_locator(LogLocator(10.0, (1.0, 2.0, 5.0), numticks=12))
    axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def seconds(stamps_ns: Stamps, start: int) -> Array:
    return np.asarray((stamps_ns - start) * 1e-9, np.float64)


def broken(stamps_ns: Stamps, x: Array, y: Array) -> tuple[Array, Array]:
    """The curve with a NaN in each long pause, so that no line bridges it."""
    spacing = np.diff(stamps_ns)
    if len(spacing) == 0:
        return x, y
    gaps = np.flatnonzero(spacing > _LONGEST_GAP * np.median(spacing)) + 1
    return np.insert(x, gaps, np.nan), np.insert(y, gaps, np.nan)
