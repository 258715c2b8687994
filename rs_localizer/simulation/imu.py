"""What an IMU on a camera's true motion measures, with its own noise, bias and clock.

Every reading is of one instant: the body rate of the motion, and the specific force ``R' (a - g)``
at the IMU's own place, ``a`` by the difference of the true velocities around that instant. Nothing
of it is made of what the estimators assume.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.simulation.true_motion import BODY_FROM_CAMERA, TrueMotion

_GRAVITY = np.array([0.0, 0.0, -9.80665])  # m/s^2, in a map with z up
_STEP = 1e-5  # s, of the difference that gives accelerations
_CHUNK = 4096


@dataclass(frozen=True, slots=True)
class ImuSettings:
    """How good an IMU is: that of a phone or a drone."""

    rate: float = 400.0  # Hz
    gyroscope_noise: float = math.radians(0.01)  # rad/s/sqrt(Hz)
    gyroscope_bias: float = math.radians(0.5)  # rad/s, in any direction
    gyroscope_bias_walk: float = math.radians(0.002)  # rad/s^2/sqrt(Hz)
    accelerometer_noise: float = 2e-3  # m/s^2/sqrt(Hz)
    accelerometer_bias: float = 0.05  # m/s^2, in any direction
    time_offset: float = 0.0  # s to be added to its stamps to get the camera's time


@dataclass(frozen=True, slots=True, eq=False)
class Lever:
    """Where the IMU sits: a reading in its axes, ``rotation @ reading`` in the camera's."""

    rotation: Array = field(  # (3,3) camera_from_imu; REP-103's body, x forward and z up
        default_factory=lambda: BODY_FROM_CAMERA["forward_left_up"].T
    )
    position: Array = field(  # (3,) m, in camera axes
        default_factory=lambda: np.array([0.03, -0.02, -0.01])
    )


@dataclass(frozen=True, slots=True, eq=False)
class ImuTrack:
    """n readings of a recording."""

    stamps_ns: IntArray  # (n,) by the IMU's clock
    times_ns: IntArray  # (n,) when they were taken
    angular_velocities: Array  # (n,3) rad/s, IMU axes
    specific_forces: Array  # (n,3) m/s^2, IMU axes
    biases: Array  # (n,3) rad/s, the gyroscope's, IMU axes: part of what it measures


def simulate_imu(
    motion: TrueMotion, settings: ImuSettings, lever: Lever, rng: np.random.Generator
) -> ImuTrack:
    """The readings all along a motion; none where a recorded motion has gaps."""
    times = np.concatenate(
        [
            first + np.round(np.arange(0.0, last - first, 1e9 / settings.rate)).astype(np.int64)
            for first, last in motion.intervals_ns
        ]
    )
    parts = [_true(motion, chunk, lever) for chunk in _chunks(times)]
    rates, forces = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    shape, root = (len(times), 3), math.sqrt(settings.rate)
    walk = rng.normal(0.0, settings.gyroscope_bias_walk / root, shape)
    walk[0] = settings.gyroscope_bias * _direction(rng)
    biases = np.cumsum(walk, axis=0)
    force_bias = settings.accelerometer_bias * _direction(rng)
    return ImuTrack(
        stamps_ns=times - round(settings.time_offset * 1e9),
        times_ns=times,
        angular_velocities=rates + biases
        + rng.normal(0.0, settings.gyroscope_noise * root, shape),
        specific_forces=forces + force_bias
        + rng.normal(0.0, settings.accelerometer_noise * root, shape),
        biases=biases,
    )  # fmt: skip


def _chunks(times: IntArray) -> Iterator[IntArray]:
    """Cut where a motion has gaps, and where rounding of seconds would begin to show."""
    steps = np.diff(times, prepend=times[:1])[1:]
    ends = np.flatnonzero(steps > 2 * np.median(steps)) + 1
    for part in np.split(times, ends):
        yield from np.split(part, range(_CHUNK, len(part), _CHUNK))


def _true(motion: TrueMotion, times: IntArray, lever: Lever) -> tuple[Array, Array]:
    """Body rates and specific forces (n,3) in IMU axes."""
    offsets = (times - times[0]) * 1e-9
    state = motion.state(int(times[0]), offsets)
    ends = [_velocity(motion, times, offsets + shift, lever) for shift in (-_STEP, _STEP)]
    acceleration = (ends[1] - ends[0]) / (2.0 * _STEP)
    force = np.einsum("nji,nj->ni", state.rotations, acceleration - _GRAVITY)
    return state.angular @ lever.rotation, force @ lever.rotation


def _velocity(motion: TrueMotion, times: IntArray, offsets: Array, lever: Lever) -> Array:
    """Velocities (n,3) of the IMU in the map."""
    state = motion.state(int(times[0]), offsets)
    velocity = state.linear + np.cross(state.angular, lever.position)
    return np.asarray(np.einsum("nij,nj->ni", state.rotations, velocity), np.float64)


def _direction(rng: np.random.Generator) -> Array:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector), np.float64)
