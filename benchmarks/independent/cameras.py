# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A pinhole camera with Brown's distortion (``plumb_bob``) and a rolling shutter."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from benchmarks.independent.rotations import Array

_ITERATIONS = 200
_EXACT = 1e-10  # px


class Scan(StrEnum):
    """Where the shutter moves over the image."""

    DOWN = "top_to_bottom"
    UP = "bottom_to_top"
    RIGHT = "left_to_right"
    LEFT = "right_to_left"


@dataclass(frozen=True, slots=True)
class Camera:
    """The camera as it really is."""

    width: int = 640
    height: int = 480
    focal: float = 420.0  # px
    # k1, k2, p1, p2, k3: a plain lens; 10 % of it are 0.2 px where a board ends.
    distortion: tuple[float, ...] = (-0.2, 0.05, 5e-4, -5e-4, 0.0)
    readout_time: float = 0.03  # s
    scan: Scan = Scan.DOWN

    @property
    def matrix(self) -> Array:
        """K (3,3)."""
        u, v = self.centre
        return np.array([[self.focal, 0.0, u], [0.0, self.focal, v], [0.0, 0.0, 1.0]])

    @property
    def centre(self) -> Array:
        """Principal point (2,), a little beside the middle of the image."""
        return np.array([0.5 * self.width + 4.3, 0.5 * self.height - 3.1])

    def project(self, local: Array) -> Array:
        """Pixels (...,2) of points (...,3) in camera axes; NaN behind the camera."""
        depth = np.where(local[..., 2:] > 0.0, local[..., 2:], np.nan)
        return self.focal * self._distorted(local[..., :2] / depth) + self.centre

    def bearings(self, pixels: Array) -> Array:
        """Bearings (...,2), x/z and y/z, of pixels (...,2), by iteration."""
        wanted = (pixels - self.centre) / self.focal
        found = wanted.copy()
        for _ in range(_ITERATIONS):
            miss = wanted - self._distorted(found)
            found += miss
            if np.nanmax(np.abs(miss)) * self.focal < _EXACT:
                break
        return found

    def exposed(self, pixels: Array) -> Array:
        """Seconds (...) from the first row's exposure to that of raw pixels (...,2)."""
        along, last = pixels[..., 0], self.width - 1
        if self.scan in (Scan.DOWN, Scan.UP):
            along, last = pixels[..., 1], self.height - 1
        share = along / last if self.scan in (Scan.DOWN, Scan.RIGHT) else 1.0 - along / last
        return np.asarray(self.readout_time * share)

    def project_rolling(self, local_at: Callable[[Array], Array], shape: tuple[int, ...]) -> Array:
        """Pixels (*shape,2), each where its point is when its row is exposed.

        ``local_at`` gives the points (*shape,3) in camera axes at delays (*shape) after the first
        row. Pixel and delay are iterated in turn, which converges as long as no point outruns the
        shutter; NaN where they do not agree.
        """
        delay = np.full(shape, 0.5 * self.readout_time)
        pixels = self.project(local_at(delay))
        for _ in range(_ITERATIONS):
            before = pixels
            # A point far outside is seen by no row, and need not be followed.
            delay = np.clip(self.exposed(pixels), -self.readout_time, 2.0 * self.readout_time)
            pixels = self.project(local_at(delay))
            moved = np.abs(pixels - before).max(axis=-1)
            if not np.any(moved > _EXACT):
                break
        pixels[~(moved < 1e3 * _EXACT)] = np.nan
        return pixels

    def _distorted(self, bearings: Array) -> Array:
        k1, k2, p1, p2, k3 = self.distortion
        x, y = bearings[..., 0], bearings[..., 1]
        square = x * x + y * y
        radial = 1.0 + square * (k1 + square * (k2 + square * k3))
        u = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x)
        v = y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y
        return np.stack([u, v], axis=-1)
