# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Figures of the experiments: every method has its color, marker and line in all of them.

The colors differ in lightness, and the markers and lines by themselves, so that a print in black
and white can be read.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from benchmarks.experiments import methods as m
from benchmarks.experiments.methods import Method
from benchmarks.experiments.sweeps import METRICS, POSITION, Curves
from rs_localizer.core.arrays import Array
from rs_localizer.tools.errors import BLUE, ORANGE

_LOOKS: Mapping[str, tuple[str, str, bool]] = {  # color, marker and line, whether it is filled
    m.P3P.name: (ORANGE, "x--", True),
    m.R6P.name: ("#000000", "o-", False),
    m.VC_WT.name: ("#b8b8b8", "v-.", True),
    m.VCT_W.name: ("#4fae5b", "^:", False),
    m.VCT_WT.name: ("#2a6b34", "s:", False),
    m.VCWT.name: ("#5aa0e0", "+-", True),
    m.R9P.name: ("#a03070", "D--", False),
    m.VCWT_OURS.name: ("#2f6fc0", "P-", False),
    m.R9P_OURS.name: ("#701848", "D-", True),
    m.JOINT.name: ("#8a6d1d", "*-.", False),
    m.REFINED.name: (BLUE, ".-", True),
}


def figure(width: float, height: float) -> Figure:
    """An empty figure; no display is needed."""
    return Figure(figsize=(width, height), dpi=110, layout="constrained")


def line(axes: Axes, x: Array, y: Array, method: Method, label: str = "") -> None:
    """The curve of a method; infinite values are left out."""
    color, style, filled = _LOOKS[method.name]
    axes.plot(
        x, np.where(np.isfinite(y), y, np.nan), style, color=color,
        linewidth=2.2 if method.refined else 1.4,
        markerfacecolor=color if filled else "none", label=label or method.label,
    )  # fmt: skip


def tidy(axes: Axes, x_label: str, y_label: str, logarithmic: bool = False) -> None:
    """Labels, a light grid, no box; a logarithmic y axis reads 0.1, 0.2, 0.5, 1."""
    axes.set_xlabel(x_label)
    axes.set_ylabel(y_label)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(visible=True, color="#e4e4e4", linewidth=0.6)
    if not logarithmic:
        return
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    steps = (1.0, 2.0, 5.0) if high / low < 2e3 else (1.0,)
    axes.yaxis.set_major_locator(LogLocator(10.0, steps, numticks=15))
    axes.yaxis.set_major_formatter(
        FuncFormatter(lambda value, _: np.format_float_positional(value, precision=6, trim="-"))
    )
    axes.yaxis.set_minor_formatter(NullFormatter())


def legend(drawn: Figure, axes: Axes) -> None:
    """One legend for all panels, below them."""
    handles, labels = axes.get_legend_handles_labels()
    # Matplotlib 3.6 knows no legend outside of the layout: the room for it is set aside here.
    bottom = (0.1 + 0.21 * -(-len(labels) // 4)) / drawn.get_size_inches()[1]
    drawn.set_layout_engine("constrained", rect=(0.0, bottom, 1.0, 1.0 - bottom))
    drawn.legend(handles, labels, loc="lower center", ncols=4, frameon=False)


def error_figure(
    curves: Curves,
    methods: Sequence[Method],
    x_label: str,
    metrics: Sequence[int] = (0, 1, 2, 3),
    skip_zero: bool = True,
    decorate: Callable[[Axes, int], Any] = lambda axes, metric: None,
) -> Figure:
    """The medians of the errors, one panel per metric.

    P3P, which estimates no velocities, is left out of their panels. Where nothing moves and there
    is no noise, all errors are zero: ``skip_zero`` leaves such a first place out. ``decorate`` adds
    to the axes of a metric.
    """
    rows = len(metrics) // 2
    drawn = figure(9.6, 3.0 + 2.2 * rows)
    panels = drawn.subplots(rows, 2, squeeze=False).ravel()
    first = 1 if skip_zero and np.all(curves.medians(methods[0])[0] < 1e-6) else 0
    labels = list(METRICS.values())
    for axes, metric in zip(panels, metrics, strict=True):
        for method in methods:
            if method is not m.P3P or metric <= POSITION:
                line(axes, curves.x[first:], curves.medians(method)[first:, metric], method)
        decorate(axes, metric)
        tidy(axes, x_label, labels[metric], logarithmic=True)
    legend(drawn, panels[0])
    return drawn
