"""sensor_msgs/Imu -> what a gyroscope and an accelerometer have measured."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from rs_localizer.io.messages import MessageError, frame_id, stamp_ns

Vector = tuple[float, float, float]

# Gyroscopes end at 70 rad/s (4000 deg/s), accelerometers of robots at some hundred g: beyond these
# a message counts in other units.
_FASTEST = 100.0  # rad/s
_HARDEST = 5000.0  # m/s^2
# What a covariance says in its first element where the message holds no such measurement.
_ABSENT = -1.0
_DIAGONAL = (0, 4, 8)


@dataclass(frozen=True, slots=True)
class ImuReading:
    """One measurement, in the axes of ``frame``."""

    stamp_ns: int  # by the clock of the IMU
    frame: str
    angular_velocity: Vector  # rad/s
    linear_acceleration: Vector | None  # m/s^2, specific force: +g upwards at rest
    gyroscope_deviation: float | None  # rad/s, of one axis of one message; None: not told
    accelerometer_deviation: float | None  # m/s^2, likewise


def read_imu(message: Any) -> ImuReading:
    """Read a sensor_msgs/Imu; its orientation, which others have estimated, is not used.

    A covariance of zeros tells nothing; one that begins with -1 says that there is no such
    measurement, as does an acceleration of exactly zero: no accelerometer shows that.

    Raises:
        MessageError: without an angular velocity, and for numbers that no IMU measures, saying
            what was found.
    """
    frame = frame_id(message, "the frame of the IMU's axes")
    rates = message.angular_velocity_covariance
    if float(rates[0]) == _ABSENT:
        raise MessageError(
            "angular_velocity_covariance[0] is -1: the message has no angular velocity (a topic of "
            "the accelerometer alone?)"
        )
    forces = message.linear_acceleration_covariance
    turn = _vector(message.angular_velocity, "angular_velocity", "rad/s", _FASTEST)
    force = None
    if float(forces[0]) != _ABSENT:
        found = _vector(message.linear_acceleration, "linear_acceleration", "m/s^2", _HARDEST)
        force = found if any(found) else None
    return ImuReading(
        stamp_ns=stamp_ns(message),
        frame=frame,
        angular_velocity=turn,
        linear_acceleration=force,
        gyroscope_deviation=_deviation(rates, "angular_velocity_covariance"),
        accelerometer_deviation=(
            None if force is None else _deviation(forces, "linear_acceleration_covariance")
        ),
    )


def _vector(vector: Any, name: str, unit: str, most: float) -> Vector:
    found = (float(vector.x), float(vector.y), float(vector.z))
    if not all(map(math.isfinite, found)):
        raise MessageError(f"{name} is not finite: {found}")
    if max(map(abs, found)) > most:
        raise MessageError(
            f"{name} is {found} {unit}, more than any IMU measures ({most:g}); is it in {unit}?"
        )
    return found


def _deviation(covariance: Any, name: str) -> float | None:
    """Standard deviation of an axis, by the mean of the variances."""
    variances = [float(covariance[i]) for i in _DIAGONAL]
    if not all(math.isfinite(v) and v >= 0.0 for v in variances):
        raise MessageError(f"the diagonal of {name} is {variances}: no variances")
    mean = sum(variances) / len(variances)
    return math.sqrt(mean) if mean > 0.0 else None
