"""A simulated IMU in a recording: its messages, its mounting, and frames that come in time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.io import topics
from rs_localizer.io.bags import BagWriter, make_message
from rs_localizer.io.messages import make_header
from rs_localizer.io.recording import CAMERA_FRAME
from rs_localizer.io.transforms.rigid import Transform, make_transform
from rs_localizer.simulation.imu import ImuSettings, ImuTrack, Lever

IMU_TOPIC = f"/{topics.IMU}"
IMU_FRAME = "imu_link"
# Readings go on for so long after the last frame.
_REST_NS = 100_000_000
_BEFORE_NS = 700_000_000


class ImuBagWriter(BagWriter):
    """Writes a recording of a camera and an IMU.

    What is written with the stamp of a frame is recorded when its last row has been read, as from a
    real camera; between the frames come the readings, recorded when they were taken.

    Args:
        path, storage: as for :class:`BagWriter`.
        readout_time: s.
        track, settings, lever: of the IMU.
    """

    def __init__(
        self,
        path: Path,
        storage: str,
        readout_time: float,
        track: ImuTrack,
        settings: ImuSettings,
        lever: Lever,
    ) -> None:
        super().__init__(path, storage)
        self._delay_ns = round(readout_time * 1e9)
        self._track, self._settings, self._lever = track, settings, lever
        self._next: int | None = None  # reading to be written

    def write(self, topic: str, message: Any, stamp_ns: int) -> None:
        recorded_ns = stamp_ns + self._delay_ns
        if self._next is None:
            begin_ns = stamp_ns - _BEFORE_NS
            self._next = int(np.searchsorted(self._track.times_ns, begin_ns))
            super().write("/tf_static", mounting(self._lever), begin_ns)
        self._write_readings(recorded_ns)
        self._latest_ns = recorded_ns
        super().write(topic, message, recorded_ns)

    def __exit__(self, *failure: Any) -> None:
        if failure[0] is None and self._next is not None:
            self._write_readings(self._latest_ns + _REST_NS)
        super().__exit__(*failure)

    def _write_readings(self, until_ns: int) -> None:
        assert self._next is not None
        end = int(np.searchsorted(self._track.times_ns, until_ns, "right"))
        for i in range(self._next, end):
            message = make_imu(
                int(self._track.stamps_ns[i]),
                self._track.angular_velocities[i],
                self._track.specific_forces[i],
                self._settings,
            )
            super().write(IMU_TOPIC, message, int(self._track.times_ns[i]))
        self._next = max(self._next, end)


def make_imu(
    stamp_ns: int, rate: Array, force: Array, settings: ImuSettings, frame: str = IMU_FRAME
) -> Any:
    """A sensor_msgs/Imu: rate (3,) in rad/s, force (3,) in m/s^2; it knows no orientation."""
    densities = (settings.gyroscope_noise, settings.accelerometer_noise)
    variances = [np.eye(3).ravel() * density**2 * settings.rate for density in densities]
    return make_message(
        "sensor_msgs/msg/Imu",
        header=make_header(make_message, stamp_ns, frame),
        orientation=make_message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
        orientation_covariance=np.array([-1.0, *[0.0] * 8]),
        angular_velocity=_vector(rate),
        angular_velocity_covariance=variances[0],
        linear_acceleration=_vector(force),
        linear_acceleration_covariance=variances[1],
    )


def mounting(lever: Lever) -> Any:
    """The tf2_msgs/TFMessage that says where the IMU is on the camera."""
    camera_from_imu = Transform(lever.rotation, lever.position)
    transform = make_transform(make_message, 0, CAMERA_FRAME, IMU_FRAME, camera_from_imu)
    return make_message("tf2_msgs/msg/TFMessage", transforms=[transform])


def _vector(vector: Array) -> Any:
    x, y, z = vector.tolist()
    return make_message("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
