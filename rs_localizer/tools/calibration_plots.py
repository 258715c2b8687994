# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Picture of a calibration: likelihood of the readout time, and parts of the recording."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rs_localizer.core.camera import Camera
from rs_localizer.tools.camera_calibration import CameraCalibration, likelihood

_BLUE, _ORANGE, _GREY = "#0b3c8c", "#f08a24", "#c9c9c9"
_DPI = 130


def save_plots(camera: Camera, calibration: CameraCalibration, directory: Path) -> None:
    """Write ``readout_time.png`` into a directory."""
    directory.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(10.0, 4.0), dpi=_DPI, layout="constrained")
    left, right = figure.subplots(1, 2)
    _likelihood(left, camera, calibration)
    _blocks(right, calibration)
    figure.savefig(directory / "readout_time.png")


def _likelihood(axes: Axes, camera: Camera, calibration: CameraCalibration) -> None:
    values, costs = likelihood(camera, calibration)
    middle, along = calibration.readout_time, 1e3 * calibration.sense
    axes.plot(along * values, np.exp(-0.5 * costs), "o-", color=_BLUE, label="measured")
    fine = np.linspace(values[0], values[-1], 200)
    bound = np.exp(-0.5 * ((fine - middle) / calibration.formal_deviation) ** 2)
    axes.plot(along * fine, bound, color=_ORANGE, label="Cramér-Rao bound")
    axes.set(xlabel="readout time (ms)", ylabel="likelihood", title="All of the recording")
    axes.legend(frameon=False)


def _blocks(axes: Axes, calibration: CameraCalibration) -> None:
    along = 1e3 * calibration.sense
    for block in calibration.blocks:
        axes.errorbar(
            0.5 * (block.start + block.end), along * block.readout_time,
            2e3 * block.deviation, 0.5 * (block.end - block.start), color=_BLUE,
        )  # fmt: skip
    value, band = along * calibration.readout_time, 2e3 * calibration.deviation
    axes.axhspan(value - band, value + band, color=_GREY, alpha=0.6)
    axes.axhline(value, color=_ORANGE)
    axes.set(xlabel="time (s)", ylabel="readout time (ms)", title="Its parts (two deviations)")
