# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The first motion of a map's images, and how fast it may change."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.tools.adjust.spline import LONGEST_GAP, LONGEST_SPACING, Spline, spline_through
from rs_localizer.tools.adjust.variables import Freedom, Unknowns

# A stretch reaches so far beyond its images (s), half as long as readouts take; and this share of
# a known one.
_MARGIN, _MARGIN_SHARE = 0.025, 0.55
# Beyond this rotation (rad) between two images its direction is unknown: the video is cut, or a
# line of a survey flight ends.
_MOST_TURN = 0.5 * math.pi
# Images in a row of which the motion's own accelerations can be told.
_LEAST_IMAGES = 10
_LEAST_ACCELERATION = 0.5  # rad/s^2, m/s^2
ANGULAR_VELOCITY, LINEAR_VELOCITY = 2.0, 1.0
"""Velocity of images that stand alone, a hand that walks: rad/s, m/s."""


def following(times: Array, rotations: Array) -> BoolArray:
    """Return a mask (g - 1,) of images that follow the one before in one motion."""
    turns = Rotation.from_matrix(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:])
    return np.asarray((np.diff(times) <= LONGEST_GAP) & (turns.magnitude() < _MOST_TURN), np.bool_)


def initial_trajectory(
    times: Array, rotations: Array, positions: Array, readout_time: float,
    follow: BoolArray | None = None,
) -> Spline:  # fmt: skip
    """Return a spline near poses (g,3,3), (g,3), map_from_camera, at rising times (g,), s.

    Images that follow each other (g - 1,) are one stretch (None: those that are near in time); one
    that stands alone has a piece of its own.
    """
    steps = np.diff(times)
    near = steps <= LONGEST_GAP if follow is None else follow
    parts = np.split(np.arange(len(times)), np.flatnonzero(~near) + 1)
    spacing = min(LONGEST_SPACING, float(np.median(steps[near]))) if near.any() else LONGEST_SPACING
    margin = max(_MARGIN, _MARGIN_SHARE * abs(readout_time))
    # A stretch reaches up to half a spacing beyond its margins, and must not reach the next one.
    shortest = float(np.min(steps[~near], initial=np.inf))
    spacing, margin = min(spacing, 0.4 * shortest), min(margin, 0.25 * shortest)
    return spline_through(parts, times, rotations, positions, spacing, margin)


def acceleration_prior(state: Unknowns, freedom: Freedom) -> Freedom | None:
    """Return a prior of accelerations as large as the motion's own, if stretches suffice."""
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
