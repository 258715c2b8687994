# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The first motion of a map's images, and how fast it may change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.trajectory.model import Freedom, State
from rs_localizer.trajectory.spline import LONGEST_GAP, LONGEST_SPACING, Spline, spline_through

# A stretch reaches so far beyond its images (s), half as long as readouts take; and this share of
# a known one.
_MARGIN, _MARGIN_SHARE = 0.025, 0.55
# Images in a row of which the motion's own accelerations can be told.
_LEAST_IMAGES = 10
_LEAST_ACCELERATION = 0.5  # rad/s^2, m/s^2
ANGULAR_VELOCITY, LINEAR_VELOCITY = 2.0, 1.0
"""Of images that stand alone, a hand that walks: rad/s, m/s."""


def initial_trajectory(
    times: Array, rotations: Array, positions: Array, readout_time: float
) -> Spline:
    """A spline near poses (g,3,3), (g,3), map_from_camera, at rising times (g,), s.

    Images that follow each other are one stretch; one that stands alone has a piece of its own.
    """
    steps = np.diff(times)
    parts = np.split(np.arange(len(times)), np.flatnonzero(steps > LONGEST_GAP) + 1)
    near = steps[steps <= LONGEST_GAP]
    spacing = min(LONGEST_SPACING, float(np.median(near))) if len(near) else LONGEST_SPACING
    margin = max(_MARGIN, _MARGIN_SHARE * abs(readout_time))
    return spline_through(parts, times, rotations, positions, spacing, margin)


def usual_accelerations(times: Array, rotations: Array, positions: Array) -> tuple[float, float]:
    """Of images (g,) that follow each other, rms: rad/s^2, m/s^2 (0: no three do)."""
    steps = np.diff(times)
    near = (steps[1:] <= LONGEST_GAP) & (steps[:-1] <= LONGEST_GAP)
    if not near.any():
        return 0.0, 0.0
    relative = np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:]
    turns = Rotation.from_matrix(relative).as_rotvec() / steps[:, None]
    speeds = np.diff(positions, axis=0) / steps[:, None]
    between = 0.5 * (steps[1:] + steps[:-1])[:, None]
    angular, linear = (
        float(np.sqrt(np.mean(np.square(np.diff(of, axis=0) / between)[near])))
        for of in (turns, speeds)
    )
    return angular, linear


def acceleration_prior(state: State, freedom: Freedom) -> Freedom | None:
    """With a prior of the accelerations as large as the motion's own, where stretches suffice."""
    layout = state.spline.layout
    counts = np.diff(layout.firsts)
    long = np.repeat(counts >= _LEAST_IMAGES, counts)
    if not long.any():
        return None
    states = state.spline.states(layout.control_times()[long])
    angular, linear = (
        max(float(np.sqrt(np.mean(np.square(of)))), _LEAST_ACCELERATION)
        for of in (states.angular_acceleration, states.linear_acceleration)
    )
    return replace(freedom, angular_acceleration=angular, linear_acceleration=linear)
