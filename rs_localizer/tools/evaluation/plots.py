# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pictures: trajectories, errors over time, inliers, residuals on an image.

Every method keeps its color, its marker and its line in all of them, and they differ in lightness
too, so that a print in black and white can be read.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter
from scipy.ndimage import median_filter

from rs_localizer.core.arrays import Array
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.io.trajectories import Trajectory
from rs_localizer.io.video import Image
from rs_localizer.tools.evaluation.comparison import (
    Recording,
    Result,
    counts_at,
    predicted_pixels,
    true_rates,
)
from rs_localizer.tools.evaluation.metrics import Errors, Stamps

BLUE = "#0b3c8c"
ORANGE = "#b8540a"


@dataclass(frozen=True, slots=True)
class _Style:
    color: str
    marker: str
    line: str
    layer: int


# Orange below, dark blue above; the truth is a wide grey road under both.
_STYLES = (_Style(BLUE, ".", "-", 3), _Style(ORANGE, "x", "--", 2))
_DPI = 130
_WIDTH, _TITLES = 10.0, 1.1  # inches
# A pause of more frames than this breaks the lines.
_LONGEST_GAP = 4.0


def save(figure: Figure, path: Path) -> None:
    """Write a PNG file; no display is needed."""
    figure.savefig(path)


def _new_figure(title: str, height: float) -> Figure:
    figure = Figure(figsize=(_WIDTH, height), dpi=_DPI, layout="constrained")
    figure.suptitle(title)
    return figure


def _methods(named: Mapping[str, object]) -> list[tuple[str, _Style]]:
    """Names and styles; the first named is the one that matters."""
    return list(zip(named, _STYLES, strict=False))


def _tidy(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(visible=True, color="#e6e6e6", linewidth=0.6)
    axes.set_axisbelow(True)


def _legend(axes: Axes, columns: int) -> None:
    """Above the axes, where it covers nothing."""
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=columns, frameon=False, borderaxespad=0.1
    )


def _plain_numbers(axes: Axes) -> None:
    """0.1, 0.2, 0.5, 1 instead of powers of ten, on a logarithmic axis."""
    axes.yaxis.set_major_locator(LogLocator(10.0, (1.0, 2.0, 5.0), numticks=12))
    axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def _seconds(stamps_ns: Stamps, start: int) -> Array:
    return np.asarray((stamps_ns - start) * 1e-9, np.float64)


def _broken(stamps_ns: Stamps, x: Array, y: Array) -> tuple[Array, Array]:
    """The curve with a NaN in each long pause, so that no line bridges it."""
    spacing = np.diff(stamps_ns)
    if len(spacing) == 0:
        return x, y
    gaps = np.flatnonzero(spacing > _LONGEST_GAP * np.median(spacing)) + 1
    return np.insert(x, gaps, np.nan), np.insert(y, gaps, np.nan)


_TRUTH = "#c9c9c9"
# Frames of the running median that is drawn through the single errors.
_WINDOW = 15
# Zero has no logarithm.
_LEAST = 1e-9
# Axes end beyond all but so many percent of the values at each end, by this share of what lies
# between; of a few values, all are shown.
_RARE, _ROOM, _ROOM_OF_DIGITS, _FEW = 1.0, 0.5, 0.15, 20
# What is shown of an image around the points, and the longest arrow (px).
_RIM = 80.0


def trajectories(truth: Trajectory | None, estimates: Mapping[str, Trajectory]) -> Figure:
    """Where the camera was, from above and from the side."""
    figure = _new_figure("Position of the camera in each frame", 5.5)
    left, right = figure.subplots(1, 2)
    for axes, (a, b), title in ((left, (0, 1), "from above"), (right, (0, 2), "from the side")):
        if truth is not None:
            _draw_way(axes, truth, a, b)
        for (name, style), estimate in zip(_methods(estimates), estimates.values(), strict=True):
            axes.plot(
                estimate.positions[:, a],
                estimate.positions[:, b],
                linestyle="none",
                marker=style.marker,
                markersize=3.0 if style.marker == "." else 4.0,
                markeredgewidth=0.8,
                color=style.color,
                zorder=style.layer,
                label=name,
            )
        everything = [truth, *estimates.values()] if truth is not None else [*estimates.values()]
        ranges = [_range([one.positions[:, k] for one in everything], _ROOM) for k in (a, b)]
        half = 0.5 * max(high - low for low, high in ranges)
        for limit, (low, high) in zip((axes.set_xlim, axes.set_ylim), ranges, strict=True):
            limit(0.5 * (low + high) - half, 0.5 * (low + high) + half)
        axes.set_aspect("equal")
        axes.set_xlabel("x (m)")
        axes.set_ylabel(f"{'xyz'[b]} (m)")
        axes.text(0.03, 0.96, title, transform=axes.transAxes, va="top", style="italic")
        _tidy(axes)
    _legend(left, 3)
    return figure


def _range(parts: Sequence[Array], room: float) -> tuple[float, float]:
    """What nearly all values of all series are within, with some room beyond (as a share)."""
    values = np.concatenate([np.asarray(part, np.float64) for part in parts])
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return -1.0, 1.0
    low, high = float(values.min()), float(values.max())
    if len(values) >= _FEW:
        rare = np.percentile(values, [_RARE, 100.0 - _RARE])
        more = room * (rare[1] - rare[0])
        low, high = max(low, float(rare[0] - more)), min(high, float(rare[1] + more))
    rim = 0.05 * (high - low) or 0.1
    return low - rim, high + rim


def _draw_way(axes: Axes, truth: Trajectory, a: int, b: int) -> None:
    x, y = _broken(truth.stamps_ns, truth.positions[:, a], truth.positions[:, b])
    axes.plot(x, y, color=_TRUTH, linewidth=5.0, solid_capstyle="round", zorder=1, label="truth")


def errors(poses: Mapping[str, Errors], twists: Mapping[str, Errors]) -> Figure:
    """Errors over time on logarithmic scales, with their medians; twists where there are any."""
    panels: list[tuple[str, str, Mapping[str, Errors], Callable[[Errors], Array]]] = [
        ("position error", "mm", poses, lambda e: np.multiply(1e3, e.linear)),
        ("orientation error", "deg", poses, lambda e: e.angular),
    ]
    if twists:
        panels += [
            ("angular velocity\nerror", "deg/s", twists, lambda e: e.angular),
            ("linear velocity\nerror", "m/s", twists, lambda e: e.linear),
        ]
    figure = _new_figure(
        f"Error of each frame, and the running median of {_WINDOW}", 1.3 + 2.1 * len(panels)
    )
    start = min(int(e.stamps_ns[0]) for e in poses.values() if len(e.stamps_ns))
    rows = figure.subplots(len(panels), 1, sharex=True, subplot_kw={"yscale": "log"})
    for axes, (label, unit, series, values) in zip(rows, panels, strict=True):
        for name, style in _methods(poses):
            if name in series:
                one = series[name]
                shown = np.maximum(values(one), _LEAST)
                _draw_series(axes, _Series(name, style, one.stamps_ns, shown), start, unit)
        digits = [np.log10(np.maximum(values(one), _LEAST)) for one in series.values()]
        low, high = _range(digits, _ROOM_OF_DIGITS)
        # The worst frame is what one looks for.
        high = max([high, *(float(each.max()) + 0.1 for each in digits if len(each))])
        axes.set_ylim(10.0**low, 10.0**high)
        _plain_numbers(axes)
        axes.set_ylabel(f"{label} ({unit})")
        _tidy(axes)
        _legend(axes, 2)
    rows[-1].set_xlabel("time (s)")
    return figure


class _Series(NamedTuple):
    """Values of a method over time."""

    name: str
    style: _Style
    stamps_ns: Stamps
    values: Array


def _draw_series(
    axes: Axes, series: _Series, start: int, unit: str, counted: Array | None = None
) -> None:
    """Single values as pale marks, their running median as a line.

    The legend has the median of all values, or of those that are ``counted``.
    """
    name, style, stamps_ns, values = series
    t = _seconds(stamps_ns, start)
    axes.plot(
        t, values, linestyle="none", marker=style.marker, markersize=3.0, markeredgewidth=0.6,
        color=style.color, alpha=0.35, zorder=style.layer,
    )  # fmt: skip
    running = median_filter(values, _WINDOW, mode="mirror") if len(values) >= _WINDOW else values
    x, y = _broken(stamps_ns, t, running)
    counted = values if counted is None else counted
    label = f"{name}: median {np.median(counted):.3g} {unit}".rstrip() if len(counted) else name
    if unit and len(counted):
        label += f", largest {counted.max():.3g}"
    axes.plot(x, y, style.line, color=style.color, linewidth=2.0, zorder=style.layer, label=label)


def inlier_picture(
    recording: Recording, results: Mapping[str, Result], true_matches: Array
) -> Figure:
    """Inliers of each frame, ``true_matches`` (n,) of which there are, and the angular rate.

    Medians are of the localized frames.
    """
    stamps_ns = np.array(recording.stamps_ns)
    counts = {name: counts_at(result, recording.stamps_ns) for name, result in results.items()}
    figure = _new_figure("Matches that fit the pose of their frame", 5.7)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(2.0, 1.0))
    t = _seconds(stamps_ns, int(stamps_ns[0]))
    upper.fill_between(t, true_matches, step="mid", color="#ececec", zorder=0, label="true matches")
    for (name, style), values in zip(_methods(counts), counts.values(), strict=True):
        # As in the table: what a refused frame would have had, nobody knows.
        localized = values[values > 0.0]
        series = _Series(name, style, stamps_ns, values)
        _draw_series(upper, series, int(stamps_ns[0]), "", localized)
    upper.set_ylim(bottom=0.0)
    upper.set_ylabel("inliers (0: frame refused)")
    _legend(upper, 3)
    lower.fill_between(t, true_rates(recording), color="#8a8a8a", linewidth=0.0)
    lower.set_ylim(bottom=0.0)
    lower.set_ylabel("the camera turns\nat (deg/s)")
    lower.set_xlabel("time (s)")
    for axes in (upper, lower):
        _tidy(axes)
    return figure


def _residuals(image: Image, pixels: Array, predicted: Mapping[str, Array]) -> Figure:
    """Residuals as arrows on the image they belong to, one picture per method.

    All arrows are enlarged alike, as far as all stay inside.

    Args:
        image: (height, width) grey.
        pixels: (n,2) where the corners were seen.
        predicted: (n,2) where each method's pose puts them.
    """
    longest = max(
        float(np.linalg.norm(pixels - projections, axis=1).max())
        for projections in predicted.values()
    )
    magnification = _round_down(_RIM / longest) if longest > 0.0 else 1.0
    tips = np.vstack(
        [projections + magnification * (pixels - projections) for projections in predicted.values()]
    )
    # Beyond the image only as far as arrows reach.
    corner = np.array(image.shape[::-1]) - 0.5
    low = np.minimum(np.maximum(pixels.min(axis=0) - _RIM, -0.5), tips.min(axis=0))
    high = np.maximum(np.minimum(pixels.max(axis=0) + _RIM, corner), tips.max(axis=0))
    wide, tall = np.maximum(high - low, 1.0)
    # As high as the pictures are, side by side, with their titles: no band stays blank.
    height = float(np.clip(_WIDTH / len(predicted) * tall / wide, 1.0, _WIDTH)) + _TITLES
    title = (
        "The frame where they differ most: from where the pose puts points to where they are seen"
    )
    figure = _new_figure(title, height)
    panels = figure.subplots(1, len(predicted), squeeze=False)[0]
    for axes, (name, style), projections in zip(
        panels, _methods(predicted), predicted.values(), strict=True
    ):
        offset = pixels - projections
        rms = float(np.sqrt(np.mean(np.sum(offset**2, axis=1))))
        axes.imshow(0.55 * image + 0.45 * 255, cmap="gray", vmin=0, vmax=255)
        axes.quiver(
            projections[:, 0], projections[:, 1], offset[:, 0], offset[:, 1], angles="xy",
            scale_units="xy", scale=1.0 / magnification, color=style.color, width=0.005,
        )  # fmt: skip
        axes.set_title(f"{name}: residual {rms:.3f} px rms")
        axes.set_xlabel(f"arrows {magnification:g} times enlarged")
        axes.set_xticks([])
        axes.set_yticks([])
        axes.set_xlim(low[0], high[0])
        axes.set_ylim(high[1], low[1])
    return figure


def _round_down(value: float) -> float:
    """The next lower one of ... 0.5, 1, 2, 5, 10 ..."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * max(digit for digit in (1.0, 2.0, 5.0) if digit * power <= value))


def trajectory_picture(recording: Recording, results: Mapping[str, Result]) -> Figure:
    """Positions of all methods over the truth."""
    truth = None
    if recording.truth is not None:
        poses = recording.truth.poses
        first, last = recording.stamps_ns[0], recording.stamps_ns[-1]
        truth = poses.part((poses.stamps_ns >= first) & (poses.stamps_ns <= last))
    return trajectories(truth, {name: result.poses for name, result in results.items()})


def error_picture(results: Mapping[str, Result]) -> Figure:
    """Errors over time; the recording has to hold the truth."""
    return errors({name: r.errors for name, r in results.items() if r.errors is not None}, {})


def residual_picture(
    recording: Recording, results: Mapping[str, Result], readout_time: float
) -> Figure | None:
    """Residuals of the frame in which the methods differ most, on its image.

    Returns:
        None when no frame with an image was localized by all methods.
    """
    best: tuple[float, Figure] | None = None
    for stamp, info, cloud in zip(
        recording.stamps_ns, recording.camera_infos, recording.clouds, strict=True
    ):
        if stamp not in recording.images or any(stamp not in r.answers for r in results.values()):
            continue
        camera = read_camera_info(info).camera(readout_time, ScanDirection.TOP_TO_BOTTOM)
        correspondences = read_correspondences(cloud)
        predicted = {
            name: predicted_pixels(camera, result.answers[stamp], correspondences.points)
            for name, result in results.items()
        }
        offsets = (p - correspondences.pixels for p in predicted.values())
        rms = [float(np.sqrt(np.mean(np.sum(offset**2, axis=1)))) for offset in offsets]
        worst, *others = sorted(rms, reverse=True)
        difference = worst - min(others, default=0.0)
        if best is None or difference > best[0]:
            data = np.frombuffer(recording.images[stamp].data, np.uint8)
            image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE)
            picture = _residuals(np.asarray(image, np.uint8), correspondences.pixels, predicted)
            best = difference, picture
    return None if best is None else best[1]
