# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The direction of gravity from an accelerometer.

An accelerometer measures the specific force: gravity, upwards, and the acceleration of the camera.
One reading does not tell them apart: a sideways acceleration ``a`` makes it longer by only ``a^2 /
2 g``. But no camera accelerates one way for long. So the gyroscope rotates the readings of the last
moments into the present axes, and their mean is the direction. Their differences, from each other
and from g in length, give its uncertainty.
"""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.rate_spline import rotations_at_knots, spline
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.turning import GyroscopeErrors

STANDARD_GRAVITY = 9.80665  # m/s^2
_LONGEST, _SHORTEST = 0.4, 0.1  # s of readings
# Biases of consumer accelerometers, and how TF knows their axes, rad.
_LEAST_DEVIATION = 0.03
# Directions that are known worse than this (rad) are none.
_MOST_DEVIATION = 0.5


def gravity_seen(
    samples: ImuSamples, middle_ns: int, errors: GyroscopeErrors
) -> tuple[Array, float] | None:
    """Return a vector (3,) along gravity in camera axes, and its deviation in rad; or None.

    None without an accelerometer, where the readings are too few, or where the camera accelerates
    too much.
    """
    if samples.specific_force is None:
        return None
    now_ns = middle_ns - round(1e9 * errors.time_offset)  # by the clock of the samples
    chosen = np.abs(samples.times_ns - now_ns) <= round(1e9 * _LONGEST)
    times = np.asarray(1e-9 * (samples.times_ns[chosen] - now_ns), np.float64)
    if len(times) < 2 or not (times[0] < -_SHORTEST and times[-1] >= 0.0):
        return None
    cubics = spline(times, samples.angular_velocity[chosen] - errors.bias)
    rotations = rotations_at_knots(times, cubics)
    forces = np.einsum("nji,nj->ni", rotations, samples.specific_force[chosen])
    force = forces.mean(axis=0)
    length = float(np.linalg.norm(force))
    scatter = math.sqrt(float(np.mean(np.var(forces, axis=0))))
    strange = math.hypot(length - STANDARD_GRAVITY, scatter) / STANDARD_GRAVITY
    deviation = math.hypot(_LEAST_DEVIATION, strange)
    return None if deviation > _MOST_DEVIATION else (-force / length, deviation)
