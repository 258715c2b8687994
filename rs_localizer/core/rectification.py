# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pixels as a global shutter would have seen them.

Let ``R, t`` be the poses camera_from_map at two row times. A point that the camera sees at ``tau``,
the row time of its pixel, lies at another row time ``tau'`` at

    camera_point(tau') = Q camera_point(tau) + t(tau') - Q t(tau),   Q = R(tau') R(tau)^T

The poses include accelerations, and vibration as far as it is known. A pixel alone does not
determine the depth; for distant points only the rotation counts.
"""

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.core.arrays import Array, instance
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion


def rectify(
    camera: Camera,
    motion: Motion,
    pixels: ArrayLike,
    depths: ArrayLike | None = None,
    tau: float = 0.0,
) -> Array:
    """Return the pixels where a global shutter would have seen what these pixels show.

    Args:
        camera: that took the image.
        motion: of the camera during the readout; an :class:`rs_localizer.Estimate` is one.
        pixels: (n,2) raw image coordinates.
        depths: (n,) or one for all: z (m) of each point in the camera, at its own row's time; None:
            far away, so that the translation does not count. With the pose of an estimate, points
            of the map have the depth ``(rotation @ point + translation)[2]``, which is near enough.
        tau: row time of the global shutter: 0 for the middle row, -0.5 the first, 0.5 the last;
            ``camera.row_time(pixel)`` for any other.

    Returns:
        (n,2) raw pixels, distorted by the lens as the given ones; NaN where the lens model has no
        bearing for a pixel, or the point would be behind the camera.

    Raises:
        ValueError: wrong shapes, depths that are not positive, or a row time that is not finite.
    """
    instance("camera", camera, Camera)
    instance("motion", motion, Motion)
    pixels = np.ascontiguousarray(pixels, np.float64)
    if pixels.ndim != 2 or pixels.shape[1] != 2:
        raise ValueError(f"pixels must be (n,2), got {pixels.shape}")
    if not np.isfinite(tau):
        raise ValueError(f"tau must be finite, got {tau!r}")
    rotations, translations = motion.at_rows(camera.row_time(pixels))
    return transferred(camera, pixels, (rotations, translations), motion.at(float(tau)), depths)


def transferred(
    camera: Camera,
    pixels: Array,
    poses: tuple[Array, Array],
    wanted: tuple[Array, Array],
    depths: ArrayLike | None = None,
) -> Array:
    """Return the pixels where a camera at another pose would have seen what these pixels show.

    Args:
        camera: that took the image.
        pixels: (n,2) raw.
        poses: rotations (n,3,3) and translations (n,3), camera_from_map, when each was exposed.
        wanted: rotation and translation of the other: (3,3) and (3,), or for each pixel.
        depths: (n,) or one for all, as of :func:`rectify`.

    Returns:
        (n,2) as of :func:`rectify`.
    """
    rotations, translations = poses
    turn = "...ij,...kj,...k->...i"  # wanted_from_own
    points = np.column_stack([camera.rays(pixels), np.ones(len(pixels))])
    turned = np.einsum(turn, wanted[0], rotations, points)
    if depths is None:
        return camera.project(turned)
    z = np.asarray(depths, np.float64)
    if z.shape not in ((), (len(pixels),)) or not np.all(z > 0.0):
        raise ValueError(f"depths must be one or (n,) numbers above 0, got {depths!r}")
    # The shift is in units of the depth, which may be infinite.
    shift = wanted[1] - np.einsum(turn, wanted[0], rotations, translations)
    return camera.project(turned + shift / np.broadcast_to(z, len(pixels))[:, None])
