# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Textured planes: what a rendered scene is made of, and how the renderer keeps them."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.io.video import Image


@dataclass(frozen=True, slots=True, eq=False)
class TexturedPlane:
    """A rectangle with a grey picture on both of its sides.

    Texel (row i, column j) covers the square from ``j`` to ``j + 1`` texels along ``right`` and
    from ``i`` to ``i + 1`` along ``down``, counted from ``corner``.
    """

    corner: Array  # (3,) m, map frame: where the picture's first texel begins
    right: Array  # (3,) unit vector along the picture's rows
    down: Array  # (3,) unit vector along its columns
    texel: float  # m
    texture: Image  # (height, width)

    @property
    def normal(self) -> Array:
        """(3,) unit vector, away from a viewer who reads the picture unmirrored."""
        return np.cross(self.right, self.down)

    @property
    def size(self) -> tuple[float, float]:
        """Width and height, m."""
        height, width = self.texture.shape
        return width * self.texel, height * self.texel

    def points(self, texels: Array) -> Array:
        """Points (n,3) of the map at texel coordinates (n,2), which count from the corner."""
        across, along = self.texel * np.asarray(texels, float).T
        points: Array = self.corner + across[:, None] * self.right + along[:, None] * self.down
        return points

    def homographies(self, rotations: Array, positions: Array) -> Array:
        """Bearings to texels, for n cameras: (n,3,3).

        The third coordinate of ``H (a, b, 1)`` is the inverse depth of the plane along that
        bearing, negative behind the camera; the first two over it are the texel coordinates.

        Args:
            rotations: (n,3,3) map_from_camera.
            positions: (n,3) camera centres.
        """
        normal = self.normal
        from_corner = positions - self.corner
        # Along the bearing d the plane is met at c + d / q with q = -n d / n (c - corner).
        distance = from_corner @ normal
        with np.errstate(divide="ignore", invalid="ignore"):  # a camera in the plane sees no plane
            inverse_depth = -(normal @ rotations) / distance[:, None]
        rows = [
            (axis @ rotations + (from_corner @ axis)[:, None] * inverse_depth) / self.texel
            for axis in (self.right, self.down)
        ]
        return np.stack([*rows, inverse_depth], axis=1)


def pyramids(planes: Sequence[TexturedPlane]) -> tuple[Image, NDArray[np.int64]]:
    """The pictures of several planes with all their reductions, for the kernel.

    Returns:
        texels (n,) and levels (planes, levels, 3): ``levels[p, l]`` is where level ``l`` of picture
        ``p`` begins, its width and height; each level averages two by two texels of the one before.
        Pictures with fewer levels repeat their last.
    """
    reduced = [_reductions(plane.texture) for plane in planes]
    depth = max(len(images) for images in reduced)
    levels = np.zeros((len(planes), depth, 3), np.int64)
    start = 0
    for p, images in enumerate(reduced):
        for level, image in enumerate(images):
            levels[p, level:] = start, image.shape[1], image.shape[0]
            start += image.size
    return np.concatenate([image.ravel() for images in reduced for image in images]), levels


def _reductions(texture: Image) -> list[Image]:
    images = [np.ascontiguousarray(texture)]
    while min(images[-1].shape) > 1:
        image = images[-1]
        # Texels stay squares of 2^level: an odd last row or column stands for a pair.
        even = np.pad(image, [(0, size % 2) for size in image.shape], mode="edge")
        half = cv2.resize(
            even, (even.shape[1] // 2, even.shape[0] // 2), interpolation=cv2.INTER_AREA
        )
        images.append(np.asarray(half, np.uint8).reshape(even.shape[0] // 2, even.shape[1] // 2))
    return images
