# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A first lens, and its model, from images in which the camera hardly moves (Zhang 2000)."""

from itertools import pairwise

import cv2
import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera, DistortionModel
from rs_localizer.tools.adjust.observe import ImagePoints

_MOST_IMAGES, _LEAST_IMAGES = 30, 4
# Least share of the points that the fullest image shows, and least number of them.
_LEAST_SHARE, _LEAST_POINTS = 0.6, 8
# Images with more than this many times the median's error have boards that a hand bends, or
# mistaken corners: those of public videos have four to seven times it, all others less than twice.
_ODD = 3.0
# Focal lengths by image width to begin with.
_FOCAL_LENGTHS = (0.35, 0.7, 1.0, 1.4)
# Kinds of lenses and flags of OpenCV's calibration, in the order in which they are preferred: a
# later one is taken where it leaves a tenth less; less is what the choice of the images makes. Few
# images that look alike have lenses far off that fit them, unless the centre is held.
_KINDS = (
    (
        DistortionModel.PLUMB_BOB,
        cv2.CALIB_FIX_PRINCIPAL_POINT
        | cv2.CALIB_FIX_ASPECT_RATIO
        | cv2.CALIB_ZERO_TANGENT_DIST
        | cv2.CALIB_FIX_K3,
    ),
    (DistortionModel.PLUMB_BOB, cv2.CALIB_FIX_K3),
    (DistortionModel.EQUIDISTANT, 0),
)
_RICHER = 0.9
_FISHEYE_FLAGS = sum(  # which OpenCV 5 has moved
    int(getattr(cv2.fisheye, name, getattr(cv2, name, 0)))
    for name in ("CALIB_USE_INTRINSIC_GUESS", "CALIB_RECOMPUTE_EXTRINSIC", "CALIB_FIX_SKEW")
)
# Least angle (rad) from the axis to a corner of a fisheye: numbers of a narrower one compensate
# each other, and the other kinds describe it as well.
_FISHEYE = 1.0


def first_lens(size: tuple[int, int], images: list[ImagePoints]) -> Camera:
    """Return a lens of the simplest model that fits images about as well as any.

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
            f"{_LEAST_IMAGES} are needed; film it closer, or give its lens"
        )
    fewest = max(_LEAST_IMAGES, len(chosen) // 2)
    while True:
        best, least, errors = None, np.inf, np.zeros(0)
        for model, flags in _KINDS:
            found = _calibrated(size, chosen, model, flags)
            if found is None or (best is not None and not _likely(found[0])):
                continue
            error = float(np.sqrt(np.mean(found[1] ** 2)))
            if error < least:
                (best, errors), least = found, _RICHER * error
        if best is None:
            raise ValueError("no lens fits the images; show the board from several sides")
        alike = np.flatnonzero(errors <= _ODD * np.median(errors))
        if not fewest <= len(alike) < len(chosen):
            return best
        chosen = [chosen[k] for k in alike]


def _calibrated(
    size: tuple[int, int], images: list[ImagePoints], model: DistortionModel, flags: int
) -> tuple[Camera, Array] | None:
    """Return OpenCV's best lens of this kind, and the errors of the images (px rms of u and v)."""
    points = [np.asarray(image.points, np.float32)[None] for image in images]
    pixels = [np.asarray(image.pixels, np.float32)[None] for image in images]
    best: tuple[Camera, Array] | None = None
    for share in _FOCAL_LENGTHS:
        K = np.diag([share * size[0], share * size[0], 1.0])
        K[:2, 2] = 0.5 * (np.array(size) - 1.0)
        try:
            if model == DistortionModel.EQUIDISTANT:
                _, K, D, turns, places = cv2.fisheye.calibrate(
                    points, pixels, size, K, np.zeros((4, 1)), flags=_FISHEYE_FLAGS
                )
            else:
                flags |= cv2.CALIB_USE_INTRINSIC_GUESS
                _, K, D, turns, places = cv2.calibrateCamera(
                    points, pixels, size, K, np.zeros(5), flags=flags
                )
            lens = Camera(*size, K=K, D=D.ravel(), distortion_model=model)
        except (cv2.error, ValueError):  # numbers that no camera has
            continue
        squares = []
        for image, turn, place in zip(images, turns, places, strict=True):
            local = image.points @ cv2.Rodrigues(turn)[0].T + place.ravel()
            squares.append(np.mean(np.sum((lens.project(local) - image.pixels) ** 2, axis=1)))
        errors, total = np.sqrt(squares), np.sum(squares)
        if np.isfinite(total) and (best is None or total < np.sum(best[1] ** 2)):
            best = lens, errors
    return best


def _likely(lens: Camera) -> bool:
    """Return True if a fisheye is wide, and all pixels of another lens have a ray.

    A series that fits the middle of the image, where the board was shown, may turn back towards the
    rim.
    """
    if lens.distortion_model == DistortionModel.EQUIDISTANT:
        return bool(0.5 * np.hypot(*lens.size) > _FISHEYE * lens.focal_length)
    rim = np.array([(x, y) for x in (0.0, 0.5, 1.0) for y in (0.0, 0.5, 1.0)]) * lens.size
    return bool(np.isfinite(lens.rays(rim)).all())


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
