# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What a viewer draws of a localized frame, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import project_rolling
from rs_localizer.io.outputs import Localized

Colours = NDArray[np.uint8]

# 95 % of the chi-square distribution with three degrees of freedom.
_WITHIN = np.sqrt(7.8147)
# The first row is blue, the last one yellow: both are seen on gray images, by everybody.
_FIRST, _LAST = np.array([0.0, 114.0, 255.0]), np.array([255.0, 220.0, 0.0])
# px that a typical residual is to be drawn at most, and by which factors.
_SEEN, _STEPS = 15.0, (1, 2, 5, 10, 20, 50, 100, 200, 500)
_INSTANTS = np.linspace(-0.5, 0.5, 9)


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoid:
    """Where a position lies with a probability of 95 %."""

    half_sizes: Array  # (3,) m, ascending
    quaternion: Array  # (4,) x y z w, of its axes in the map


def ellipsoid(covariance: Array) -> Ellipsoid:
    """Of the covariance (3,3) of a position, m^2."""
    values, axes = np.linalg.eigh(covariance)
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] *= -1.0
    half_sizes = _WITHIN * np.sqrt(np.maximum(values, 0.0))
    return Ellipsoid(half_sizes, so3.quaternion(np.ascontiguousarray(axes)))


@dataclass(frozen=True, slots=True, eq=False)
class Reprojection:
    """The inliers of a frame, and where its motion sees them, each at the time of its row."""

    points: Array  # (k,3) m, map
    pixels: Array  # (k,2) raw, as they were matched
    predicted: Array  # (k,2) raw
    colours: Colours  # (k,3) by the row: from blue, the first one, to yellow


def reproject(frame: Localized, camera: Camera) -> Reprojection:
    """Project the inliers through the shutter that the frame was localized with."""
    points, pixels = columns(frame, "xyz"), columns(frame, "uv")
    predicted, tau = project_rolling(camera, frame.estimate.at_rows, points)
    seen = np.isfinite(tau)
    return Reprojection(points[seen], pixels[seen], predicted[seen], row_colours(tau[seen]))


def enlargement(frames: Sequence[Localized]) -> int:
    """How much longer residuals are drawn so that one can see them: 1, 2, 5, 10, ..."""
    rms = [f.estimate.residual_rms for f in frames if f.estimate.inliers.any()]
    wanted = _SEEN / max(float(np.median(rms)), 1e-3) if rms else 1.0
    return max(step for step in _STEPS if step <= max(wanted, 1.0))


def row_colours(tau: Array) -> Colours:
    """Colours (k,3) of row times (k,), from -0.5 to 0.5."""
    share = np.clip(np.asarray(tau) + 0.5, 0.0, 1.0)[:, None]
    colours: Colours = np.round((1.0 - share) * _FIRST + share * _LAST).astype(np.uint8)
    return colours


def readout_path(frame: Localized) -> Array:
    """Camera centres (9,3) in the map, from the first row to the last."""
    rotations, translations = frame.estimate.at_rows(_INSTANTS)
    centres: Array = -np.einsum("nji,nj->ni", rotations, translations)
    return centres


@dataclass(frozen=True, slots=True, eq=False)
class Eye:
    """From where a viewer looks at the scene."""

    position: Array  # (3,) m, map
    target: Array  # (3,) m
    up: Array  # (3,)
    depth: float  # m from the camera to its points, by which things are drawn large or small


def eye(frames: Sequence[Localized]) -> Eye:
    """Behind the camera of the middle frame and above it, looking at what it sees.

    Args:
        frames: one or more.
    """
    frame = next((it for it in frames[len(frames) // 2 :] if len(it.inliers)), frames[0])
    rotation, translation = frame.estimate.at(0.0)
    centre = -rotation.T @ translation
    right, down, ahead = rotation
    points = columns(frame, "xyz") if len(frame.inliers) else centre + ahead[None]
    target = np.median(points, axis=0)
    depth = float(np.linalg.norm(target - centre))
    position = centre + depth * (0.6 * right - 0.5 * down - 0.7 * ahead)
    return Eye(position, 0.5 * (target + centre), -down, depth)


def columns(frame: Localized, names: str) -> Array:
    """Fields (k, len(names)) of the inliers."""
    return np.stack([frame.inliers[name].astype(np.float64) for name in names], axis=1)


def others(pixels: Array, frame: Localized | None) -> Array:
    """The pixels (m,2) of an image that are no inliers of its frame."""
    if frame is None or len(frame.inliers) == 0:
        return pixels
    kept = {tuple(pixel) for pixel in columns(frame, "uv").tolist()}
    out = [tuple(pixel) not in kept for pixel in pixels.tolist()]
    rest: Array = pixels[np.array(out, np.bool_)]
    return rest
