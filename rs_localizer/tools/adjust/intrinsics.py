# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Intrinsics and distortion as numbers that an estimator may change: derivatives, prior, errors."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera

# Prior of a lens that nobody has calibrated, as standard deviations. The focal length is relative
# to its first guess. The centre is relative to the image's width: a lens is decentred by less, a
# crop of the sensor may be by more. The focal lengths are relative to each other: pixels are square
# up to the rounding of scaled videos, and before a camera that never rolls a stretched board looks
# the same. Coefficients are by their effect at the farthest corner, in half diagonals. Distortion
# is a series that converges: each order has about a third of the effect of the one before, a
# tangential one 0.3 %.
_FOCAL_LENGTH, _CENTRE, _ASPECT = 0.3, 0.05, 0.002
_ORDERS, _TANGENTIAL = (0.1, 0.03, 0.01, 0.003), 0.003
_WIDEST = np.tan(np.radians(70.0))  # corners are not looked at beyond: no pinhole has any there
_GRID = 9  # points along each side of the image, of an error that is averaged over it


class LensErrors(NamedTuple):
    """Standard deviations of a calibration, as parts of the error that do not overlap."""

    principal_point: float  # px, of all of the image alike
    focal_length: float  # share
    distortion: float  # px at the corners, of what is none of the others
    aspect_ratio: float  # share, of fy over fx


class Projected(NamedTuple):
    """Raw pixels of camera points and their derivatives."""

    pixels: Array  # (n,2)
    by_ray: Array  # (n,2,2)
    by_lens: Array  # (n,2,m)


def lens_values(camera: Camera) -> Array:
    """Return the numbers (m,) of a camera's lens: fx, fy, cx, cy, distortion (zeros if none)."""
    D = camera.D
    if len(D) == 0:
        D = np.zeros(len(camera.law.orders))
    K = camera.K
    return np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2], *D])


def with_lens(camera: Camera, values: Array) -> Camera:
    """Return the camera with these numbers.

    Raises:
        ValueError: for numbers that no camera has.
    """
    fx, fy, cx, cy, *D = (float(value) for value in values)
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return replace(camera, K=K, D=np.array(D))


def project(camera: Camera, values: Array, points: Array, free: bool) -> Projected:
    """Project points (n,3) before the camera through a lens of these numbers (m,).

    Without ``free`` the derivatives by the lens are left out.
    """
    K = np.array([[values[0], 0.0, values[2]], [0.0, values[1], values[3]], [0.0, 0.0, 1.0]])
    rays, D = (points / points[:, 2:])[:, :2], np.ascontiguousarray(values[4:])
    sensor, by_ray, by_matrix, by_coefficients = camera.law.project(rays, K, D)
    binning = np.array(camera.binning, float)
    offset = np.zeros(2) if camera.roi is None else (camera.roi.x_offset, camera.roi.y_offset)
    by_lens = np.concatenate([by_matrix, by_coefficients], axis=2) if free else by_matrix[:, :, :0]
    steps = binning[:, None]
    return Projected((sensor - offset) / binning, by_ray / steps, by_lens / steps)


def lens_prior(camera: Camera, deviations: tuple[float, float] | None) -> tuple[Array, Array]:
    """Return the mean (m,) and information (m,m) of a lens whose numbers are estimated.

    Args:
        camera: a given lens, or a first guess of an unknown one.
        deviations: of a given one, of focal lengths and centre by focal length, and of distortion;
            None: it is unknown.
    """
    values = lens_values(camera)
    focal = float(values[:2].mean())
    spread = np.empty(len(values))
    if deviations is not None:
        spread[:4], spread[4:] = deviations[0] * focal, deviations[1]
        return values, np.diag(spread**-2.0)
    width, height = camera.size
    mean = values.copy()
    mean[2:] = 0.0
    mean[2:4] = 0.5 * (width - 1.0), 0.5 * (height - 1.0)
    spread[:2], spread[2:4] = _FOCAL_LENGTH * focal, _CENTRE * max(width, height)
    corner = np.array([[0.5 * width / values[0], 0.5 * height / values[1], 1.0]])
    corner[0, :2] *= min(1.0, _WIDEST / float(np.linalg.norm(corner[0, :2])))
    plain = np.concatenate([mean[:4], np.zeros(len(values) - 4)])
    moves = np.linalg.norm(project(camera, plain, corner, True).by_lens[0], axis=0)[4:]
    orders = [*camera.law.orders, *[None] * len(moves)][: len(moves)]
    shares = [_TANGENTIAL if order is None else _ORDERS[order] for order in orders]
    spread[4:] = np.array(shares) * 0.5 * np.hypot(width, height) / moves
    information = np.diag(spread**-2.0)
    square = np.array([1.0, -1.0]) / (_ASPECT * focal)
    information[:2, :2] += np.outer(square, square)
    return mean, information


def lens_errors(camera: Camera, covariance: Array) -> LensErrors:
    """Return the errors of pixels by a covariance (m,m) of a camera's lens numbers."""
    rays, design = _field(camera)
    by_lens = project(camera, lens_values(camera), rays, True).by_lens
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return _parts(design, (by_lens @ root).reshape(2 * len(rays), -1))


def lens_difference(camera: Camera, other: Camera) -> LensErrors:
    """Return the difference of another lens from this one."""
    rays, design = _field(camera)
    off = project(other, lens_values(other), rays, False).pixels
    off -= project(camera, lens_values(camera), rays, False).pixels
    return _parts(design, off.reshape(-1, 1))


def _field(camera: Camera) -> tuple[Array, Array]:
    """Return rays (n,3) through the image, and moves (2 n,4) that an error may be taken for.

    The corners come first; two shifts, a scale and a squeeze are what an error of the lens may be
    taken for.
    """
    width, height = camera.size
    u, v = np.meshgrid(np.linspace(0.0, width - 1.0, _GRID), np.linspace(0.0, height - 1.0, _GRID))
    corners = np.array([[0.0, 0.0], [width - 1, 0.0], [0.0, height - 1], [width - 1, height - 1]])
    pixels = np.concatenate([corners, np.column_stack([u.ravel(), v.ravel()])])
    rays = np.column_stack([camera.rays(pixels), np.ones(len(pixels))])
    usable = np.isfinite(rays).all(axis=1)
    design = np.zeros((len(pixels), 2, 4))
    design[:, 0, 0] = design[:, 1, 1] = 1.0
    design[:, :, 2] = pixels - lens_values(camera)[2:4]
    design[:, :, 3] = design[:, :, 2] * [-0.5, 0.5]
    return rays[usable], design[usable].reshape(-1, 4)


def _parts(design: Array, moved: Array) -> LensErrors:
    """Split displacements (2 n, k) of pixels, k of them independent, into their parts."""
    numbers = np.linalg.lstsq(design, moved, rcond=None)[0]
    rest = (moved - design @ numbers)[:8]  # the corners
    size = np.sqrt(np.sum(numbers**2, axis=1))
    centre, corners = (
        np.hypot(size[0], size[1]) / np.sqrt(2.0),
        np.sqrt(np.mean(np.sum(rest**2, 1))),
    )
    return LensErrors(float(centre), float(size[2]), float(corners), float(size[3]))
