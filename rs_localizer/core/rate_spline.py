# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rotations of a camera whose body rate is a natural cubic spline through samples.

Between two samples the camera turns by ``exp(-theta)``, with Magnus' series up to its second term
(Blanes, Casas, Oteo, Ros, "The Magnus expansion and some of its applications", 2009):

    theta(h) = I + I x M / h,   I = integral of omega,   M = integral of (t - h/2) omega

Both are in closed form for a cubic. The axes are the camera's at each moment.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, Array3
from rs_localizer.core.blocks import write
from rs_localizer.core.so3 import coefficients
from rs_localizer.native import entry, kernel


@kernel
def rate_in(cubic: Array, since: float, rate: Array) -> None:
    for axis in range(3):
        rate[axis] = cubic[0, axis] + since * (
            cubic[1, axis] + since * (cubic[2, axis] + since * cubic[3, axis])
        )


@entry
def spline(times: Array1, values: Array2) -> Array:
    """Return the natural cubic spline (k-1,4,3) through values (k,3) at times (k,)."""
    count = len(times)
    # Second derivatives by Thomas' algorithm; zero at both ends.
    second = np.zeros((count, 3))
    upper = np.zeros(count)
    for i in range(1, count - 1):
        before, after = times[i] - times[i - 1], times[i + 1] - times[i]
        pivot = 2.0 * (before + after) - before * upper[i - 1]
        upper[i] = after / pivot
        for axis in range(3):
            slope = (values[i + 1, axis] - values[i, axis]) / after
            slope -= (values[i, axis] - values[i - 1, axis]) / before
            second[i, axis] = (6.0 * slope - before * second[i - 1, axis]) / pivot
    for i in range(count - 2, 0, -1):
        for axis in range(3):
            second[i, axis] -= upper[i] * second[i + 1, axis]
    cubics = np.empty((count - 1, 4, 3))
    for i in range(count - 1):
        step = times[i + 1] - times[i]
        for axis in range(3):
            here, there = second[i, axis], second[i + 1, axis]
            cubics[i, 0, axis] = values[i, axis]
            slope = (values[i + 1, axis] - values[i, axis]) / step
            cubics[i, 1, axis] = slope - step * (2.0 * here + there) / 6.0
            cubics[i, 2, axis] = 0.5 * here
            cubics[i, 3, axis] = (there - here) / (6.0 * step)
    return cubics


@kernel
def turn_in(cubic: Array, time: float) -> tuple[float, float, float]:
    """Return the rotation vector from the start of an interval to a time in it."""
    x, moment_x = _turn_about(cubic, time, 0)
    y, moment_y = _turn_about(cubic, time, 1)
    z, moment_z = _turn_about(cubic, time, 2)
    return (
        x + y * moment_z - z * moment_y,
        y + z * moment_x - x * moment_z,
        z + x * moment_y - y * moment_x,
    )


@kernel
def _turn_about(cubic: Array, time: float, axis: int) -> tuple[float, float]:
    """Return the integral of the rate, and its moment over the time, without a division."""
    a, b, c, d = cubic[0, axis], cubic[1, axis], cubic[2, axis], cubic[3, axis]
    whole = time * (a + time * (b / 2.0 + time * (c / 3.0 + time * d / 4.0)))
    return whole, time * time * ((b + time * c) / 12.0 + 0.075 * time * time * d)


@kernel
def turn_on(angle: tuple[float, float, float], rotation: Array, turned: Array) -> None:
    """Fill in ``exp(-angle) rotation`` (Rodrigues' formula)."""
    x, y, z = -angle[0], -angle[1], -angle[2]
    s, c, _ = coefficients(x * x + y * y + z * z)
    for k in range(3):
        u, v, w = rotation[0, k], rotation[1, k], rotation[2, k]
        turned[0, k] = (
            (1.0 - c * (y * y + z * z)) * u + (c * x * y - s * z) * v + (c * x * z + s * y) * w
        )
        turned[1, k] = (
            (c * x * y + s * z) * u + (1.0 - c * (x * x + z * z)) * v + (c * y * z - s * x) * w
        )
        turned[2, k] = (
            (c * x * z - s * y) * u + (c * y * z + s * x) * v + (1.0 - c * (x * x + y * y)) * w
        )


@kernel
def place_of(time: float, times: Array) -> int:
    """Return the interval of a time; the first or last one if the time lies outside."""
    place: int = 0
    while place < len(times) - 2 and times[place + 1] < time:
        place += 1
    return place


@entry
def rotations_at_knots(times: Array1, cubics: Array3) -> Array:
    """Return rotations (k,3,3), camera_then_from_camera_at_time_0, at the knots of the spline."""
    count = len(times)
    rotations = np.empty((count, 3, 3))
    write(rotations[0], np.eye(3))
    for i in range(count - 1):
        turn_on(turn_in(cubics[i], times[i + 1] - times[i]), rotations[i], rotations[i + 1])
    start, middle = place_of(0.0, times), np.empty((3, 3))
    turn_on(turn_in(cubics[start], -times[start]), rotations[start], middle)
    back = middle.T.copy()
    for i in range(count):
        write(rotations[i], multiplied(rotations[i], back))
    return rotations


@entry
def turns_at(
    wanted: Array1, times: Array1, cubics: Array3, rotations: Array3
) -> tuple[Array, Array]:
    """Return rotations (n,3,3) and rates (n,3) at times (n,) of a spline of rates."""
    turns, rates = np.empty((len(wanted), 3, 3)), np.empty((len(wanted), 3))
    for i in range(len(wanted)):
        place = place_of(wanted[i], times)
        since = wanted[i] - times[place]
        turn_on(turn_in(cubics[place], since), rotations[place], turns[i])
        rate_in(cubics[place], since, rates[i])
    return turns, rates


@kernel
def multiplied(left: Array, right: Array) -> Array:
    """Return the product of two (3,3) matrices."""
    product = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            product[i, j] = (
                left[i, 0] * right[0, j] + left[i, 1] * right[1, j] + left[i, 2] * right[2, j]
            )
    return product
