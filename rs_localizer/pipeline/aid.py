# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""IMU readings of the exposures of frames, in the camera's axes.

Node and replay share this module. Readings may be added from any thread; all other calls belong to
the thread that localizes. The readings of a frame depend on stamps alone, not on their time of
arrival, so that a recording gives the same poses live and offline.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rs_localizer.config import ImuUse, NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import ImuReason, Unused
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.known_rotation import Aid
from rs_localizer.io.imu import ImuReading
from rs_localizer.io.transforms import TransformError, Transforms
from rs_localizer.pipeline.refusal import Notify
from rs_localizer.tracking import Tracker

if TYPE_CHECKING:  # without an IMU nobody needs them
    from rs_localizer.inertial.samples import ImuSamples, SampleBuffer
    from rs_localizer.inertial.status import InertialStatus

# Readings around the exposure are used, because the spline needs neighbours, and the tracker needs
# those since the last frame.
_AROUND_NS, _BEFORE_NS = 10_000_000, 600_000_000
# Drivers send readings in bundles: those of so much time (s) may come at once.
_BUNDLE = 0.05
# Frames over which the share is told, and in a row before the log is told: at the beginning some
# are without, and now and then a message is lost.
_MANY, _LONG = 100, 5
# Share of the last frames below which it is worth a warning that the IMU is not used.
_FEW = 0.5
# rad: accelerometers and maps are upright to a few degrees; a wrong direction is off by 90 or 180.
_MOST_TILT = math.radians(10.0)
# Frames whose accelerometer readings average a hand's accelerations out of gravity.
_SOME = 30

# s: drivers stamp images and readings some milliseconds off; who gives an offset has measured it.
_ANY_OFFSET, _GIVEN_OFFSET = 0.02, 0.002


class Moment(NamedTuple):
    """A time, and what readings of that time are for."""

    tracker: Tracker
    config: NodeConfig
    time_ns: int  # by the camera's clock; of a frame, of its middle row
    camera_frame: str  # the camera's axes
    transforms: Transforms  # how the IMU is turned against them

    def exposure(self) -> tuple[int, int]:
        """Return the times of first and last row by the clock of the IMU, as far as it is known."""
        aid = self.tracker.aid
        status = None if aid is None else aid.status
        estimated = 0.0 if status is None or math.isnan(status.time_offset) else status.time_offset
        middle_ns = self.time_ns - round(1e9 * (self.config.imu.time_offset + estimated))
        half_ns = round(0.5e9 * self.config.readout_time)
        return middle_ns - half_ns, middle_ns + half_ns


class AidInput:
    """Takes readings, tracks frames with theirs, and counts how many could use them.

    Args:
        notice: told, by the reason and one sentence, when the camera has to go on alone for some
            frames in a row.
    """

    def __init__(self, notice: Notify) -> None:
        self._notice = notice
        self._buffer: SampleBuffer | None = None  # since the first reading
        self._recently: deque[Unused | None] = deque(maxlen=_MANY)
        self._force_in_map = np.zeros(3)  # mean of the last frames
        self._with_force = 0  # how many
        # rad, between gravity as the accelerometer shows it and gravity_in_map; NaN: not known yet;
        # None: imu.gravity is off
        self.gravity: float | None = None
        self.reasons: Counter[ImuReason] = Counter()  # of frames that went without
        self.details: dict[ImuReason, str] = {}  # the latest of each, one sentence
        self._in_a_row: deque[ImuReason] = deque(maxlen=_LONG)
        self._reported: ImuReason | None = None
        self._odd = 0  # frames in a row that say what the gyroscope has
        self._status: InertialStatus | None = None  # what the frames say of the gyroscope
        self._given_offset = 0.0
        self._lacking: Unused | None = None  # why the present frame has no samples

    def add(self, reading: ImuReading) -> None:
        """Take a reading."""
        from rs_localizer.inertial.samples import SampleBuffer

        if self._buffer is None:
            self._buffer = SampleBuffer()
        rate, force = reading.angular_velocity, reading.linear_acceleration
        self._buffer.add(reading.stamp_ns, reading.frame, rate, force)

    @property
    def frame(self) -> str:
        """Frame of the readings' axes; empty as long as none has come."""
        return "" if self._buffer is None else self._buffer.frame

    @property
    def share(self) -> float:
        """Share of the last frames that used it; NaN as long as none has met an IMU."""
        recently = tuple(self._recently)
        return recently.count(None) / len(recently) if recently else math.nan

    @property
    def mostly(self) -> Unused | None:
        """Reason why most of the last frames without the IMU went without; None: there is none."""
        lacking = [unused for unused in tuple(self._recently) if unused is not None]
        reasons = [unused.reason for unused in lacking]
        usual = max(reasons, key=reasons.count, default=None)
        return next((unused for unused in reversed(lacking) if unused.reason == usual), None)

    def values(self) -> dict[str, str]:
        """Return values by readable names, without what is not known."""
        share, mostly, status = self.share, self.mostly, self._status
        if math.isnan(share) or self._buffer is None:
            return {}
        use = "used" if mostly is None or share >= _FEW else f"not used: {mostly.detail}"
        values = {"IMU": use, "IMU used (share of the last frames)": f"{share:.0%}"}
        if (gravity := self.gravity) is not None:
            off = f"{math.degrees(gravity):.1f}" if math.isfinite(gravity) else "not known yet"
            values["IMU gravity off gravity_in_map (deg)"] = off
        if math.isfinite(rate := self._buffer.rate()):
            values["IMU rate (Hz)"] = f"{rate:.1f}"
        if status is not None and np.all(np.isfinite(status.bias)):
            bias = " ".join(f"{value:.3f}" for value in np.degrees(status.bias))
            deviation = math.degrees(status.bias_deviation)
            values["IMU bias (deg/s, camera axes)"] = f"{bias} +- {deviation:.3f}"
        if status is not None and status.oddity:
            values["IMU contradicted by the camera"] = status.oddity
        if status is not None and math.isfinite(status.time_offset):
            offset, deviation = (
                self._given_offset + status.time_offset,
                status.time_offset_deviation,
            )
            values["IMU time offset (ms)"] = f"{1e3 * offset:.2f} +- {1e3 * deviation:.2f}"
        return values | {f"IMU not used: {name}": str(n) for name, n in dict(self.reasons).items()}

    def oddities(self) -> dict[str, str]:
        """Return why the camera goes on alone, and what contradicts gyroscope and gravity."""
        oddities, mostly = {}, self.mostly
        if mostly is not None and self.share < _FEW:
            oddities["imu"] = f"the IMU is not used, {mostly.reason}: {mostly.detail}"
        if self._status is not None and self._status.oddity:
            said = f"the camera's rotation says of the gyroscope: {self._status.oddity}"
            oddities["imu.gyroscope"] = said
        if (gravity := self.gravity) is not None and gravity > _MOST_TILT:
            oddities["imu.gravity"] = (
                f"the accelerometer shows gravity {math.degrees(gravity):.0f} degrees off "
                "gravity_in_map: is that the direction in which things fall in the map, and does "
                "TF know the IMU's axes?"
            )
        return oddities

    def awaits(self, frame: Moment, patience: float) -> bool:
        """Return True if missing readings of this exposure may come within so many seconds."""
        if not self._wanted(frame.config) or frame.tracker.aid is None:
            return False
        assert self._buffer is not None
        missing_ns = self._buffer.lag(frame.exposure()[1] + _AROUND_NS)
        return 0 < missing_ns <= round((patience + _BUNDLE) * 1e9)

    def ahead(self, now: Moment) -> ImuSamples | None:
        """Return the readings from the last frame until this time.

        None where there are none, or the frame was the last one so long ago that none counts.
        """
        if not self._wanted(now.config) or now.tracker.aid is None:
            return None
        since_ns = now.time_ns - round(1e9 * now.config.max_prediction)
        start_ns, _ = now._replace(time_ns=since_ns).exposure()
        samples = self._samples(now, start_ns, start_ns, now.time_ns + _AROUND_NS)
        return None if isinstance(samples, Unused) else samples

    def readings(self, frame: Moment) -> ImuSamples | None:
        """Return the samples of a frame; None: the camera goes on alone."""
        self._lacking = None
        found = self._samples_of(frame) if self._wanted(frame.config) else None
        if isinstance(found, Unused):
            self._lacking, found = found, None
        return found

    def judge(self, frame: Moment, samples: ImuSamples | None, result: Estimate | Failure) -> None:
        """Count whether the frame could use its samples, once it is localized."""
        if not self._wanted(frame.config):
            return
        aid = frame.tracker.aid
        self._status = None if aid is None else aid.status
        self._given_offset = frame.config.imu.time_offset
        unused = self._lacking
        if samples is not None and self._status is not None:
            unused = self._status.unused
            self._compare_gravity(frame.config, samples, result)
        self._count(unused)

    def _samples_of(self, frame: Moment) -> ImuSamples | Unused:
        """Return the readings of a frame, or why there are none."""
        if frame.config.readout_time == 0.0:
            return Unused(ImuReason.NO_READOUT_TIME, "readout_time is 0: messages have no row")
        if frame.tracker.aid is None:
            return Unused(ImuReason.NOT_TRACKING, "the solver is for global shutters")
        start_ns, end_ns = frame.exposure()
        return self._samples(frame, start_ns, end_ns, end_ns + _AROUND_NS)

    def _compare_gravity(
        self, config: NodeConfig, samples: ImuSamples, result: Estimate | Failure
    ) -> None:
        """Compare the accelerometer's gravity with gravity_in_map, if that is used."""
        if not config.imu.gravity:
            self.gravity, self._with_force = None, 0
            return
        if result and samples.specific_force is not None:
            force = result.rotation.T @ samples.specific_force.mean(axis=0)
            self._with_force = min(self._with_force + 1, _MANY)
            self._force_in_map += (force - self._force_in_map) / self._with_force
        self.gravity = math.nan
        if self._with_force >= _SOME:
            up, down = self._force_in_map, np.asarray(config.gravity_in_map, float)
            cosine = -(up @ down) / max(float(np.linalg.norm(up) * np.linalg.norm(down)), 1e-12)
            self.gravity = math.acos(min(max(cosine, -1.0), 1.0))

    def _wanted(self, config: NodeConfig) -> bool:
        return config.imu.use != ImuUse.NONE and self.frame != ""

    def _samples(
        self, at: Moment, start_ns: int, end_ns: int, until_ns: int
    ) -> ImuSamples | Unused:
        """Return readings that cover a span, and those before and after it."""
        assert self._buffer is not None
        samples = self._buffer.between(start_ns, end_ns, start_ns - _BEFORE_NS, until_ns)
        if isinstance(samples, Unused):
            return samples
        times_ns = samples.times_ns + round(1e9 * at.config.imu.time_offset)
        try:
            frames = at.camera_frame, self.frame
            samples = in_camera_axes(samples, at.transforms, frames, at.time_ns)
            return replace(samples, times_ns=times_ns)
        except TransformError as error:
            text = f"from the IMU {self.frame!r} to the camera {at.camera_frame!r}: {error}"
            return Unused(ImuReason.NO_TRANSFORM, text)

    def _count(self, unused: Unused | None) -> None:
        self._recently.append(unused)
        oddity = "" if self._status is None else self._status.oddity
        self._odd = self._odd + 1 if oddity else 0
        if self._odd == _LONG:
            use = "used and corrected" if unused is None else "not used"
            self._notice(ImuReason.DISAGREES, f"the gyroscope is {use}: {oddity}")
        if unused is None:
            self._in_a_row.clear()
            self._reported = None
            return
        self.reasons[unused.reason] += 1
        self.details[unused.reason] = unused.detail
        self._in_a_row.append(unused.reason)
        if self._in_a_row.count(unused.reason) == _LONG and self._reported != unused.reason:
            self._reported = unused.reason
            self._notice(unused.reason, f"the IMU is not used: {unused.detail}")


def aid_of(config: NodeConfig, camera: Camera) -> Aid | None:
    """Return what a tracker knows of the gyroscope; None if no IMU is to be used."""
    if config.imu.use == ImuUse.NONE:
        return None
    from rs_localizer.inertial.gyro_prior import GyroscopeTrack
    from rs_localizer.inertial.status import InertialSettings

    known = InertialSettings(
        gyroscope_noise=config.imu.gyroscope_noise,
        gyroscope_bias_walk=config.imu.gyroscope_bias_walk,
        scale_deviation=config.imu.scale_deviation,
        mount_deviation=config.imu.mount_deviation,
        time_offset_deviation=config.imu.time_offset_deviation
        or (_GIVEN_OFFSET if config.imu.time_offset else _ANY_OFFSET),
        gravity_in_map=np.array(config.gravity_in_map, float) if config.imu.gravity else None,
    )
    return GyroscopeTrack(known, camera.readout_time)


def in_camera_axes(
    samples: ImuSamples, transforms: Transforms, frames: tuple[str, str], now_ns: int
) -> ImuSamples:
    """Return samples in the axes of the camera, of those in the axes of the IMU.

    Lever arms do not change a rate; their effect on a force is neglected.

    Args:
        transforms: where the two frames are.
        frames: of the camera, and of the IMU.
        now_ns: when a mounting counts that may be another one later: of a head that rests.

    Raises:
        TransformError: when the transform is not known for that time.
    """
    camera, imu = frames
    if camera == imu:
        return samples
    timed = now_ns > 0 and transforms.moves(camera, imu)
    turn = transforms.lookup(camera, imu, now_ns if timed else None).rotation.T
    force = samples.specific_force
    return replace(
        samples, angular_velocity=samples.angular_velocity @ turn,
        specific_force=None if force is None else force @ turn,
    )  # fmt: skip
