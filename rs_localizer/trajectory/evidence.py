"""What a calibration rests on, to be looked at: the likelihood, and the residuals without it."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.trajectory.calibration import Calibration, within
from rs_localizer.trajectory.fit import cost_at, fit, image_speeds


def likelihood(camera: Camera, found: Calibration, count: int = 9) -> tuple[Array, Array]:
    """Readout times (count,) within four deviations, and what they cost more than the best."""
    seen = within(found.posed.observations, found.fit.state.spline)
    values = found.readout_time + np.linspace(-4.0, 4.0, count) * found.formal_deviation
    costs = np.array([cost_at(camera, seen, found.fit, float(value)) for value in values])
    return values, costs - found.fit.cost


class Residuals(NamedTuple):
    """Of the keypoints that fit."""

    row_times: Array  # (n,)
    speeds: Array  # (n,) px/s, in the image
    squared_errors: Array  # (n,) px^2


def without_readout(camera: Camera, found: Calibration) -> tuple[Residuals, Residuals]:
    """What a global shutter would leave, and what the readout time leaves."""
    seen = within(found.posed.observations, found.fit.state.spline).subset(found.fit.inliers)
    seen = replace(seen, trusted=np.ones_like(seen.trusted))
    held = replace(found.fit.freedom, readout_time=False)
    both = []
    for value in (0.0, found.readout_time):
        start = replace(found.fit.state, readout_time=value)
        both.append(fit(camera, seen, start, held).squared_errors)
    speeds = image_speeds(camera, seen, found.fit.state)
    before, after = (Residuals(seen.row_times, speeds, errors) for errors in both)
    return before, after
