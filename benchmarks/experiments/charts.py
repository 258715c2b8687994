# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The figure of docs/solvers.md: every method has its color, marker and line.

The colors differ in lightness, and the markers and lines by themselves, so that a print in black
and white can be read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from benchmarks.experiments import methods as m
from benchmarks.experiments.methods import Method
from benchmarks.experiments.sweeps import POSE, Curves
from rs_localizer.tools.errors import BLUE, ORANGE

_LOOKS: Mapping[str, tuple[str, str, bool]] = {  # color, marker and line, whether it is filled
    m.P3P.name: (ORANGE, "x--", True),
    m.R6P.name: ("#000000", "o-", False),
    m.VCT_W.name: ("#4fae5b", "^:", False),
    m.VCWT_OURS.name: ("#2f6fc0", "P-", False),
    m.R9P_OURS.name: ("#701848", "D-", True),
    m.JOINT.name: ("#8a6d1d", "*-.", False),
    m.REFINED.name: (BLUE, ".-", True),
}
_LABELS = ("orientation error (deg)", "position error / distance")


def error_figure(curves: Curves, methods: Sequence[Method], x_label: str) -> Figure:
    """The medians of the pose errors, one panel per metric; no display is needed."""
    drawn = Figure(figsize=(9.6, 5.2), dpi=110, layout="constrained")
    panels = drawn.subplots(1, 2, squeeze=False).ravel()
    for axes, metric, label in zip(panels, POSE, _LABELS, strict=True):
        for method in methods:
            color, style, filled = _LOOKS[method.name]
            y = curves.medians(method)[:, metric]
            axes.plot(
                curves.x, np.where(np.isfinite(y), y, np.nan), style, color=color,
                linewidth=2.2 if method.refined else 1.4,
                markerfacecolor=color if filled else "none", label=method.label,
            )  # fmt: skip
        axes.set_xlabel(x_label)
        axes.set_ylabel(label)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(visible=True, color="#e4e4e4", linewidth=0.6)
        axes.set_yscale("log")
        low, high = axes.get_ylim()
        steps = (1.0, 2.0, 5.0) if high / low < 2e3 else (1.0,)
        axes.yaxis.set_major_locator(LogLocator(10.0, steps, numticks=15))
        axes.yaxis.set_major_formatter(
            FuncFormatter(lambda value, _: np.format_float_positional(value, precision=6, trim="-"))
        )
        axes.yaxis.set_minor_formatter(NullFormatter())
    handles, named = panels[0].get_legend_handles_labels()
    # Matplotlib 3.6 knows no legend outside of the layout: the room for it is set aside here.
    bottom = (0.1 + 0.21 * -(-len(named) // 4)) / drawn.get_size_inches()[1]
    drawn.set_layout_engine("constrained", rect=(0.0, bottom, 1.0, 1.0 - bottom))
    drawn.legend(handles, named, loc="lower center", ncols=4, frameon=False)
    return drawn
