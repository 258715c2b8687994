# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of a map that was built: landmarks and cameras, residuals before and after."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from rs_localizer.core.arrays import Array
from rs_localizer.tools.evaluation.plots import BLUE, ORANGE
from rs_localizer.tools.mapping.build import Built

_DPI = 110
_BINS = 40
# What is farther off than nearly all (percent) would shrink the picture.
_RARE = 1.0
# Inches above and below the axes: titles need them where the axes keep their shape.
_RIM = 0.15
# Of the camera's gaze, in the picture (share of its width).
_GAZE = 0.03


def save_pictures(built: Built, directory: Path) -> None:
    """Write ``map.png`` and ``residuals.png`` into a directory."""
    figure = Figure(figsize=(11.0, 5.5), dpi=_DPI, layout=ConstrainedLayoutEngine(h_pad=_RIM))
    left, right = figure.subplots(1, 2)
    for axes, pair, title in ((left, (0, 1), "from above"), (right, (0, 2), "from the side")):
        _scene(axes, built, pair, title)
    figure.savefig(directory / "map.png")
    figure = Figure(figsize=(7.0, 4.0), dpi=_DPI, layout="constrained")
    _residuals(figure.subplots(), built)
    figure.savefig(directory / "residuals.png")


def _scene(axes: Axes, built: Built, pair: tuple[int, int], title: str) -> None:
    a, b = pair
    points, cameras = built.landmarks.points, built.positions
    axes.scatter(
        points[:, a], points[:, b], s=1.0, color="#8a8a8a", linewidths=0, label="landmarks"
    )
    axes.plot(cameras[:, a], cameras[:, b], ".", markersize=3, color=BLUE, label="camera")
    low, high = np.percentile(np.vstack([points, cameras]), [_RARE, 100.0 - _RARE], axis=0)
    size = float(np.max(high - low))
    every = slice(None, None, max(1, len(cameras) // 40))
    gaze = _GAZE * size * built.rotations[every, :, 2]
    axes.quiver(
        cameras[every, a], cameras[every, b], gaze[:, a], gaze[:, b], angles="xy",
        scale_units="xy", scale=1.0, color=ORANGE, width=0.003, label="its gaze",
    )  # fmt: skip
    unit = "m" if built.placement.scaled else "units of the map"
    middle = 0.5 * (low + high)
    axes.set(
        xlabel=f"{'xyz'[a]} ({unit})", ylabel=f"{'xyz'[b]} ({unit})", title=title, aspect="equal",
        xlim=(middle[a] - 0.55 * size, middle[a] + 0.55 * size),
        ylim=(middle[b] - 0.55 * size, middle[b] + 0.55 * size),
    )  # fmt: skip
    axes.legend(frameon=False, loc="upper right", markerscale=3.0)


def _residuals(axes: Axes, built: Built) -> None:
    before = _global_errors(built)
    after = np.sqrt(built.refined.squared_errors[np.isfinite(built.refined.squared_errors)])
    most = float(np.percentile(before, 98.0))
    edges = np.linspace(0.0, most, _BINS)
    for values, color, name in (
        (before, ORANGE, "before: one pose per image (COLMAP)"),
        (after, BLUE, "after: a pose for every row"),
    ):
        shares = np.full(len(values), 100.0 / len(values))
        label = f"{name}, median {np.median(values):.2f} px"
        axes.hist(values, edges.tolist(), weights=shares, color=color, alpha=0.65, label=label)
    axes.set(xlabel="residual of a keypoint (px)", ylabel="keypoints (%)")
    axes.legend(frameon=False)


def _global_errors(built: Built) -> Array:
    """Reprojection errors (n,) px of the structure that COLMAP found."""
    structure = built.structure
    at = np.searchsorted(structure.views, structure.seen_views)
    offset = structure.points[structure.seen_points] - structure.positions[at]
    local = np.einsum("nji,nj->ni", structure.rotations[at], offset)
    errors: Array = np.linalg.norm(structure.camera.project(local) - structure.pixels, axis=1)
    return errors[np.isfinite(errors)]
