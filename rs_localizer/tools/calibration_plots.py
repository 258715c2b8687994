# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of a calibration: likelihood, parts of the recording, residuals by row and by speed."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.tools.calibration import Calibration, likelihood, without_readout
from rs_localizer.tools.verdict import sense

_BLUE, _ORANGE, _GREY = "#0b3c8c", "#f08a24", "#c9c9c9"
_BINS = 16
_DPI = 130


def save_plots(camera: Camera, calibration: Calibration, directory: Path) -> None:
    """Write ``readout_time.png``, ``residuals.png`` and ``coverage.png`` into a directory."""
    directory.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(10.0, 4.0), dpi=_DPI, layout="constrained")
    left, right = figure.subplots(1, 2)
    _likelihood(left, camera, calibration)
    _blocks(right, calibration)
    figure.savefig(directory / "readout_time.png")
    figure = Figure(figsize=(10.0, 4.0), dpi=_DPI, layout="constrained")
    _residuals(list(figure.subplots(1, 2)), camera, calibration)
    figure.savefig(directory / "residuals.png")
    figure = Figure(figsize=(6.0, 6.0 * camera.height / camera.width), dpi=_DPI)
    _coverage(figure.subplots(), camera, calibration)
    figure.savefig(directory / "coverage.png")


def _likelihood(axes: Axes, camera: Camera, calibration: Calibration) -> None:
    values, costs = likelihood(camera, calibration)
    middle, along = calibration.readout_time, 1e3 * sense(calibration)
    axes.plot(along * values, np.exp(-0.5 * costs), "o-", color=_BLUE, label="measured")
    fine = np.linspace(values[0], values[-1], 200)
    bound = np.exp(-0.5 * ((fine - middle) / calibration.formal_deviation) ** 2)
    axes.plot(along * fine, bound, color=_ORANGE, label="Cramér-Rao bound")
    axes.set(xlabel="readout time (ms)", ylabel="likelihood", title="All of the recording")
    axes.legend(frameon=False)


def _blocks(axes: Axes, calibration: Calibration) -> None:
    along = 1e3 * sense(calibration)
    for block in calibration.blocks:
        axes.errorbar(
            0.5 * (block.start + block.end), along * block.readout_time,
            2e3 * block.deviation, 0.5 * (block.end - block.start), color=_BLUE,
        )  # fmt: skip
    value, band = along * calibration.readout_time, 2e3 * calibration.deviation
    axes.axhspan(value - band, value + band, color=_GREY, alpha=0.6)
    axes.axhline(value, color=_ORANGE)
    axes.set(xlabel="time (s)", ylabel="readout time (ms)", title="Its parts (two deviations)")


def _coverage(axes: Axes, camera: Camera, calibration: Calibration) -> None:
    observations = calibration.posed.observations
    axes.plot(*observations.pixels[observations.trusted].T, ",", color=_BLUE)
    axes.set(xlim=(0, camera.width), ylim=(camera.height, 0), aspect="equal",
             title="Where the map was shown")  # fmt: skip


def _residuals(pair: list[Axes], camera: Camera, calibration: Calibration) -> None:
    before, after = without_readout(camera, calibration)
    for axes, place, label in (
        (pair[0], after.row_times, "row time"),
        (pair[1], after.speeds, "speed in the image (px/s)"),
    ):
        for view, color, name in ((before, _ORANGE, "global shutter"), (after, _BLUE, "rolling")):
            middles, values = _running(place, view.squared_errors)
            axes.plot(middles, values, "o-", color=color, label=name)
        axes.set(xlabel=label, ylabel="error (px rms)", ylim=(0.0, None))
    pair[0].legend(frameon=False)


def _running(place: Array, squared: Array) -> tuple[Array, Array]:
    """Root mean square errors in bins of equally many points."""
    parts = np.array_split(np.argsort(place), _BINS)
    parts = [part for part in parts if len(part)]
    middles = np.array([np.median(place[part]) for part in parts])
    return middles, np.array([np.sqrt(0.5 * np.mean(squared[part])) for part in parts])
