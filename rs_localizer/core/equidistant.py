# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Kannala and Brandt's lens beyond 90 degrees: radii are polynomials of the angle to the axis.

    r = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

Kannala, Brandt, "A generic camera model and calibration method for conventional, wide-angle, and
fish-eye lenses" (PAMI 2006), equation 6, with the first coefficient in the focal length: OpenCV's
``fisheye``, which ends at 90 degrees.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.lens_laws import LensLaw, Seen, sphere_law

_STEPS = 30
_SMALL = 1e-9  # of the distance along the axis


def _radius(angle: Array, D: Array) -> tuple[Array, Array]:
    """Return radii of angles, in focal lengths, and their derivatives."""
    powers = np.array([1.0, *D[:4]])
    square = angle**2
    radius, rate = np.zeros_like(angle), np.zeros_like(angle)
    for k in range(4, -1, -1):
        radius, rate = radius * square + powers[k], rate * square + (2 * k + 1) * powers[k]
    return radius * angle, rate


def widest(D: Array) -> float:
    """Return the angle (rad) up to which radii grow, at most pi; beyond it the image runs back."""
    roots = np.roots([9.0 * D[3], 7.0 * D[2], 5.0 * D[1], 3.0 * D[0], 1.0])
    folds = [root.real for root in roots if abs(root.imag) < 1e-9 and root.real > 0.0]
    return float(np.sqrt(min([np.pi**2, *folds])))


def project_bearings(bearings: Array, D: Array) -> Seen:
    """Return the places that bearings (n,3) hit, with derivatives; NaN beyond :func:`widest`."""
    z = bearings[:, 2]
    across = np.hypot(bearings[:, 0], bearings[:, 1])
    angle = np.where((angle := np.arctan2(across, z)) < widest(D), angle, np.nan)
    radius, rate = _radius(angle, D)
    square = across**2 + z**2
    # Near the axis the direction is any, and a radius as far as across over z.
    far = across > _SMALL * np.abs(z)
    off = np.where(far, across, 1.0)
    scale = np.where(far, radius / off, 1.0 / np.where(far, 1.0, z))
    by_across = np.where(far, (rate * z / square - scale) / off**2, 0.0)
    towards = bearings[:, :2]
    by_bearing = np.empty((len(bearings), 2, 3))
    by_bearing[:, :, :2] = (
        scale[:, None, None] * np.eye(2)
        + by_across[:, None, None] * towards[:, :, None] * towards[:, None, :]
    )
    by_bearing[:, :, 2] = -(rate / square)[:, None] * towards
    powers = angle[:, None] ** (2.0 * np.arange(1, len(D) + 1) + 1.0)
    directions = towards / off[:, None]
    return Seen(
        scale[:, None] * towards, by_bearing, directions[:, :, None] * powers[:, None, :]
    )  # fmt: skip


def find_bearings(places: Array, D: Array) -> Array:
    """Return bearings (n,3) of places (n,2) in focal lengths from the centre; NaN where none is."""
    radius = np.hypot(places[:, 0], places[:, 1])
    most = widest(D)
    low, high = np.zeros_like(radius), np.full_like(radius, most)
    angle = np.minimum(radius, most)
    for _ in range(_STEPS):  # Newton's method, kept between bounds
        value, rate = _radius(angle, D)
        above = value > radius
        low, high = np.where(above, low, angle), np.where(above, angle, high)
        with np.errstate(all="ignore"):
            step = angle - (value - radius) / rate
        angle = np.where((step > low) & (step < high), step, 0.5 * (low + high))
    angle = np.where(radius < _radius(np.array([most]), D)[0], angle, np.nan)
    scale = np.sin(angle) / np.maximum(radius, _SMALL)
    return np.column_stack([scale[:, None] * places, np.cos(angle)])


EQUIDISTANT: LensLaw = sphere_law(project_bearings, find_bearings, 4)
