"""From single frames to a first motion: knots, and controls through the frames' poses."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.trajectory.spline import Layout, Spline

# Without a frame for longer than this (s), or than so many usual intervals, a motion ends.
LONGEST_GAP, MOST_INTERVALS = 0.25, 4.0
# A stretch with fewer frames says little and costs its own controls.
LEAST_FRAMES = 5
# A hand is held by knots of this spacing (s); a camera that is slower has one for each frame.
LONGEST_SPACING = 0.05


def stretches(times: Array) -> list[IntArray]:
    """Indices of the frames at sorted times (f,), s, cut at the gaps; short parts left out."""
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
    """A spline whose controls lie on the poses (f,3,3), (f,3), map_from_camera, at times (f,).

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
    """A spline near poses, as :func:`first_spline`, with a stretch for each part: indices of frames
    that follow each other, or of one that stands alone.
    """
    intervals = np.array([[times[part[0]] - margin, times[part[-1]] + margin] for part in parts])
    layout = Layout.over(intervals, spacing)
    controls = layout.control_times()
    all_rotations, all_positions = [], []
    for k, part in enumerate(parts):
        own = controls[layout.firsts[k] : layout.firsts[k + 1]]
        inside = np.clip(own, times[part[0]], times[part[-1]])
        if len(part) == 1:
            all_rotations.append(np.repeat(rotations[part], len(own), axis=0))
        else:
            turns = Slerp(times[part], Rotation.from_matrix(rotations[part]))
            all_rotations.append(turns(inside).as_matrix())
        all_positions.append(
            np.column_stack([np.interp(inside, times[part], positions[part, i]) for i in range(3)])
        )
    return Spline(layout, np.concatenate(all_rotations), np.concatenate(all_positions))


def refined(spline: Spline, spacing: float, intervals: Array | None = None) -> Spline:
    """The same motion with other knots, over all of it or over parts (s,2) of its time.

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
