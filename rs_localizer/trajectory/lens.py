"""Intrinsics and distortion as numbers that an estimator may change, with derivatives."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera, DistortionModel

# Columns of OpenCV's Jacobians: focal lengths and centre, distortion, place of the point.
_PINHOLE = (slice(6, 10), 10, slice(3, 5))
_FISHEYE = (slice(0, 4), 4, slice(11, 13))
# What a lens without coefficients is given when its distortion is to be found.
_COEFFICIENTS = {DistortionModel.PLUMB_BOB: 5, DistortionModel.RATIONAL_POLYNOMIAL: 8}


class Projected(NamedTuple):
    """Raw pixels of camera points and their derivatives."""

    pixels: Array  # (n,2)
    by_ray: Array  # (n,2,2)
    by_lens: Array  # (n,2,m)


def lens_values(camera: Camera) -> Array:
    """The numbers (m,) of a camera's lens: fx, fy, cx, cy, distortion (zeros where it has none)."""
    D = camera.D
    if len(D) == 0:
        D = np.zeros(_COEFFICIENTS.get(DistortionModel(camera.distortion_model), 4))
    K = camera.K
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *D])


def with_lens(camera: Camera, values: Array) -> Camera:
    """The camera with these numbers.

    Raises:
        ValueError: for numbers that no camera has.
    """
    fx, fy, cx, cy, *D = (float(value) for value in values)
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return replace(camera, K=K, D=np.array(D))


def project(camera: Camera, values: Array, points: Array, free: bool) -> Projected:
    """Raw pixels of points (n,3) before the camera, seen through a lens of these numbers (m,).

    Without ``free`` the derivatives by the lens are left out.
    """
    bearings = np.ascontiguousarray(points / points[:, 2:])[:, None]
    K = np.array([[values[0], 0.0, values[2]], [0.0, values[1], values[3]], [0.0, 0.0, 1.0]])
    zero, D = np.zeros(3), np.ascontiguousarray(values[4:])
    found: Any
    if camera.distortion_model == DistortionModel.EQUIDISTANT:
        pinhole, first, ray = _FISHEYE
        found = cv2.fisheye.projectPoints(bearings, zero, zero, K, D)
    else:
        pinhole, first, ray = _PINHOLE
        found = cv2.projectPoints(bearings, zero, zero, K, D)
    sensor, jacobian = found[:2]
    binning = np.array(camera.binning, float)
    offset = np.zeros(2) if camera.roi is None else (camera.roi.x_offset, camera.roi.y_offset)
    jacobian = jacobian.reshape(len(points), 2, -1)
    by_ray = jacobian[:, :, ray] / binning[:, None]
    columns = [*range(*pinhole.indices(first)), *range(first, first + len(D))] if free else []
    by_lens = jacobian[:, :, columns] / binning[:, None]
    return Projected((sensor.reshape(-1, 2) - offset) / binning, by_ray, by_lens)
