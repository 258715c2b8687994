# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The double sphere model, for lenses of more than 180 degrees.

With ``k = xi sqrt(x^2 + y^2 + z^2) + z`` a bearing is seen at

    (x, y) / (alpha sqrt(x^2 + y^2 + k^2) + (1 - alpha) k)

in focal lengths from the centre: Usenko, Demmel, Cremers, "The double sphere camera model" (3DV
2018), equations 40 to 52. ``D`` is xi, alpha, in the order of Kalibr's ``ds``.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.lens_laws import LensLaw, Seen, onto_sensor, sphere_law


def project_bearings(bearings: Array, D: Array) -> Seen:
    """Return the places (n,2) that bearings (n,3) hit, in focal lengths, with all derivatives."""
    xi, alpha = D[:2]
    x, y, z = bearings.T
    first = np.sqrt((bearings**2).sum(axis=1))
    k = xi * first + z
    second = np.sqrt(x * x + y * y + k * k)
    below = alpha * second + (1.0 - alpha) * k
    # Beyond this plane two bearings share a place in the image (equations 43 to 45).
    first_plane = alpha / (1.0 - alpha) if alpha <= 0.5 else (1.0 - alpha) / alpha
    plane = (first_plane + xi) / np.sqrt(2.0 * first_plane * xi + xi**2 + 1.0)
    below = np.where(z > -plane * first, below, np.nan)
    by_k = alpha * k / second + 1.0 - alpha
    across = alpha / second + by_k * xi / first
    return onto_sensor(
        bearings,
        below,
        np.column_stack([across * x, across * y, by_k * (xi * z / first + 1.0)]),
        np.column_stack([by_k * first, second - k]),
    )


def find_bearings(places: Array, D: Array) -> Array:
    """Return bearings (n,3) of places (n,2) in focal lengths from the centre; NaN where none is."""
    xi, alpha = D[:2]
    square = (places**2).sum(axis=1)
    with np.errstate(invalid="ignore"):
        root = np.sqrt(1.0 - (2.0 * alpha - 1.0) * square)
        z = (1.0 - alpha**2 * square) / (alpha * root + 1.0 - alpha)
        scale = (z * xi + np.sqrt(z**2 + (1.0 - xi**2) * square)) / (z**2 + square)
    bearings: Array = scale[:, None] * np.column_stack([places, z])
    bearings[:, 2] -= xi
    return bearings


DOUBLE_SPHERE: LensLaw = sphere_law(
    project_bearings, find_bearings, 2, limits=((-1.0, 1.0), (0.0, 1.0))
)
