# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A motion that vibrates, and what an IMU on a camera measures of one, as messages of a recording.

Every reading is of one instant: the body rate of the motion, and the specific force ``R' (a - g)``
at the IMU's own place, ``a`` by the difference of the true velocities around that instant. Nothing
of it is made of what the estimators assume.
"""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.io import topics
from rs_localizer.io.bags import BagWriter, make_message
from rs_localizer.io.imu import make_reading
from rs_localizer.io.recording import CAMERA_FRAME
from rs_localizer.io.topics import TF_STATIC
from rs_localizer.io.transforms import Transform, make_transform
from rs_localizer.tools.simulation.true_motion import BODY_FROM_CAMERA, TrueMotion, TrueState

_GRAVITY = np.array([0.0, 0.0, -9.80665])  # m/s^2, in a map with z up
_STEP = 1e-5  # s, of the difference that gives accelerations
_CHUNK = 4096


@dataclass(frozen=True, slots=True)
class ImuSettings:
    """Errors of an IMU, by default of a phone or a drone."""

    rate: float = 400.0  # Hz
    gyroscope_noise: float = math.radians(0.01)  # rad/s/sqrt(Hz)
    gyroscope_bias: float = math.radians(0.5)  # rad/s, in any direction
    gyroscope_bias_walk: float = math.radians(0.002)  # rad/s^2/sqrt(Hz)
    accelerometer_noise: float = 2e-3  # m/s^2/sqrt(Hz)
    accelerometer_bias: float = 0.05  # m/s^2, in any direction
    time_offset: float = 0.0  # s to be added to its stamps to get the camera's time

    @property
    def variances(self) -> tuple[float, float]:
        """Variances of an angular rate, (rad/s)^2, and of a force, (m/s^2)^2."""
        return self.gyroscope_noise**2 * self.rate, self.accelerometer_noise**2 * self.rate


@dataclass(frozen=True, slots=True, eq=False)
class Shaken:
    """A camera that swings to and fro about an axis of its own, while it moves.

    With the angle ``a(t) = A sin(2 pi f t + p)`` about the unit vector ``n`` its rotation is
    ``R exp(a n)``; its body rate ``exp(-a n) w + a' n``, its velocity in its own axes
    ``exp(-a n) v``. Several vibrations are one around the other.
    """

    motion: TrueMotion
    amplitude: float  # rad
    frequency: float  # Hz
    axis: Array  # (3,) unit vector, camera axes
    phase: float = 0.0  # rad, at the motion's start

    @property
    def intervals_ns(self) -> list[tuple[int, int]]:
        return self.motion.intervals_ns

    def state(self, stamp_ns: int, offsets: Array) -> TrueState:
        base = self.motion.state(stamp_ns, offsets)
        # The whole seconds apart, or the phase would drown in the size of today's stamps.
        since_ns = stamp_ns - self.intervals_ns[0][0]
        t = since_ns * 1e-9 + np.asarray(offsets, float)
        pulse = 2.0 * math.pi * self.frequency
        angle = self.amplitude * np.sin(pulse * t + self.phase)
        rate = self.amplitude * pulse * np.cos(pulse * t + self.phase)
        turn = so3.exp_many(angle[:, None] * self.axis)
        return TrueState(
            base.rotations @ turn,
            base.positions,
            np.einsum("nji,nj->ni", turn, base.angular) + rate[:, None] * self.axis,
            np.einsum("nji,nj->ni", turn, base.linear),
        )


def shaken(
    motion: TrueMotion, vibrations: list[tuple[float, float]], rng: np.random.Generator
) -> TrueMotion:
    """Return a motion with vibrations (degrees, Hz), each about any axis and from any phase."""
    for degrees, hertz in vibrations:
        axis = rng.normal(size=3)
        phase = float(rng.uniform(0.0, 2.0 * math.pi))
        unit = axis / np.linalg.norm(axis)
        motion = Shaken(motion, math.radians(degrees), hertz, unit, phase)
    return motion


@dataclass(frozen=True, slots=True, eq=False)
class Lever:
    """Where the IMU sits: a reading in its axes, ``rotation @ reading`` in the camera's."""

    rotation: Array = field(  # (3,3) camera_from_imu; REP-103's body, x forward and z up
        default_factory=BODY_FROM_CAMERA.T.copy
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


def simulate_imu(
    motion: TrueMotion, settings: ImuSettings, lever: Lever, rng: np.random.Generator
) -> ImuTrack:
    """Return the readings all along a motion; none where a recorded motion has gaps."""
    times = np.concatenate(
        [
            first + np.round(np.arange(0.0, last - first, 1e9 / settings.rate)).astype(np.int64)
            for first, last in motion.intervals_ns
        ]
    )
    # Cut where a motion has gaps, and where rounding of seconds would begin to show.
    steps = np.diff(times, prepend=times[:1])[1:]
    ends = np.flatnonzero(steps > 2 * np.median(steps)) + 1
    parts = [
        _true(motion, chunk, lever)
        for part in np.split(times, ends)
        for chunk in np.split(part, range(_CHUNK, len(part), _CHUNK))
    ]
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
    )  # fmt: skip


def _true(motion: TrueMotion, times: IntArray, lever: Lever) -> tuple[Array, Array]:
    """Return the body rates and specific forces (n,3) in IMU axes."""
    offsets, first_ns = (times - times[0]) * 1e-9, int(times[0])
    state, ends = motion.state(first_ns, offsets), []
    for shift in (-_STEP, _STEP):
        there = motion.state(first_ns, offsets + shift)
        velocity = there.linear + np.cross(there.angular, lever.position)
        ends.append(np.einsum("nij,nj->ni", there.rotations, velocity))
    acceleration = (ends[1] - ends[0]) / (2.0 * _STEP)
    force = np.einsum("nji,nj->ni", state.rotations, acceleration - _GRAVITY)
    return state.angular @ lever.rotation, force @ lever.rotation


def _direction(rng: np.random.Generator) -> Array:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector), np.float64)


IMU_TOPIC = f"/{topics.IMU}"
IMU_FRAME = "imu_link"
# Readings begin and end so long before the first frame and after the last one.
_BEFORE_NS, _REST_NS = 700_000_000, 100_000_000


def write_imu(
    bag: BagWriter, track: ImuTrack, settings: ImuSettings, lever: Lever, first_ns: int,
    last_ns: int,
) -> None:  # fmt: skip
    """Write the mounting of an IMU, and its readings, recorded when they were taken.

    Args:
        first_ns: stamp of the first frame.
        last_ns: when the last one is recorded.
    """
    begin_ns, end_ns = first_ns - _BEFORE_NS, last_ns + _REST_NS
    bag.write(TF_STATIC, mounting(lever), begin_ns)
    for i in np.flatnonzero((track.times_ns >= begin_ns) & (track.times_ns <= end_ns)).tolist():
        stamp, rate = int(track.stamps_ns[i]), track.angular_velocities[i]
        force = track.specific_forces[i]
        message = make_reading(stamp, rate, force, IMU_FRAME, settings.variances)
        bag.write(IMU_TOPIC, message, int(track.times_ns[i]))


def mounting(lever: Lever) -> Any:
    """Return the tf2_msgs/TFMessage that says where the IMU is on the camera."""
    camera_from_imu = Transform(lever.rotation, lever.position)
    transform = make_transform(make_message, 0, CAMERA_FRAME, IMU_FRAME, camera_from_imu)
    return make_message("tf2_msgs/msg/TFMessage", transforms=[transform])
