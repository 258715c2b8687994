# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Lens laws: where a bearing falls on the sensor, and back. The three of sensor_msgs/CameraInfo.

A new law is a file with its own :class:`LensLaw`, and a row in
:class:`rs_localizer.core.camera.DistortionModel`; all else reads what stands here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np

from rs_localizer.core.arrays import Array

# OpenCV's own default of five iterations leaves errors of pixels at the rim of wide lenses.
_CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-10)


class Projection(NamedTuple):
    """Pixels of the full sensor, and their derivatives."""

    pixels: Array  # (n,2)
    by_ray: Array  # (n,2,2)
    by_matrix: Array  # (n,2,4) fx, fy, cx, cy
    by_coefficients: Array  # (n,2,d)


class LensLaw(NamedTuple):
    """How a lens bends bearings.

    ``project`` takes rays (n,2), the matrix K (3,3) and at least four coefficients D (d,);
    ``undistort`` pixels (n,2), K and D, and returns rays (n,2), any where there are none: a pixel
    that its ray does not lead back to counts as one without a bearing.
    """

    counts: tuple[int, ...]  # of coefficients that it may have; 0: the lens is a pinhole
    # Of each coefficient that calibration estimates: which power of the radius it moves points by,
    # 0 for the lowest; None: it moves them along no radius. A single image may correct those that
    # stand before the third power.
    orders: tuple[int | None, ...]
    project: Callable[[Array, Array, Array], Projection]
    undistort: Callable[[Array, Array, Array], Array]
    is_polynomial: bool = False  # OpenCV's pinhole polynomials, which core.bearings inverts

    @property
    def correctable(self) -> tuple[int | None, ...]:
        """The orders of the leading coefficients that a single image may correct."""
        third = next((k for k, order in enumerate(self.orders) if (order or 0) > 1), None)
        return self.orders[:third]


def _project(rays: Array, K: Array, D: Array) -> Projection:
    # Of a point at depth 1 the derivative by its place is that by the ray.
    bearings, zero = np.column_stack([rays, np.ones(len(rays))])[:, None], np.zeros(3)
    projected: Any = cv2.projectPoints(bearings, zero, zero, K, D)
    pixels, jacobian = projected[:2]
    by = jacobian.reshape(len(rays), 2, -1)  # rotation, translation, focal lengths, centre, D
    return Projection(
        pixels.reshape(-1, 2), by[:, :, 3:5], by[:, :, 6:10], by[:, :, 10 : 10 + len(D)]
    )


def _project_fisheye(rays: Array, K: Array, D: Array) -> Projection:
    bearings, zero = np.column_stack([rays, np.ones(len(rays))])[:, None], np.zeros(3)
    projected: Any = cv2.fisheye.projectPoints(bearings, zero, zero, K, D)
    pixels, jacobian = projected[:2]
    by = jacobian.reshape(len(rays), 2, -1)  # focal lengths, centre, D, rotation, translation
    return Projection(pixels.reshape(-1, 2), by[:, :, 11:13], by[:, :, :4], by[:, :, 4:8])


def _undistort(pixels: Array, K: Array, D: Array) -> Array:
    points = pixels[:, None]
    rays: Any
    if hasattr(cv2, "undistortPointsIter"):  # OpenCV 4
        rays = cv2.undistortPointsIter(points, K, D, None, None, _CRITERIA)
    else:
        rays = cv2.undistortPoints(points, K, D, criteria=_CRITERIA)
    return np.asarray(rays[:, 0], np.float64)


def _undistort_fisheye(pixels: Array, K: Array, D: Array) -> Array:
    rays: Any = cv2.fisheye.undistortPoints(pixels[:, None], K, D, criteria=_CRITERIA)
    return np.asarray(rays[:, 0], np.float64)


PLUMB_BOB = LensLaw(  # k1 k2 p1 p2 k3
    (0, 4, 5), (0, 1, None, None, 2), _project, _undistort, is_polynomial=True
)
RATIONAL_POLYNOMIAL = LensLaw(  # k1 k2 p1 p2 k3, k4 k5 k6, s1 s2 s3 s4, tau_x tau_y
    (0, 8, 12, 14), (0, 1, None, None, 2, 0, 1, 2), _project, _undistort, is_polynomial=True
)
EQUIDISTANT = LensLaw((0, 4), (0, 1, 2, 3), _project_fisheye, _undistort_fisheye)  # k1 k2 k3 k4
