# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Lens laws: where a bearing falls on the sensor, and back.

The laws of sensor_msgs/CameraInfo are here and in :mod:`rs_localizer.core.equidistant`;
:mod:`rs_localizer.core.eucm` and :mod:`rs_localizer.core.double_sphere` have Kalibr's names. A new
law is a file with its own :class:`LensLaw`, and a row in
:class:`rs_localizer.core.camera.DistortionModel`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array

# OpenCV's own default of five iterations leaves errors of pixels at the rim of wide lenses.
_CRITERIA = (3, 50, 1e-10)  # by count (1) and by tolerance (2)


class Projection(NamedTuple):
    """Pixels of the full sensor, and their derivatives."""

    pixels: Array  # (n,2)
    by_ray: Array  # (n,2,2)
    by_matrix: Array  # (n,2,4) fx, fy, cx, cy
    by_coefficients: Array  # (n,2,d)


class Seen(NamedTuple):
    """Places where bearings are seen, in focal lengths from the centre."""

    places: Array  # (n,2)
    by_bearing: Array  # (n,2,3)
    by_coefficients: Array  # (n,2,d)


class Sphere(NamedTuple):
    """How a lens sees bearings of any direction, also those behind the image plane."""

    project_bearings: Callable[[Array, Array], Seen]  # bearings (n,3), D
    find_bearings: Callable[[Array, Array], Array]  # places, D: bearings (n,3) of any length

    def project(self, bearings: Array, K: Array, D: Array) -> Projection:
        """Project bearings (n,3) in the place of rays; ``by_ray`` is (n,2,3)."""
        seen, focal = self.project_bearings(bearings, D), np.diag(K)[:2]
        by_matrix = np.zeros((len(bearings), 2, 4))
        for axis in range(2):
            by_matrix[:, axis, axis], by_matrix[:, axis, 2 + axis] = seen.places[:, axis], 1.0
        return Projection(
            seen.places * focal + K[:2, 2],
            seen.by_bearing * focal[:, None],
            by_matrix,
            seen.by_coefficients * focal[:, None],
        )


class LensLaw(NamedTuple):
    """How a lens bends bearings.

    ``project`` takes rays (n,2), the matrix K (3,3) and at least four coefficients D (d,);
    ``undistort`` pixels (n,2), K and D, and returns rays (n,2), any where there are none: a pixel
    that its ray does not lead back to counts as one without a bearing.
    """

    counts: tuple[int, ...]  # of coefficients that it may have; 0: all of them are zero
    # For each coefficient that calibration estimates, the lowest power of the radius by which it
    # moves points (0 for the lowest); None: it moves them along no radius. A single image may
    # correct those below the third power.
    orders: tuple[int | None, ...]
    project: Callable[[Array, Array, Array], Projection]
    undistort: Callable[[Array, Array, Array], Array]
    is_polynomial: bool = False  # OpenCV's pinhole polynomials, which core.bearings inverts
    sphere: Sphere | None = None  # of a lens that may see more than the half space before it
    # Between which each coefficient lies; None: anywhere. The coefficients of such a law act at all
    # powers of the radius at once: one of 1 moves the corner by its distance from the centre.
    limits: tuple[tuple[float, float], ...] | None = None

    def project_towards(self, towards: Array, K: Array, D: Array) -> Projection:
        """Project rays (n,2) or bearings (n,3); ``by_ray`` is (n,2,2) or (n,2,3)."""
        if towards.shape[1] == 2:
            return self.project(towards, K, D)
        assert self.sphere is not None  # who else has bearings
        return self.sphere.project(towards, K, D)

    @property
    def correctable(self) -> tuple[int | None, ...]:
        """The orders of the leading coefficients that a single image may correct."""
        third = next((k for k, order in enumerate(self.orders) if (order or 0) > 1), None)
        return self.orders[:third]


def _project(rays: Array, K: Array, D: Array) -> Projection:
    import cv2  # 16 MB, which a camera without distortion does not need

    # At depth 1 the derivative by the point's x and y equals the derivative by the ray.
    bearings, zero = np.column_stack([rays, np.ones(len(rays))])[:, None], np.zeros(3)
    projected: Any = cv2.projectPoints(bearings, zero, zero, K, D)
    pixels, jacobian = projected[:2]
    by = jacobian.reshape(len(rays), 2, -1)  # rotation, translation, focal lengths, centre, D
    return Projection(
        pixels.reshape(-1, 2), by[:, :, 3:5], by[:, :, 6:10], by[:, :, 10 : 10 + len(D)]
    )


def _undistort(pixels: Array, K: Array, D: Array) -> Array:
    import cv2

    points = pixels[:, None]
    rays: Any
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4
        rays = cv2.undistortPointsIter(points, K, D, None, None, _CRITERIA)
    else:
        rays = cv2.undistortPoints(points, K, D, criteria=_CRITERIA)
    return np.asarray(rays[:, 0], np.float64)


def onto_sensor(bearings: Array, below: Array, by_bearing: Array, by_coefficients: Array) -> Seen:
    """Divide ``x, y`` of bearings (n,3) by one number each.

    Args:
        below: (n,) the numbers.
        by_bearing, by_coefficients: (n,3) and (n,d), their derivatives.
    """
    places = bearings[:, :2] / below[:, None]
    shrink = -places[:, :, None] / below[:, None, None]
    seen = Seen(
        places, shrink * by_bearing[:, None, :], shrink * by_coefficients[:, None, :]
    )  # fmt: skip
    for axis in range(2):
        seen.by_bearing[:, axis, axis] += 1.0 / below
    return seen


def sphere_law(
    project_bearings: Callable[[Array, Array], Seen],
    find_bearings: Callable[[Array, Array], Array],
    coefficients: int,
    limits: tuple[tuple[float, float], ...] | None = None,
) -> LensLaw:
    """Return the law of a lens that sees bearings (n,3) of any direction.

    Args:
        project_bearings: of bearings and D.
        find_bearings: bearings of places (n,2), in focal lengths from the centre, and D.
        coefficients: how many it has; without any it is a pinhole where it has no limits.
        limits: of each.
    """
    sphere = Sphere(project_bearings, find_bearings)

    def project(rays: Array, K: Array, D: Array) -> Projection:
        projected = sphere.project(np.column_stack([rays, np.ones(len(rays))]), K, D)
        return projected._replace(by_ray=projected.by_ray[:, :, :2])

    def undistort(pixels: Array, K: Array, D: Array) -> Array:
        bearings = find_bearings((pixels - K[:2, 2]) / np.diag(K)[:2], D)
        ahead = np.where(bearings[:, 2:] > 0.0, bearings[:, 2:], np.nan)
        return np.asarray(bearings[:, :2] / ahead)

    # All coefficients act from the third power on: the lowest, and those that differ above it.
    counts = (0, coefficients) if limits is None else (coefficients,)
    orders = tuple(range(coefficients))
    return LensLaw(counts, orders, project, undistort, sphere=sphere, limits=limits)


PLUMB_BOB = LensLaw(  # k1 k2 p1 p2 k3
    (0, 4, 5), (0, 1, None, None, 2), _project, _undistort, is_polynomial=True
)
RATIONAL_POLYNOMIAL = LensLaw(  # k1 k2 p1 p2 k3, k4 k5 k6, s1 s2 s3 s4, tau_x tau_y
    (0, 8, 12, 14), (0, 1, None, None, 2, 0, 1, 2), _project, _undistort, is_polynomial=True
)
