# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The extended unified camera model, for lenses of up to 180 degrees and more.

With ``rho = sqrt(beta (x^2 + y^2) + z^2)``, a bearing is seen at

    (x, y) / (alpha rho + (1 - alpha) z)

in focal lengths from the centre: Khomutenko, Garcia, Martinet, "An enhanced unified camera model"
(RA-L 2016), equations 12 and 22. ``D`` is alpha, beta, in the order of Kalibr's ``eucm``.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.lens_laws import LensLaw, Seen, onto_sensor, sphere_law


def project_bearings(bearings: Array, D: Array) -> Seen:
    """Return the places (n,2) that bearings (n,3) hit, in focal lengths, with all derivatives."""
    alpha, beta = D[:2]
    x, y, z = bearings.T
    square = x * x + y * y
    rho = np.sqrt(beta * square + z * z)
    below = alpha * rho + (1.0 - alpha) * z
    # Beyond this plane two bearings share a place in the image (equation 17).
    steepness = alpha / (1.0 - alpha) if alpha <= 0.5 else (1.0 - alpha) / alpha
    below = np.where(z > -steepness * rho, below, np.nan)
    along, ahead = alpha * beta / rho, alpha * z / rho + 1.0 - alpha
    return onto_sensor(
        bearings,
        below,
        np.column_stack([along * x, along * y, ahead]),
        np.column_stack([rho - z, 0.5 * alpha * square / rho]),
    )


def find_bearings(places: Array, D: Array) -> Array:
    """Return bearings (n,3) of places (n,2) in focal lengths from the centre; NaN where none is."""
    alpha, beta = D[:2]
    square = (places**2).sum(axis=1)
    with np.errstate(invalid="ignore"):
        root = np.sqrt(1.0 - (2.0 * alpha - 1.0) * beta * square)
    ahead = (1.0 - beta * alpha**2 * square) / (alpha * root + 1.0 - alpha)
    return np.column_stack([places, ahead])


EUCM: LensLaw = sphere_law(project_bearings, find_bearings, 2, limits=((0.0, 1.0), (1e-3, 1e3)))
