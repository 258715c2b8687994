# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames of many short recordings, all projected at once."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from benchmarks.independent.cameras import Camera
from benchmarks.independent.motions import IntArray, Moving, States
from benchmarks.independent.rotations import Array, BoolArray
from benchmarks.independent.scenes import Scene, points, visible

PERIOD_NS = 33_333_333  # 30 Hz
_EPOCH_NS = 10**12

MakeMotions = Callable[[int, np.random.Generator], Moving]
Displaced = Callable[[Array, Array, IntArray], Array]
"""Where points (f,n,3) are at times (f,n) of recordings (f,): some of them may move."""


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """f frames of n points, one recording after the other."""

    camera: Camera
    recording: IntArray  # (f,) which one
    place: IntArray  # (f,) of the frame in its recording
    stamp_ns: IntArray  # (f,) exposure of the first row
    points: Array  # (f,n,3) as the map has them
    exact: Array  # (f,n,2) raw pixels without noise
    visible: BoolArray  # (f,n) which of them are seen
    unit_noise: Array  # (f,n,2) of deviation 1
    first: States  # at the first row
    middle: States  # at the middle row

    def __len__(self) -> int:
        return len(self.recording)

    def seen(self, frame: int, noise: float) -> tuple[Array, Array]:
        """Points (k,3) and pixels (k,2) of one frame at a noise (px)."""
        shown = self.visible[frame]
        pixels = self.exact[frame] + noise * self.unit_noise[frame]
        return self.points[frame, shown], pixels[shown]

    def middle_ns(self, frame: int) -> int:
        """Exposure of the middle row."""
        return int(self.stamp_ns[frame]) + round(0.5e9 * self.camera.readout_time)


def simulate(
    camera: Camera, make_motions: MakeMotions, scene: Scene, recordings: int, length: int,
    seed: int, displaced: Displaced | None = None,
) -> Frames:  # fmt: skip
    """Recordings of ``length`` frames; time 0 of their motions is the middle of each."""
    rng = np.random.default_rng(seed)
    motions = make_motions(recordings, rng)
    which = np.repeat(np.arange(recordings), length)
    place = np.tile(np.arange(length), recordings)
    time = first_row_times(camera, length)[place]
    middle = time + 0.5 * camera.readout_time
    true, mapped = points(scene, camera, motions, which, middle, rng)
    count = true.shape[1]
    each = np.repeat(which, count)

    def local_at(delay: Array) -> Array:
        now = time[:, None] + delay
        rotation, position = motions.poses(each, now.ravel())
        there = true if displaced is None else displaced(true, now, which)
        local = np.einsum("nji,nj->ni", rotation, there.reshape(-1, 3) - position)
        return np.asarray(local.reshape(true.shape))

    exact = camera.project_rolling(local_at, true.shape[:2])
    stamps, noise = _EPOCH_NS + PERIOD_NS * place, rng.normal(size=exact.shape)
    states = motions.states(which, time), motions.states(which, middle)
    shown = visible(camera, exact)
    return Frames(camera, which, place, stamps, mapped, exact, shown, noise, *states)


def first_row_times(camera: Camera, length: int) -> Array:
    """Times (length,) of the first rows (s)."""
    from_middle = np.arange(length) - 0.5 * (length - 1)
    return np.asarray(np.asarray(1e-9 * PERIOD_NS * from_middle - 0.5 * camera.readout_time))
