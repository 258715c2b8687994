# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of a calibration: distortion, focal lengths, centre.

Most errors of a calibration are radial: an image point at ``r`` from the axis moves along the
radius by ``r (a r^2 + b r^4)``. A small part is tangential, ``c`` and ``d`` (Brown, "Close-range
camera calibration", 1971); lenses with powers of the angle have no tangential part. The lens law
names the coefficients. Distances, also of the centre, are in units of the distance of the image's
corner, and errors of focal lengths are relative. So the coefficients of all cameras have one size.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera, DistortionModel
from rs_localizer.core.lens_laws import LensLaw

# No model has fewer coefficients; k1, k2 stand first in all, and p1, p2 behind them.
_FEWEST = 4
_OF_MATRIX = 4  # focal lengths and centre
# Of width and height: the centre of a phone is off by 0.01, the one of a real lens whose
# calibration failed by 0.18, and a K of 1920 x 1080 on an image of 1280 x 720 by 0.25.
_MOST_DECENTRED = 0.15
# What is the same for all frames of a camera; of the cameras of a rig, and lenses that are tried.
_remembered = lru_cache(64)


@_remembered
def corner_of(camera: Camera) -> float:
    """Return the distance of the image's corners from its middle, in focal lengths.

    If the axis lies outside the delivered region, the farthest corner from the axis counts.
    """
    roi, K = camera.roi, camera.K
    if roi is None:
        return float(0.5 * np.hypot(*camera.size) / camera.focal_length)
    across = np.array([roi.x_offset, roi.x_offset + roi.width]) - K[0, 2]
    down = np.array([roi.y_offset, roi.y_offset + roi.height]) - K[1, 2]
    return float(np.hypot(np.abs(across).max() / K[0, 0], np.abs(down).max() / K[1, 1]))


def centre_of(camera: Camera) -> Array:
    """Return the principal point (2,), in delivered pixels."""
    roi = camera.roi
    origin = (0.0, 0.0) if roi is None else (roi.x_offset, roi.y_offset)
    centre: Array = (camera.K[:2, 2] - origin) / camera.binning
    return centre


@_remembered
def off_centre(camera: Camera) -> bool:
    """Return whether the principal point is where no lens has it, but a K of another image has.

    Lenses are decentred by some 5 % of the image; regions of interest have theirs anywhere.
    """
    away = centre_of(camera) / camera.size - 0.5
    return camera.roi is None and bool(np.any(np.abs(away) > _MOST_DECENTRED))


@_remembered
def coefficients_of(camera: Camera) -> int:
    """Return the number of coefficients that may be in error."""
    return _distorting(camera) + _OF_MATRIX


def with_lens(camera: Camera, coefficients: Array) -> Camera:
    """Return the camera with coefficients (k,) added to its own; the last ones may be left out."""
    distortion, K = _distortion_of(camera), camera.K.copy()
    changes = np.zeros(coefficients_of(camera))
    changes[: len(coefficients)] = coefficients
    changes *= _scales_of(camera)
    count = _distorting(camera)
    distortion[:count] += changes[:count]
    if (limits := _law_of(camera).limits) is not None:
        distortion = np.clip(distortion, *np.transpose(limits))
    K[(0, 1, 0, 1), (0, 1, 2, 2)] += changes[count:]
    return replace(camera, K=K, D=distortion, distortion_model=_model_of(camera))


def by_lens(camera: Camera, towards: Array) -> Array:
    """Return derivatives (n,2,k) of the pixels of rays (n,2) or bearings (n,3) by coefficients."""
    projected = _law_of(camera).project_towards(towards, camera.K, _distortion_of(camera))
    correctable = projected.by_coefficients[:, :, : _distorting(camera)]
    columns = np.concatenate([correctable, projected.by_matrix], axis=2)
    scaled: Array = columns * _scales_of(camera) / np.array(camera.binning)[:, None]
    return scaled


@_remembered
def _distorting(camera: Camera) -> int:
    return len(_law_of(camera).correctable)


@_remembered
def _law_of(camera: Camera) -> LensLaw:
    return DistortionModel(_model_of(camera)).law


def _model_of(camera: Camera) -> str:
    """Return the model whose coefficients may be in error; a camera without any is a pinhole."""
    return camera.distortion_model if len(camera.D) else DistortionModel.PLUMB_BOB


def _distortion_of(camera: Camera) -> Array:
    return camera.D.copy() if len(camera.D) else np.zeros(_FEWEST)


@_remembered
def _scales_of(camera: Camera) -> Array:
    """Return the change of OpenCV's parameters per unit of each coefficient (k,)."""
    corner = corner_of(camera)
    focal = np.diag(camera.K)[:2]
    law = _law_of(camera)
    if law.limits is not None:
        edge = np.array([[corner, 0.0]])
        outwards = law.project(edge, camera.K, camera.D).by_coefficients[0, 0] / focal[0]
        moves = np.divide(corner, outwards, out=np.zeros_like(outwards), where=outwards != 0.0)
        return np.concatenate([moves, focal, corner * focal])
    powers = [1.0 if order is None else 2.0 * (order + 1) for order in _law_of(camera).correctable]
    return np.concatenate([corner ** -np.array(powers), focal, corner * focal])
