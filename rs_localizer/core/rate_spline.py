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
from rs_localizer.core.so3 import exp, hat_of
from rs_localizer.native import entry, kernel


@entry
def spline(times: Array1, values: Array2) -> Array:
    """Return the natural cubic spline (k-1,4,3) through values (k,3) at times (k,)."""
    count = len(times)
    # Second derivatives by Thomas' algorithm; zero at both ends.
    second, upper = np.zeros((count, 3)), np.zeros(count)
    for i in range(1, count - 1):
        before, after = times[i] - times[i - 1], times[i + 1] - times[i]
        pivot = 2.0 * (before + after) - before * upper[i - 1]
        upper[i] = after / pivot
        bend = (values[i + 1] - values[i]) / after - (values[i] - values[i - 1]) / before
        second[i] = (6.0 * bend - before * second[i - 1]) / pivot
    for i in range(count - 2, 0, -1):
        second[i] -= upper[i] * second[i + 1]
    cubics = np.empty((count - 1, 4, 3))
    for i in range(count - 1):
        step, here, there = times[i + 1] - times[i], second[i], second[i + 1]
        cubics[i, 0] = values[i]
        cubics[i, 1] = (values[i + 1] - values[i]) / step - step * (2.0 * here + there) / 6.0
        cubics[i, 2] = 0.5 * here
        cubics[i, 3] = (there - here) / (6.0 * step)
    return cubics


@kernel
def turned(cubic: Array, time: float, rotation: Array) -> Array:
    """Return a rotation (3,3) at the start of an interval turned on to a time in it."""
    a, b, c, d = cubic[0], cubic[1], cubic[2], cubic[3]
    whole = time * (a + time * (b / 2.0 + time * (c / 3.0 + time * d / 4.0)))
    moment = time * time * ((b + time * c) / 12.0 + 0.075 * time * time * d)
    return exp(-whole - hat_of(whole) @ moment) @ rotation


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
    rotations = np.empty((len(times), 3, 3))
    rotations[0] = np.eye(3)
    for i in range(len(cubics)):
        rotations[i + 1] = turned(cubics[i], times[i + 1] - times[i], rotations[i])
    start = place_of(0.0, times)
    back = turned(cubics[start], -times[start], rotations[start]).T.copy()
    for i in range(len(times)):
        rotations[i] = rotations[i] @ back
    return rotations


@entry
def turns_at(
    wanted: Array1, times: Array1, cubics: Array3, rotations: Array3
) -> tuple[Array, Array]:
    """Return rotations (n,3,3) and rates (n,3) at times (n,) of a spline of rates."""
    turns, rates = np.empty((len(wanted), 3, 3)), np.empty((len(wanted), 3))
    for i in range(len(wanted)):
        place = place_of(wanted[i], times)
        since, cubic = wanted[i] - times[place], cubics[place]
        turns[i] = turned(cubic, since, rotations[place])
        rates[i] = cubic[0] + since * (cubic[1] + since * (cubic[2] + since * cubic[3]))
    return turns, rates
