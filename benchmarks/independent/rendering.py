# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of a papered room as a moving rolling-shutter camera takes them, with their depths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.independent.cameras import Camera
from benchmarks.independent.motions import Moving
from benchmarks.independent.rotations import Array

TEXEL = 0.03
"""m, of the papers: some pixels, so that corners can be tracked."""
_DARK, _LIGHT = 40.0, 215.0  # grey levels


@dataclass(frozen=True, slots=True, eq=False)
class Room:
    """A box, seen from inside, about the origin; each wall is papered with soft random squares."""

    half: Array  # (3,) m
    papers: Array  # (6,n,n) grey levels, of the walls at -x, -y, -z, +x, +y, +z

    @classmethod
    def papered(cls, size: float, rng: np.random.Generator) -> Room:
        """A cube of so many metres."""
        texels = int(size / TEXEL) + 2
        return cls(np.full(3, 0.5 * size), rng.uniform(_DARK, _LIGHT, (6, texels, texels)))

    def seen(self, places: Array, directions: Array) -> tuple[Array, Array]:
        """Grey levels (n,) along rays from places (n,3), and how many directions (n,3) away."""
        with np.errstate(divide="ignore"):
            reach = (np.copysign(self.half, directions) - places) / directions
        axis = np.argmin(reach, axis=1)
        rows = np.arange(len(axis))
        away = reach[rows, axis]
        hit = places + away[:, None] * directions
        wall = axis + 3 * (directions[rows, axis] > 0.0)
        others = np.array([[1, 2], [2, 0], [0, 1]])[axis]
        across = (hit[rows[:, None], others] + self.half[others]) / TEXEL
        return self._grey(wall, across), away

    def _grey(self, wall: NDArray[np.int64], across: Array) -> Array:
        """Between four texels, with smooth slopes."""
        last = self.papers.shape[1] - 2
        corner = np.clip(np.floor(across).astype(np.int64), 0, last)
        share = np.clip(across - corner, 0.0, 1.0)
        share = share * share * (3.0 - 2.0 * share)
        (u, v), (i, j) = share.T, corner.T
        near = (1.0 - v) * self.papers[wall, i, j] + v * self.papers[wall, i, j + 1]
        far = (1.0 - v) * self.papers[wall, i + 1, j] + v * self.papers[wall, i + 1, j + 1]
        grey: Array = (1.0 - u) * near + u * far
        return grey


def filmed(
    camera: Camera, motion: Moving, room: Room, first_row: float, samples: int = 2
) -> tuple[NDArray[np.uint8], Array]:
    """One image (h,w) and its depths (h,w), m along the optical axis, each row at its own time.

    Args:
        motion: of which the first camera films.
        first_row: s, when the first row is exposed, for an instant.
        samples: rays of a pixel along each side.
    """
    shift = (np.arange(samples) + 0.5) / samples - 0.5
    v, u = np.mgrid[: camera.height, : camera.width].astype(float)
    total, depth = np.zeros(u.shape), np.zeros(u.shape)
    for across in shift:
        for down in shift:
            pixels = np.stack([u + across, v + down], axis=-1).reshape(-1, 2)
            local = np.column_stack([camera.bearings(pixels), np.ones(len(pixels))])
            when = first_row + camera.exposed(np.stack([u, v], axis=-1))
            lines, of_line = np.unique(when.ravel(), return_inverse=True)
            rotations, places = motion.poses(np.zeros(len(lines), np.int64), lines)
            directions = np.einsum("nij,nj->ni", rotations[of_line], local)
            grey, away = room.seen(places[of_line], directions)
            total += grey.reshape(u.shape)
            depth += away.reshape(u.shape)
    count = samples**2
    return np.rint(total / count).astype(np.uint8), depth / count
