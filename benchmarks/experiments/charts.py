# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Figures of the experiments: every method has its color, marker and line in all of them.

The colors differ in lightness, and the markers and lines by themselves, so that a print in black
and white can be read. P3P is orange and ours dark blue, as in the figures of ``evaluation.plots``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from benchmarks.experiments import methods as m
from benchmarks.experiments.errors import METRICS
from benchmarks.experiments.methods import Method
from benchmarks.experiments.sweeps import Curves
from rs_localizer.core.arrays import Array
from rs_localizer.tools.errors import BLUE, ORANGE

_DPI = 110
_LEGEND_MARGIN, _LEGEND_ROW = 0.1, 0.21  # inches


@dataclass(frozen=True, slots=True)
class Look:
    """How one line is drawn."""

    color: str
    marker: str
    line: str
    width: float = 1.4
    filled: bool = True


_LOOKS: Mapping[str, Look] = {
    m.P3P.name: Look(ORANGE, "x", "--"),
    m.R6P.name: Look("#000000", "o", "-", 1.0, filled=False),
    m.VC_WT.name: Look("#b8b8b8", "v", "-."),
    m.VCT_W.name: Look("#4fae5b", "^", ":", filled=False),
    m.VCT_WT.name: Look("#2a6b34", "s", ":", filled=False),
    m.VCWT.name: Look("#5aa0e0", "+", "-"),
    m.VCWT_ONCE.name: Look("#96c4ee", "<", "--", filled=False),
    m.R9P.name: Look("#a03070", "D", "--", filled=False),
    m.VCWT_OURS.name: Look("#2f6fc0", "P", "-", filled=False),
    m.R9P_OURS.name: Look("#701848", "D", "-"),
    m.JOINT.name: Look("#8a6d1d", "*", "-.", filled=False),
    m.REFINED.name: Look(BLUE, ".", "-", 2.2),
}
_MARKER_SIZE = {"x": 5.0, "+": 7.0, ".": 8.0, "*": 6.0, "o": 8.0, "^": 9.0}


def look(method: Method) -> Look:
    """The look of a method."""
    return _LOOKS[method.name]


def figure(width: float, height: float) -> Figure:
    """An empty figure; no display is needed."""
    return Figure(figsize=(width, height), dpi=_DPI, layout="constrained")


def line(axes: Axes, x: Array, y: Array, style: Look, label: str) -> None:
    """One curve; infinite values are left out."""
    axes.plot(
        x,
        np.where(np.isfinite(y), y, np.nan),
        color=style.color,
        marker=style.marker,
        linestyle=style.line,
        linewidth=style.width,
        markersize=_MARKER_SIZE.get(style.marker, 5.0),
        markerfacecolor=style.color if style.filled else "none",
        markeredgewidth=1.2,
        label=label,
    )


def tidy(axes: Axes, x_label: str, y_label: str) -> None:
    """Labels, a light grid, no box."""
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(visible=True, color="#e4e4e4", linewidth=0.6)
    axes.set_axisbelow(True)


def plain_logarithmic(axes: Axes) -> None:
    """A logarithmic y axis that reads 0.1, 0.2, 0.5, 1."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    steps = (1.0, 2.0, 5.0) if high / low < 2e3 else (1.0,)
    axes.yaxis.set_major_locator(LogLocator(10.0, steps, numticks=15))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: _positional(value)))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _positional(value: float) -> str:
    return np.format_float_positional(value, precision=6, trim="-")


def legend(figure: Figure, axes: Axes, columns: int = 4) -> None:
    """One legend for all panels, below them."""
    handles, labels = axes.get_legend_handles_labels()
    rows = -(-len(labels) // columns)
    # Matplotlib 3.6 knows no legend outside of the layout: the room for it is set aside here.
    bottom = (_LEGEND_MARGIN + _LEGEND_ROW * rows) / figure.get_size_inches()[1]
    figure.set_layout_engine("constrained", rect=(0.0, bottom, 1.0, 1.0 - bottom))
    figure.legend(handles, labels, loc="lower center", ncols=columns, frameon=False)


def error_figure(
    curves: Curves,
    methods: Sequence[Method],
    x_label: str,
    metrics: Sequence[int] = (0, 1, 2, 3),
    skip_zero: bool = True,
    decorate: Callable[[Axes, int], None] | None = None,
) -> Figure:
    """The medians of the errors, one panel per metric.

    P3P, which estimates no velocities, is left out of their panels. Where nothing moves and there
    is no noise, all errors are zero: ``skip_zero`` leaves such a first place out. ``decorate`` adds
    to the axes of a metric.
    """
    shown = [method for method in methods if curves.has(method)]
    if len(metrics) == 4:
        drawn = figure(9.6, 7.4)
        panels = drawn.subplots(2, 2, sharex=True).ravel()
    else:
        drawn = figure(4.8 * len(metrics), 4.4)
        panels = np.atleast_1d(drawn.subplots(1, len(metrics)))
    for axes, metric in zip(panels, metrics, strict=True):
        for method in shown:
            if method is m.P3P and metric >= 2:
                continue
            y = curves.median(method, metric)
            first = 1 if skip_zero and np.all(curves.medians(shown[0])[0] < 1e-6) else 0
            line(axes, curves.x[first:], y[first:], look(method), method.label)
        if decorate is not None:
            decorate(axes, metric)
        plain_logarithmic(axes)
        tidy(axes, x_label, METRICS[metric].label)
        if len(metrics) == 4 and metric < 2:
            axes.set_xlabel("")
    legend(drawn, panels[0])
    return drawn
