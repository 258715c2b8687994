# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A first lens, and its model, from images in which the camera hardly moves (Zhang 2000)."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from itertools import pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera, DistortionModel
from rs_localizer.tools.adjust.fit import fit
from rs_localizer.tools.adjust.intrinsics import lens_prior, lens_values
from rs_localizer.tools.adjust.observe import ImagePoints
from rs_localizer.tools.adjust.spline import spline_through
from rs_localizer.tools.adjust.variables import Freedom, SplineKeypoints, start_state

_MOST_IMAGES, _LEAST_IMAGES = 30, 4
# Least share of the points that the fullest image shows.
_LEAST_SHARE = 0.6
# Images with more than this many times the median's error have boards that a hand bends, or
# mistaken corners: those of public videos have four to seven times it, all others less than twice.
_ODD = 3.0
# Focal lengths by image width to begin with, before scenes that are no plane.
_FOCAL_LENGTHS = (0.35, 0.7, 1.0, 1.4)


_CELLS = 64  # along the longer side


def covered(size: tuple[int, int], images: Iterable[Array]) -> float:
    """Return the share of an image inside the hull of its pixels (n,2) in any of some images."""
    shape = np.maximum(np.ceil(_CELLS * np.array(size) / max(size)), 1.0).astype(int)
    mask = np.zeros(shape[::-1], np.uint8)
    for pixels in images:
        if len(pixels):
            cells = np.floor((pixels + 0.5) * shape / size).astype(np.int32)
            cv2.fillConvexPoly(mask, cv2.convexHull(cells), 1)
    return float(mask.mean())


class _Candidate(NamedTuple):
    model: DistortionModel
    numbers: int  # of the distortion
    flags: int  # of OpenCV's calibration


# Kinds of lenses in the order in which they are preferred: a later one is taken where it predicts
# images that it has not seen better by a tenth; less is what the choice of the images makes. Few
# images that look alike have lenses far off that fit them, unless the centre is held.
_CANDIDATES = (
    _Candidate(
        DistortionModel.PLUMB_BOB,
        5,
        cv2.CALIB_FIX_PRINCIPAL_POINT
        | cv2.CALIB_FIX_ASPECT_RATIO
        | cv2.CALIB_ZERO_TANGENT_DIST
        | cv2.CALIB_FIX_K3,
    ),
    _Candidate(DistortionModel.PLUMB_BOB, 5, cv2.CALIB_FIX_K3),
    _Candidate(DistortionModel.EQUIDISTANT, 4, 0),
    _Candidate(DistortionModel.RATIONAL_POLYNOMIAL, 8, cv2.CALIB_RATIONAL_MODEL),
)
_RICHER = 0.9
_LEAST_POINTS = 8
# Images of their own, and a lens of which nothing is known.
_ALONE = Freedom(
    readout_time=False, lens=True, lens_deviations=(10.0, 10.0), angular_velocity=1.0,
    linear_velocity=1.0,
)  # fmt: skip
_FLAT = 1e-6  # thickness of a plane by its size


def first_lens(size: tuple[int, int], images: list[ImagePoints]) -> Camera:
    """Return a lens of the simplest model that predicts unseen images as well as any.

    Args:
        size: width and height, pixels.
        images: in the order of their stamps.

    Raises:
        ValueError: when too few images show enough of the map, or show it from one side only.
    """
    chosen = _slow(images)
    if len(chosen) < _LEAST_IMAGES:
        raise ValueError(
            f"{len(chosen)} images show enough of the map for a first calibration, at least "
            f"{_LEAST_IMAGES} are needed; give --calibration"
        )
    fewest = max(_LEAST_IMAGES, len(chosen) // 2)
    while True:
        lens = _of_simplest_model(size, chosen)
        errors = np.array([reprojection_error(lens, image) for image in chosen])
        alike = np.flatnonzero(errors <= _ODD * np.median(errors))
        if not fewest <= len(alike) < len(chosen):
            return lens
        chosen = [chosen[k] for k in alike]


def _of_simplest_model(size: tuple[int, int], images: list[ImagePoints]) -> Camera:
    best, least = None, np.inf
    for candidate in _CANDIDATES:
        lens = _calibrated(size, images, candidate)
        if lens is not None and best is not None and (_folds(lens) or _cancels(lens, images)):
            continue
        error = np.inf if lens is None else _unseen_error(lens, images, candidate)
        if error < least:
            best, least = lens, _RICHER * error
    if best is None:
        raise ValueError("no lens fits the images; show the board from several sides")
    return best


def _unseen_error(lens: Camera, images: list[ImagePoints], candidate: _Candidate) -> float:
    """Return the error (px rms) of each half of the images under a lens of the other half."""
    halves = images[::2], images[1::2]
    squared, count = 0.0, 0
    for known, unseen in (halves, halves[::-1]):
        camera = _calibrated(lens.size, known, candidate, lens.K)
        if camera is None:
            return np.inf
        for image in unseen:
            squared += reprojection_error(camera, image) ** 2 * len(image.points)
            count += len(image.points)
    return float(np.sqrt(squared / count))


def reprojection_error(camera: Camera, image: ImagePoints) -> float:
    """Return the error (px rms of u and v) of the best global-shutter pose, or infinity."""
    pose = _pose(camera, image)
    if pose is None:
        return np.inf
    rotation, place = pose
    off = camera.project(image.points @ rotation.T + place) - image.pixels
    return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def _pose(camera: Camera, image: ImagePoints) -> tuple[Array, Array] | None:
    """Return rotation (3,3) and translation (3,) of the best pose; None for an infinite error."""
    rays = camera.rays(image.pixels)
    if not np.isfinite(rays).all():
        return None

    def errors(pose: Array) -> Array:
        # The fit is in pixels, not in rays: far from the middle they differ.
        local = image.points @ Rotation.from_rotvec(pose[:3]).as_matrix().T + pose[3:]
        return np.ravel(camera.project(local) - image.pixels)

    # With several walls in view the first method may end behind the camera, where no pixel is.
    for method in (cv2.SOLVEPNP_ITERATIVE, cv2.SOLVEPNP_SQPNP):
        solved, turn, place = cv2.solvePnP(image.points, rays, np.eye(3), None, flags=method)
        with suppress(ValueError):
            if solved:
                found = least_squares(errors, np.r_[turn.ravel(), place.ravel()], method="lm")
                if np.isfinite(found.fun).all():
                    return Rotation.from_rotvec(found.x[:3]).as_matrix(), found.x[3:]
    return None


def _fisheye(size: tuple[int, int], images: list[ImagePoints], K: Array) -> tuple[float, Camera]:
    """Return squared errors (px^2), and the equidistant lens near ``K`` (3,3) with them.

    OpenCV's own asks for boards that are flat, one to an image.

    Raises:
        ValueError: when no such lens fits.
    """
    lens = _equidistant(size, np.r_[K[0, 0], K[1, 1], K[0, 2], K[1, 2], np.zeros(4)])
    posed = [(image, pose) for image in images if (pose := _pose(lens, image)) is not None]
    found = [
        (image, (turn, place))
        for image, (turn, place) in posed
        if np.all(image.points @ turn[2] + place[2] > 0.0)
    ]
    if len(found) < max(_LEAST_IMAGES, len(images) // 2):
        raise ValueError("no poses by this focal length")
    counts, times = [len(image.points) for image, _ in found], np.arange(len(found), dtype=float)
    seen = SplineKeypoints(
        times=np.repeat(times, counts), row_times=np.zeros(sum(counts)),
        pixels=np.concatenate([image.pixels for image, _ in found]),
        landmarks=np.concatenate([image.points for image, _ in found]),
        points=np.arange(sum(counts)), frames=np.repeat(np.arange(len(found)), counts),
        trusted=np.ones(sum(counts), np.bool_),
    )  # fmt: skip
    rotations = np.array([rotation.T for _, (rotation, _) in found])
    centres = np.array([-rotation.T @ place for _, (rotation, place) in found])
    # Each image is a motion of its own.
    apart = [np.array([k]) for k in range(len(found))]
    spline = spline_through(apart, times, rotations, centres, 0.1, 0.05)
    fitted = fit(lens, seen, start_state(lens, seen, spline), _ALONE)
    return float(np.sum(fitted.squared_errors)) * len(images) / len(found), fitted.camera


def _equidistant(size: tuple[int, int], numbers: Array) -> Camera:
    """Return the lens of focal lengths, centre and distortion (8)."""
    K = np.array([[numbers[0], 0.0, numbers[2]], [0.0, numbers[1], numbers[3]], [0.0, 0.0, 1.0]])
    return Camera(*size, K=K, D=numbers[4:], distortion_model=DistortionModel.EQUIDISTANT)


def _calibrated(
    size: tuple[int, int],
    images: list[ImagePoints],
    candidate: _Candidate,
    start: Array | None = None,
) -> Camera | None:
    """Return the best lens of this kind, from ``start`` (3,3) or anywhere; None if none fits."""
    points = [np.asarray(image.points, np.float32)[:, None] for image in images]
    pixels = [np.asarray(image.pixels, np.float32)[:, None] for image in images]
    best: tuple[float, Any, Any] | None = None
    model = candidate.model
    everything = np.concatenate([image.points for image in images])
    near = [] if start is None else [(start.copy(), cv2.CALIB_USE_INTRINSIC_GUESS)]
    for K, flags in near or _starts(size, everything):
        try:
            if model == DistortionModel.EQUIDISTANT:
                error, lens = _fisheye(size, images, K)
                best = (error, lens.K, lens.D) if best is None or error < best[0] else best
                continue
            flags |= candidate.flags
            error, found, D, _, _ = cv2.calibrateCamera(
                points, pixels, size, K, np.zeros(candidate.numbers), flags=flags
            )
        except (cv2.error, ValueError, np.linalg.LinAlgError):
            continue
        if np.isfinite(error) and (best is None or error < best[0]):
            best = (error, found, D.ravel()[: candidate.numbers])
    if best is None:
        return None
    try:
        return Camera(width=size[0], height=size[1], K=best[1], D=best[2], distortion_model=model)
    except ValueError:  # numbers that no camera has
        return None


def _folds(lens: Camera) -> bool:
    """Return True if pixels of the image have no ray.

    A series that fits the middle of the image, where the board was shown, may turn back towards the
    rim.
    """
    if lens.distortion_model == DistortionModel.EQUIDISTANT:  # looks sideways there, and has none
        return False
    rim = np.array([(x, y) for x in (0.0, 0.5, 1.0) for y in (0.0, 0.5, 1.0)]) * lens.size
    return not np.isfinite(lens.rays(rim)).all()


def _cancels(lens: Camera, images: list[ImagePoints]) -> bool:
    """Return True if numbers beyond any lens's compensate each other where nothing holds them.

    Under the prior of lenses they cost more than all that the points can tell.
    """
    mean, information = lens_prior(lens, None)
    off = (lens_values(lens) - mean)[4:]
    equations = 2 * sum(len(image.points) for image in images)
    return bool(off @ information[4:, 4:] @ off > equations)


def _slow(images: list[ImagePoints]) -> list[ImagePoints]:
    """Return images, from all of the recording, that show much of the map and hardly move."""
    fullest = max((len(image.points) for image in images), default=0)
    least = max(_LEAST_SHARE * fullest, _LEAST_POINTS)
    full = [image for image in images if len(image.points) >= least]
    speeds = [_speed(a, b) for a, b in pairwise(full)]
    if not speeds:
        return full
    slower = [min(pair) for pair in zip([speeds[0], *speeds], [*speeds, speeds[-1]], strict=True)]
    # The slowest of each part of the recording.
    parts = np.array_split(np.arange(len(full)), min(_MOST_IMAGES, len(full)))
    return [full[min(part, key=lambda k: slower[k])] for part in parts]


def _speed(before: ImagePoints, after: ImagePoints) -> float:
    """Return the speed (px/s) of what both images show."""
    common = (before.points[:, None] == after.points[None]).all(axis=2)
    first, second = np.nonzero(common)
    if len(first) == 0:
        return np.inf
    displacement = np.linalg.norm(before.pixels[first] - after.pixels[second], axis=1)
    return float(np.median(displacement)) / max((after.stamp_ns - before.stamp_ns) * 1e-9, 1e-9)


def _starts(size: tuple[int, int], everything: Array) -> list[tuple[Array, int]]:
    spread = np.linalg.svd(everything - everything.mean(axis=0), compute_uv=False)
    centre = 0.5 * (np.array(size) - 1.0)
    starts = []
    for share in _FOCAL_LENGTHS:
        K = np.array([[0.0, 0.0, centre[0]], [0.0, 0.0, centre[1]], [0.0, 0.0, 1.0]])
        K[0, 0] = K[1, 1] = share * size[0]
        starts.append((K, cv2.CALIB_USE_INTRINSIC_GUESS))
    if spread[2] < _FLAT * spread[0] and np.ptp(everything[:, 2]) < _FLAT * spread[0]:
        starts.append((starts[0][0].copy(), 0))  # OpenCV finds its own before z = 0
    return starts
