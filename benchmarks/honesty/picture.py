"""A picture of the coverage: how many truths lie inside their 95 % regions, by condition."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.experiments import charts
from benchmarks.experiments.charts import Look
from benchmarks.experiments.results import Table
from benchmarks.honesty.coverage import MOTIONS, NOISES, SCENES, Condition

_BAND = (92.0, 98.0)
# Dark blue and orange differ to everyone, and the markers to those who print in black and white.
_NOW = {
    "rich": Look("#0b3c8c", "o", "-", 1.6),
    "wall": Look("#2f6fc0", "s", "-", 1.6),
    "small-plane": Look("#5aa0e0", "^", "-", 1.6),
}
_BEFORE = {
    "rich": Look("#b85c00", "o", ":", 1.1, filled=False),
    "wall": Look("#d97a1a", "s", ":", 1.1, filled=False),
    "small-plane": Look("#f0a860", "^", ":", 1.1, filled=False),
}
_TITLES = {
    "rest": "at rest",
    "hand": "a hand, 67 deg/s",
    "drone": "drone, 0.1 deg at 20 Hz",
    "stop": "sudden stop",
}

Shares = Mapping[str, float]
"""In %, by the name of the condition."""


def picture(now: Mapping[str, Shares], before: Mapping[str, Shares] | None = None) -> Figure:
    """One column per motion, one row per part (``pose``, ``twist``), over the noise.

    Single frames, at the stamp. ``before``: those of another version, drawn hollow.
    """
    drawn = charts.figure(11.0, 5.6)
    panels = drawn.subplots(len(now), len(MOTIONS), sharex=True, sharey=True, squeeze=False)
    for row, part in zip(panels, now, strict=True):
        for axes, motion in zip(row, MOTIONS, strict=True):
            axes.axhspan(*_BAND, color="#d8e4d0", zorder=0)
            if before is not None:
                _curves(axes, motion, before[part], _BEFORE, " before")
            _curves(axes, motion, now[part], _NOW, "")
            axes.set_xscale("log")
            axes.set_xticks(NOISES, [f"{noise:g}" for noise in NOISES])
            axes.minorticks_off()
            axes.set_ylim(0.0, 103.0)
            if part == next(iter(now)):
                axes.set_title(_TITLES[motion], fontsize=10)
            charts.tidy(
                axes,
                "noise (px)" if part == list(now)[-1] else "",
                f"{part}s inside (%)" if motion == next(iter(MOTIONS)) else "",
            )
    drawn.suptitle(
        "Truths inside their 95 % regions (band: 92 to 98 %), single frames, at the stamp",
        fontsize=11,
    )
    charts.legend(drawn, panels[0, 0], columns=6)
    return drawn


def shares_at_stamp(table: Table, part: str) -> Shares:
    """A column of the table of coverage: ``pose`` or ``twist``."""
    column = table.columns.index(f"{part}@stamp")
    return {str(row[0]): float(row[column]) for row in table.rows}


def _curves(
    axes: Axes, motion: str, shares: Shares, looks: Mapping[str, Look], suffix: str
) -> None:
    for scene in SCENES:
        names = [Condition(motion, scene, noise, False).name for noise in NOISES]
        values: Sequence[float] = [shares.get(name, np.inf) for name in names]
        label = f"{scene.replace('-', ' ')}{suffix}"
        charts.line(axes, np.array(NOISES), np.array(values), looks[scene], label)
