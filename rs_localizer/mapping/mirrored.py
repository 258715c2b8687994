"""Markers that were turned over: a square that is seen from one side fits two poses.

From few directions the wrong one is a minimum, too, which no adjustment leaves (Collins and
Bartoli, *Infinitesimal plane-based pose estimation*, IJCV 2014). With the motion held, each marker
is mirrored about its mean line of sight, adjusted on its own, and compared.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.camera import Camera
from rs_localizer.mapping.similarity import through
from rs_localizer.trajectory.bodies import BODY
from rs_localizer.trajectory.fit import Fit
from rs_localizer.trajectory.model import Observations, State
from rs_localizer.trajectory.normal_kernels import Normal
from rs_localizer.trajectory.problem import LIMIT, Problem

# Steps of Gauss and Newton, and the noise of each by what it is.
_NOISES = (10.0,) * 6 + (1.0,) * 4
# Of the cost of independent errors: the other pose is e^6 times less likely, or it may be true.
_LEAST_DIFFERENCE = 12.0


@dataclass(frozen=True, slots=True, eq=False)
class Mirrored:
    """What is known of the other pose of each marker."""

    better: BoolArray  # (m,) which fit better mirrored
    doubtful: BoolArray  # (m,) which fit nearly as well, one way or the other
    state: State  # with those mirrored that fit better so


def mirrored(camera: Camera, seen: Observations, found: Fit) -> Mirrored:
    """Compare each marker with its mirror image, the motion held.

    Args:
        seen: corners, four of each marker; those of the first, the origin, are known.
        found: the adjustment of these.
    """
    count = len(found.state.landmarks) // 4
    # The origin, too, may lie the other way among all others.
    free = replace(seen, bodies=np.repeat(np.arange(count), 4))
    problem = Problem(camera, free, found.state, replace(found.freedom, readout_time=False))
    other = replace(found.state, landmarks=_turned_over(seen, found.state))
    for noise in _NOISES:
        normal = problem.normal(other, noise * found.deviation)[1]
        still = np.zeros(len(normal.slope))
        other = problem.moved(other, normal, (still, _steps(normal, count)))
    own, theirs = (_costs(problem, state, found.deviation) for state in (found.state, other))
    better = theirs < own
    doubtful = np.abs(theirs - own) < _LEAST_DIFFERENCE * found.inflation
    # What came back is the same pose.
    apart = _normals(other) * _normals(found.state)
    same = np.sum(apart, axis=1) > np.cos(0.02)
    chosen = np.where(np.repeat(better & ~same, 4)[:, None], other.landmarks, found.state.landmarks)
    return Mirrored(better & ~same, doubtful & ~same, _at_the_origin(found.state, chosen))


def _turned_over(seen: Observations, state: State) -> Array:
    """Corners (p,3) of each marker mirrored in depth as its images see it."""
    layout, corners = state.spline.layout, state.landmarks.reshape(-1, 4, 3)
    times = np.clip(seen.times, layout.starts.min(), layout.ends.max())
    markers, middles = seen.points // 4, corners.mean(axis=1)
    toward: Array = state.spline.states(times).positions - middles[markers]
    toward /= np.linalg.norm(toward, axis=1)[:, None]
    sums = [np.bincount(markers, of, len(corners)) for of in toward.T]
    sight: Array = np.column_stack(sums)
    sight /= np.maximum(np.linalg.norm(sight, axis=1), 1e-12)[:, None]
    depth = np.einsum("mci,mi->mc", corners - middles[:, None], sight)
    return np.asarray(corners - 2.0 * depth[..., None] * sight[:, None]).reshape(-1, 3)


def _steps(normal: Normal, count: int) -> Array:
    """Of all markers (6 m,), each on its own."""
    at = BODY * np.arange(count)[:, None] + np.arange(BODY)
    lower = np.tril(normal.corner[at[:, :, None], at[:, None, :]])
    blocks = lower + np.tril(lower, -1).swapaxes(1, 2)
    steps: Array = -np.linalg.solve(blocks, normal.border_slope[at][..., None]).ravel()
    return steps


def _costs(problem: Problem, state: State, deviation: float) -> Array:
    """Of the corners of each marker (m,), Tukey's."""
    limit = (LIMIT * deviation) ** 2
    rest = np.maximum(1.0 - problem.errors(state) / limit, 0.0)
    costs = (1.0 - rest**3) * limit / (3.0 * deviation**2)
    points = problem.observations.points
    return np.asarray(np.bincount(points // 4, costs, len(state.landmarks) // 4), np.float64)


def _normals(state: State) -> Array:
    """Of the markers (m,3)."""
    corners = state.landmarks.reshape(-1, 4, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1])
    return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None])


def _at_the_origin(state: State, landmarks: Array) -> State:
    """With these landmarks (p,3), and all moved so that the first four stay where they were."""
    back = through(landmarks[:4], state.landmarks[:4])
    moved = back(landmarks)
    moved[:4] = state.landmarks[:4]
    return replace(state, spline=back.moved(state.spline), landmarks=moved)
