# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A camera's continuous motion: stretches of a uniform cumulative cubic B-spline."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.tools.adjust.spline_kernels import LOCAL, ORDER, jacobians, states, steps

# Without a frame for longer than this (s), or than this many usual intervals, a motion ends.
LONGEST_GAP, MOST_INTERVALS = 0.25, 4.0
# A stretch with fewer frames says little and costs its own controls.
LEAST_FRAMES = 5
# A hand is held by knots of this spacing (s); a camera that is slower has one for each frame.
LONGEST_SPACING = 0.05


def stretches(times: Array) -> list[IntArray]:
    """Return indices of the frames at sorted times (f,), s, cut at gaps, without short parts."""
    if len(times) < 2:
        return []
    intervals = np.diff(times)
    usual = float(np.median(intervals))
    gaps = np.flatnonzero(intervals > max(MOST_INTERVALS * usual, LONGEST_GAP))
    parts = np.split(np.arange(len(times)), gaps + 1)
    return [part for part in parts if len(part) >= LEAST_FRAMES]


def first_spline(
    times: Array, rotations: Array, positions: Array, spacing: float, margin: float
) -> Spline:
    """Return a spline with controls on the poses (f,3,3), (f,3), map_from_camera, at times (f,).

    It reaches ``margin`` (s) beyond the first and last frame of each stretch.

    Raises:
        ValueError: when no stretch has enough frames.
    """
    parts = stretches(times)
    if not parts:
        raise ValueError(f"{len(times)} frames have a pose, none of them {LEAST_FRAMES} in a row")
    return spline_through(parts, times, rotations, positions, spacing, margin)


def spline_through(
    parts: list[IntArray], times: Array, rotations: Array, positions: Array, spacing: float,
    margin: float,
) -> Spline:  # fmt: skip
    """Return a spline near poses, as :func:`first_spline`, with a stretch per part (indices)."""
    intervals = np.array([[times[part[0]] - margin, times[part[-1]] + margin] for part in parts])
    layout = Layout.over(intervals, spacing)
    controls = layout.control_times()
    all_rotations, all_positions = [], []
    for k, part in enumerate(parts):
        own = controls[layout.firsts[k] : layout.firsts[k + 1]]
        if len(part) == 1:
            all_rotations.append(np.repeat(rotations[part], len(own), axis=0))
            all_positions.append(np.repeat(positions[part], len(own), axis=0))
            continue
        # Beyond the ends the motion goes on as before: a fast one that stopped there would be an
        # outlier.
        after = np.clip(np.searchsorted(times[part], own), 1, len(part) - 1)
        first, second = part[after - 1], part[after]
        share = ((own - times[first]) / (times[second] - times[first]))[:, None]
        turns = Rotation.from_matrix(np.swapaxes(rotations[first], 1, 2) @ rotations[second])
        all_rotations.append(rotations[first] @ so3.exp_many(share * turns.as_rotvec()))
        all_positions.append(positions[first] + share * (positions[second] - positions[first]))
    return Spline(layout, np.concatenate(all_rotations), np.concatenate(all_positions))


def refined(spline: Spline, spacing: float, intervals: Array | None = None) -> Spline:
    """Return the same motion with other knots, over all or over parts (s,2) of its time.

    At a knot the curve lies a sixth of the controls' second difference beside its control; where
    the new knots are among the old ones, or between them, the motion stays exactly the same.
    """
    layout = spline.layout
    if intervals is None:
        intervals = np.column_stack([layout.starts, layout.ends])
    finer = Layout.over(intervals, spacing)
    states = spline.states(finer.control_times())
    share = -(spacing**2) / 6.0
    turns = so3.exp_many(share * states.angular_acceleration)
    return Spline(
        finer, states.rotations @ turns, states.positions + share * states.linear_acceleration
    )


class States(NamedTuple):
    """Poses and their rates at m times."""

    rotations: Array  # (m,3,3) map_from_camera
    positions: Array  # (m,3) m, of the camera centre in the map
    angular: Array  # (m,3) rad/s, body rate
    linear: Array  # (m,3) m/s, along the map's axes
    angular_acceleration: Array  # (m,3) rad/s^2, in body axes
    linear_acceleration: Array  # (m,3) m/s^2, along the map's axes


@dataclass(frozen=True, slots=True, eq=False)
class Layout:
    """Knots of the stretches: one list of controls, cut at the gaps.

    The controls ``firsts[k]`` to ``firsts[k + 1] - 1`` belong to stretch k, whose motion is
    defined from ``starts[k]`` on for as many spacings as it has controls, less three.
    """

    spacing: float  # s
    starts: Array  # (s,) s
    firsts: IntArray  # (s + 1,)

    @staticmethod
    def over(intervals: Array, spacing: float) -> Layout:
        """Return knots that cover time intervals (s,2)."""
        spans = np.ceil((intervals[:, 1] - intervals[:, 0]) / spacing - 1e-9).astype(np.int64)
        spans = np.maximum(spans, 1)
        middles = 0.5 * (intervals[:, 0] + intervals[:, 1])
        firsts = np.concatenate([[0], np.cumsum(spans + ORDER - 1)])
        return Layout(float(spacing), middles - 0.5 * spacing * spans, firsts)

    @property
    def ends(self) -> Array:
        """Ends (s,) of the stretches, s."""
        return np.asarray(self.starts + self.spacing * (np.diff(self.firsts) - (ORDER - 1)))

    def alone(self) -> IntArray:
        """Return the second controls (k,) of stretches of one interval, which lies behind them."""
        return np.asarray(1 + self.firsts[:-1][np.diff(self.firsts) == ORDER])

    def control_times(self) -> Array:
        """Return the times (n,) at which the controls weigh most, s."""
        parts = [
            start + self.spacing * (np.arange(count) - 1.0)
            for start, count in zip(self.starts, np.diff(self.firsts), strict=True)
        ]
        return np.concatenate(parts)

    def stretches(self, times: Array) -> IntArray:
        """Return the stretch (m,) of each time; the nearest one if it lies in none."""
        after = np.clip(np.searchsorted(self.starts, times, side="right"), 1, len(self.starts))
        index = after - 1
        following = np.minimum(after, len(self.starts) - 1)
        nearer = self.starts[following] - times < times - self.ends[index]
        return np.where(nearer & (times > self.ends[index]), following, index)

    def inside(self, times: Array) -> BoolArray:
        """Return a mask (m,) of times that a stretch covers."""
        index = self.stretches(times)
        return (times >= self.starts[index]) & (times <= self.ends[index])

    def locate(self, times: Array) -> tuple[IntArray, Array]:
        """Return the first of four controls (m,) at times (m,), and the place (m,) ``u``.

        Times outside of the stretches are taken for the nearest covered one.
        """
        times = np.asarray(times, float)
        index = self.stretches(times)
        place = (times - self.starts[index]) / self.spacing
        spans = np.diff(self.firsts)[index] - (ORDER - 1)
        place = np.clip(place, 0.0, spans)
        whole = np.minimum(place.astype(np.int64), spans - 1)
        return self.firsts[index] + whole, place - whole


@dataclass(frozen=True, slots=True, eq=False)
class Spline:
    """A motion: knots and controls."""

    layout: Layout
    rotations: Array  # (n,3,3) map_from_camera
    positions: Array  # (n,3) m

    def __post_init__(self) -> None:
        for name in ("rotations", "positions"):  # as kernels take them
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name)))

    def moved(self, step: Array) -> Spline:
        """Return the spline with the controls changed by a step (6 n,)."""
        step = step.reshape(-1, 6)
        rotations = self.rotations @ so3.exp_many(step[:, :3])
        return Spline(self.layout, rotations, self.positions + step[:, 3:])

    def steps(self) -> tuple[Array, Array]:
        """Return rotation vectors (n,3) between controls, and inverse right Jacobians (n,3,3)."""
        vectors, inverses = np.zeros((len(self.rotations), 3)), np.zeros_like(self.rotations)
        steps(self.rotations, vectors, inverses)
        return vectors, inverses

    def states(self, times: Array) -> States:
        """Return pose, velocities and accelerations at times (m,), s."""
        first, u = self.layout.locate(times)
        vectors, _ = self.steps()
        m = len(first)
        rotations, positions, change = np.empty((m, 3, 3)), np.empty((m, 3)), np.empty((m, 4, 3))
        states(
            self.rotations, self.positions, vectors, first, u, self.layout.spacing,
            rotations, positions, change,
        )  # fmt: skip
        angular, linear, angular_acceleration, linear_acceleration = np.moveaxis(change, 1, 0)
        return States(
            rotations, positions, angular, linear, angular_acceleration, linear_acceleration
        )

    def jacobians(self, times: Array) -> tuple[IntArray, Array]:
        """Return first controls (m,), and derivatives (m,12,24) of the states by four controls.

        The rows: turn of the camera in its own axes, position in the map, body rate (rad/s),
        velocity in the map (m/s).
        """
        first, u = self.layout.locate(times)
        vectors, inverses = self.steps()
        out = np.zeros((len(first), 12, LOCAL))
        jacobians(
            self.rotations, self.positions, vectors, inverses, first, u, self.layout.spacing, out
        )
        return first, out
