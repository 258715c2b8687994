# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/Imu -> readings of a gyroscope and an accelerometer."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.io.messages import MessageError, frame_id, make_header, make_vector, stamp_ns

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class ImuRecording:
    """Readings of a gyroscope while the camera ran."""

    stamps_ns: IntArray  # (k,)
    angular_velocities: Array  # (k,3) rad/s, in its own axes


# Gyroscopes end at 70 rad/s (4000 deg/s), accelerometers of robots at some hundred g: beyond these
# a message counts in other units.
_FASTEST = 100.0  # rad/s
_HARDEST = 5000.0  # m/s^2
# First element of a covariance if the message holds no such measurement.
_ABSENT = -1.0


@dataclass(frozen=True, slots=True)
class ImuReading:
    """One measurement, in the axes of ``frame``."""

    stamp_ns: int  # by the clock of the IMU
    frame: str
    angular_velocity: Vector  # rad/s
    linear_acceleration: Vector | None  # m/s^2, specific force: +g upwards at rest


def read_imu(message: Any) -> ImuReading:
    """Read a sensor_msgs/Imu; its orientation, which others have estimated, is not used.

    Covariances, which drivers often make up, are not used, but for one that begins with -1: there
    is no such measurement. Nor is there one where an acceleration is exactly zero, or NaN.

    Raises:
        MessageError: without an angular velocity, and for numbers that no IMU measures, saying
            what was found.
    """
    frame = frame_id(message, "the frame of the IMU's axes")
    rates = message.angular_velocity_covariance
    forces = message.linear_acceleration_covariance
    if (len(rates), len(forces)) != (9, 9):
        raise MessageError(f"the covariances must be of 9 numbers, found {len(rates), len(forces)}")
    if float(rates[0]) == _ABSENT:
        raise MessageError(
            "angular_velocity_covariance[0] is -1: the message has no angular velocity (a topic of "
            "the accelerometer alone?)"
        )
    turn = _checked(_values(message.angular_velocity), "angular_velocity", "rad/s", _FASTEST)
    acceleration, force = _values(message.linear_acceleration), None
    # Drivers of gyroscopes alone may send NaN or zeros for the rest.
    if float(forces[0]) != _ABSENT and all(map(math.isfinite, acceleration)) and any(acceleration):
        force = _checked(acceleration, "linear_acceleration", "m/s^2", _HARDEST)
    return ImuReading(stamp_ns(message), frame, turn, force)


def _values(vector: Any) -> Vector:
    return float(vector.x), float(vector.y), float(vector.z)


def _checked(values: Vector, name: str, unit: str, most: float) -> Vector:
    if not all(map(math.isfinite, values)):
        raise MessageError(f"{name} is not finite: {values}")
    if max(map(abs, values)) > most:
        raise MessageError(
            f"{name} is {values} {unit}, more than any IMU measures ({most:g}); is it in {unit}?"
        )
    return values


def make_reading(
    stamp_ns: int, rate: Array, force: Array, frame: str, variances: tuple[float, float] = (0, 0)
) -> Any:
    """Make a sensor_msgs/Imu of rosbags, without an orientation.

    Of a rate (3,) in rad/s and a force (3,) in m/s^2 (NaN: not measured), with their variances (0:
    not known).
    """
    from rs_localizer.io.bags import make_message  # who reads messages needs no bags

    absent = np.array([_ABSENT, *[0.0] * 8])
    known = [np.eye(3).ravel() * variance for variance in variances]
    if not np.isfinite(force).all():
        force, known[1] = np.zeros(3), absent
    return make_message(
        "sensor_msgs/msg/Imu",
        header=make_header(make_message, stamp_ns, frame),
        orientation=make_message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=absent,
        angular_velocity=make_vector(make_message, rate),
        angular_velocity_covariance=known[0],
        linear_acceleration=make_vector(make_message, force),
        linear_acceleration_covariance=known[1],
    )
