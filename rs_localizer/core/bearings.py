# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Bearings of many pixels at once, by Newton's method on OpenCV's pinhole lenses.

OpenCV's fixed point takes tens of iterations to the same digits, and its derivatives come with a
dozen others: half a frame's time for what a few steps side by side do in microseconds. Pixels that
have no such bearing, and other lenses, are left to :meth:`Camera.rays_and_jacobian`.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, BoolArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.simd.tracing import LANES, Lanes, Vector, traced
from rs_localizer.native import entry, kernel

# k1 k2 p1 p2 k3, k4 k5 k6, s1 s2 s3 s4; those behind them tilt the sensor.
_COEFFICIENTS = 12
_STEPS = 10
# Squared distance, in focal lengths, from a pixel to where its bearing is seen: rounding errors.
_SAME = 1e-24
# Values that a step reads: the pixel's place and the bearing.
_PLACE = 4
# Values that a step writes: a better bearing, the derivatives and squared distance before it.
_RESULTS = 7


def bearings(camera: Camera, pixels: Array) -> tuple[Array, Array]:
    """Return rays and derivatives at raw pixels (n,2), as :meth:`Camera.rays_and_jacobian` does."""
    lens = pinhole(camera)
    if lens is None or len(pixels) == 0:
        return camera.rays_and_jacobian(pixels)
    rays, by_ray, lost = _bearings(pixels, *lens)
    if lost.any():
        rays[lost], by_ray[lost] = camera.rays_and_jacobian(pixels[lost])
    return rays, by_ray


def projected(camera: Camera, rays: Array) -> tuple[Array, Array]:
    """Return raw pixels (n,2) and derivatives at rays (n,2), as :meth:`Camera.distort` does."""
    lens = pinhole(camera)
    return camera.distort(rays) if lens is None else projected_by(rays, *lens)


@lru_cache(64)  # of the cameras of a rig, and lenses that are tried
def pinhole(camera: Camera) -> tuple[Array, Array, Array] | None:
    """Return focal lengths (2,), centre (2,) in delivered pixels, and coefficients (12,)."""
    D = camera.D
    if len(D) > 0 and (not camera.law.is_polynomial or np.any(D[_COEFFICIENTS:])):
        return None
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    x, y = camera.binning
    left, top = (0, 0) if camera.roi is None else (camera.roi.x_offset, camera.roi.y_offset)
    lens = np.zeros(_COEFFICIENTS)
    lens[: len(D)] = D[:_COEFFICIENTS]
    return np.array([fx / x, fy / y]), np.array([(cx - left) / x, (cy - top) / y]), lens


def _image(x: Lanes, y: Lanes, lens: Vector) -> Vector:
    """Return the image (2 values) of a bearing, focal lengths from the centre; derivatives (4)."""
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = lens
    square = x * x + y * y
    above = 1.0 + square * (k1 + square * (k2 + square * k3))
    below = 1.0 / (1.0 + square * (k4 + square * (k5 + square * k6)))
    radial = above * below
    # Derivatives by the square.
    above_rate = k1 + square * (2.0 * k2 + 3.0 * (square * k3))
    below_rate = k4 + square * (2.0 * k5 + 3.0 * (square * k6))
    rate = 2.0 * ((above_rate - radial * below_rate) * below)
    prism = [s1 + 2.0 * (square * s2), s3 + 2.0 * (square * s4)]
    both = x * y
    beside = rate * both + 2.0 * (p1 * x + p2 * y)
    across = x * radial + 2.0 * (p1 * both) + p2 * (square + 2.0 * (x * x))
    down = y * radial + p1 * (square + 2.0 * (y * y)) + 2.0 * (p2 * both)
    return [
        across + square * (s1 + square * s2),
        down + square * (s3 + square * s4),
        radial + rate * (x * x) + 2.0 * (p1 * y) + 6.0 * (p2 * x) + 2.0 * (x * prism[0]),
        beside + 2.0 * (y * prism[0]),
        beside + 2.0 * (x * prism[1]),
        radial + rate * (y * y) + 6.0 * (p1 * y) + 2.0 * (p2 * x) + 2.0 * (y * prism[1]),
    ]


def _step(values: list[Lanes]) -> Vector:
    """Return one step of Newton's method, and the derivatives (4) at its start."""
    u, v, x, y = values[:_PLACE]
    seen_x, seen_y, xx, xy, yx, yy = _image(x, y, values[_PLACE:])
    across, down = u - seen_x, v - seen_y
    scale = 1.0 / (xx * yy - xy * yx)
    nearer = [x + (yy * across - xy * down) * scale, y + (xx * down - yx * across) * scale]
    return [*nearer, xx, xy, yx, yy, across * across + down * down]


_image_lanes = traced(lambda values: _image(values[0], values[1], values[2:]), 2, _COEFFICIENTS)
_step_lanes = traced(_step, _PLACE, _COEFFICIENTS)


@kernel
def _uniform(lens: Array) -> Array:
    """Return the coefficients (12,), the same in all lanes."""
    uniform = np.empty(_COEFFICIENTS * LANES)
    for k in range(_COEFFICIENTS):
        for lane in range(LANES):
            uniform[k * LANES + lane] = lens[k]
    return uniform


@entry
def _bearings(
    pixels: Array2, focal: Array1, centre: Array1, lens: Array1
) -> tuple[Array, Array, BoolArray]:
    """Return bearings (n,2), derivatives (n,2,2) of pixels by bearings, and a mask of failures.

    Beyond the fold of a lens, where its image runs back, nothing is seen.
    """
    count = len(pixels)
    rays, by_ray = np.empty((count, 2)), np.empty((count, 2, 2))
    lost = np.empty(count, dtype=np.bool_)
    uniform, place = _uniform(lens), np.empty(_PLACE * LANES)
    steps = np.empty(_RESULTS * LANES)
    for first in range(0, count, LANES):
        for lane in range(LANES):
            i = min(first + lane, count - 1)
            for axis in range(2):
                start = (pixels[i, axis] - centre[axis]) / focal[axis]
                place[axis * LANES + lane] = start
                place[(2 + axis) * LANES + lane] = start
        for _ in range(_STEPS):
            _step_lanes(place, uniform, steps)
            farthest = 0.0
            for lane in range(LANES):
                farthest = max(farthest, steps[6 * LANES + lane])
            if farthest < _SAME:
                break
            for lane in range(LANES):
                # No bearing depends on how long its neighbours take.
                if not steps[6 * LANES + lane] < _SAME:
                    place[2 * LANES + lane] = steps[lane]
                    place[3 * LANES + lane] = steps[LANES + lane]
        for lane in range(min(LANES, count - first)):
            i = first + lane
            for axis in range(2):
                rays[i, axis] = place[(2 + axis) * LANES + lane]
                for by in range(2):
                    slope = steps[(2 + 2 * axis + by) * LANES + lane]
                    by_ray[i, axis, by] = focal[axis] * slope
            xx, xy, yx, yy = by_ray[i, 0, 0], by_ray[i, 0, 1], by_ray[i, 1, 0], by_ray[i, 1, 1]
            lost[i] = not (steps[6 * LANES + lane] < _SAME and xx > 0.0 and xx * yy > xy * yx)
    return rays, by_ray, lost


@entry
def projected_by(rays: Array2, focal: Array1, centre: Array1, lens: Array1) -> tuple[Array, Array]:
    """Return the pixels (n,2), and their derivatives (n,2,2) by the rays."""
    count = len(rays)
    pixels, by_ray = np.empty((count, 2)), np.empty((count, 2, 2))
    uniform, place, image = _uniform(lens), np.empty(2 * LANES), np.empty(6 * LANES)
    for first in range(0, count, LANES):
        for lane in range(LANES):
            for axis in range(2):
                place[axis * LANES + lane] = rays[min(first + lane, count - 1), axis]
        _image_lanes(place, uniform, image)
        for lane in range(min(LANES, count - first)):
            for axis in range(2):
                seen = image[axis * LANES + lane]
                pixels[first + lane, axis] = centre[axis] + focal[axis] * seen
                for by in range(2):
                    slope = image[(2 + 2 * axis + by) * LANES + lane]
                    by_ray[first + lane, axis, by] = focal[axis] * slope
    return pixels, by_ray
