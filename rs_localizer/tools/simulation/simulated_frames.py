# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated frames of a rolling-shutter camera, with their truth.

Every point is projected at the time of its own row along the true motion; noise and outliers are
added to the raw pixels, so that they disturb the row time too, as in a real image.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.tools.simulation.true_motion import TrueMotion, TrueState

# No points closer than this (m): a lens sees them as a blur.
_NEAREST = 0.3
# Points whose true pixel is this many standard deviations of the noise inside the image keep
# their noise Gaussian: it need not be cut at the border.
_BORDER_SIGMAS = 4.0
# A lens model may fold far points back into the image; these bearings do not return (rad).
_FOLD_TOLERANCE = 1e-3
# Largest difference between a middle-row view and the rolling one, in image sizes.
_VIEW_MARGIN = 0.15
# Row times beyond this are of no interest (the image ends at 0.5).
_FARTHEST_ROW = 2.0


@dataclass(frozen=True, slots=True)
class FrameSettings:
    """Points of each frame, and how badly they are seen."""

    points: int = 150  # at most; fewer where the map shows fewer
    noise: float = 1.0  # standard deviation of u and of v, raw pixels
    outliers: float = 0.3  # share of the points whose pixel is uniform in the image
    rate: float = 30.0  # frames per second


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedFrame:
    """One frame; ``stamp_ns`` is the exposure of the first row, the middle row follows."""

    stamp_ns: int
    middle_ns: int
    ids: NDArray[np.int64]  # (n,) rows of the map
    points: Array  # (n,3) m, map frame
    pixels: Array  # (n,2) raw, with noise and outliers
    inliers: NDArray[np.bool_]  # (n,)
    first_row: TrueState  # one instant: at stamp_ns
    middle_row: TrueState  # one instant: at middle_ns
    readout_time: float

    @property
    def motion(self) -> Motion:
        """The truth as the localizer reports it: pose at the middle row, velocities per readout."""
        rotation = self.middle_row.rotations[0].T
        return Motion(
            rotation,
            -rotation @ self.middle_row.positions[0],
            self.middle_row.angular[0] * self.readout_time,
            self.middle_row.linear[0] * self.readout_time,
        )


def frame_stamps(motion: TrueMotion, camera: Camera, rate: float, phase_ns: int = 0) -> list[int]:
    """Return times (ns) of all frames whose readout lies within a stretch of the motion.

    The first one is ``phase_ns`` after the motion's start.

    The camera runs on through the gaps of a recorded motion, but what it saw there is unknown:
    these frames are left out.
    """
    intervals, readout_ns = motion.intervals_ns, round(camera.readout_time * 1e9)
    start, end = intervals[0][0] + phase_ns, intervals[-1][1]
    stamps = [start + round(k * 1e9 / rate) for k in range(int((end - start) * 1e-9 * rate) + 1)]
    seen = [(first, last - readout_ns) for first, last in intervals]
    return [stamp for stamp in stamps if any(first <= stamp <= last for first, last in seen)]


def middle_stamp(camera: Camera, stamp_ns: int) -> int:
    """Return the time of the middle row, of a frame whose first row is at ``stamp_ns``."""
    return stamp_ns + round(-camera.first_row_time * camera.readout_time * 1e9)


def true_poses_at(
    camera: Camera, motion: TrueMotion, middle_ns: int
) -> Callable[[Array], tuple[Array, Array]]:
    """Map row times (n,) to poses camera_from_map of a motion, for ``project_rolling``."""

    def poses_at(tau: Array) -> tuple[Array, Array]:
        # The search for the row may stray, or end as NaN: no such row is ever inside the image.
        near = np.clip(np.nan_to_num(tau), -_FARTHEST_ROW, _FARTHEST_ROW)
        state = motion.state(middle_ns, near * camera.readout_time)
        rotations = np.swapaxes(state.rotations, 1, 2)
        return rotations, -np.einsum("nij,nj->ni", rotations, state.positions)

    return poses_at


def simulate_frames(
    camera: Camera, motion: TrueMotion, map_points: Array, settings: FrameSettings, *,
    stamps_ns: list[int] | None = None, seed: int = 0,
) -> Iterator[SimulatedFrame]:  # fmt: skip
    """Yield the frames that a camera sees of a map (m,3) along a motion.

    Args:
        camera: its readout time and scan direction decide when each row is exposed.
        stamps_ns: exposure of the first row of each frame; default: :func:`frame_stamps`.
        seed: each frame has its own random numbers, from this and its place in the list.
    """
    if stamps_ns is None:
        stamps_ns = frame_stamps(motion, camera, settings.rate)
    for index, stamp_ns in enumerate(stamps_ns):
        rng, now = np.random.default_rng([seed, index]), np.zeros(1)
        middle_ns = middle_stamp(camera, stamp_ns)
        ids, pixels = _visible(camera, motion, middle_ns, map_points, settings, rng)
        inliers = rng.permutation(np.arange(len(ids)) >= round(settings.outliers * len(ids)))
        pixels = pixels + rng.normal(0.0, settings.noise, size=pixels.shape)
        uniform = rng.uniform(-0.5, np.array(camera.size) - 0.5, size=pixels.shape)
        yield SimulatedFrame(
            stamp_ns=stamp_ns, middle_ns=middle_ns, ids=ids, points=map_points[ids],
            pixels=np.where(inliers[:, None], pixels, uniform), inliers=inliers,
            first_row=motion.state(stamp_ns, now), middle_row=motion.state(middle_ns, now),
            readout_time=camera.readout_time,
        )  # fmt: skip


def _visible(
    camera: Camera, motion: TrueMotion, middle_ns: int, map_points: Array, settings: FrameSettings,
    rng: np.random.Generator,
) -> tuple[NDArray[np.int64], Array]:  # fmt: skip
    """Draw points that some row sees: their ids (n,) and true pixels (n,2)."""
    poses_at = true_poses_at(camera, motion, middle_ns)
    size = np.array(camera.size)
    rotations, translations = poses_at(np.zeros(1))
    local = map_points @ rotations[0].T + translations
    near_view = np.abs(camera.project(local) - 0.5 * size) < (0.5 + _VIEW_MARGIN) * size
    candidates = rng.permutation(np.flatnonzero(near_view.all(axis=1)))
    border = min(_BORDER_SIGMAS * settings.noise, 0.25 * float(size.min()))
    ids = np.zeros(0, dtype=np.int64)
    pixels = np.zeros((0, 2))
    # Twice as many as needed is mostly enough; the rolling projection of all would be slow.
    for start in range(0, len(candidates), max(1, 2 * settings.points)):
        if len(ids) >= settings.points:
            break
        block = candidates[start : start + 2 * settings.points]
        projected, tau = project_rolling(camera, poses_at, map_points[block])
        inside = np.all((projected > border - 0.5) & (projected < size - 0.5 - border), axis=1)
        block, projected, tau = block[inside], projected[inside], tau[inside]
        rotations, translations = poses_at(tau)
        local = np.einsum("nij,nj->ni", rotations, map_points[block]) + translations
        distances = np.linalg.norm(local, axis=1)
        folded = np.abs(camera.bearings(projected) - local / distances[:, None]).max(axis=1)
        kept = (distances > _NEAREST) & (folded < _FOLD_TOLERANCE)
        ids, pixels = np.concatenate([ids, block[kept]]), np.concatenate([pixels, projected[kept]])
    return ids[: settings.points], pixels[: settings.points]
