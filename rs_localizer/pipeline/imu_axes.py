"""Inertial readings from the axes of the IMU to those of the camera that it is mounted with.

With ``C = camera_from_imu``, a reading's rate ``w`` and force ``f`` are ``C w + u`` and ``C f`` in
the camera's axes; ``u`` is the turn of the camera with respect to the IMU: of a camera on a head
that moves, else zero. Lever arms do not matter to a rate; what they do to a force is left out.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import IntArray
from rs_localizer.inertial.buffer import Readings
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.io.transforms import Transforms


def in_camera_axes(
    readings: Readings,
    times_ns: IntArray,
    transforms: Transforms,
    frames: tuple[str, str],
    exposure_ns: tuple[int, int],
    around_ns: int,
) -> ImuSamples:
    """The readings as samples.

    Args:
        readings: n of them, in the IMU's axes.
        times_ns: (n,) when they were taken, by the camera's clock.
        transforms: where the two frames are.
        frames: of the camera, and of the IMU.
        exposure_ns: from the first row to the last. A mounting that moves turns evenly from the
            one to the other,
        around_ns: and as long before and after: earlier and later readings are left out then.

    Raises:
        TransformError: when the transform is not known for that time.
    """
    camera, imu = frames
    rates, forces = readings.angular_velocities, readings.specific_forces
    if camera == imu:
        return ImuSamples(times_ns, rates, forces)
    start_ns, end_ns = exposure_ns
    if end_ns <= start_ns or start_ns <= 0 or not transforms.moves(camera, imu):
        turn = transforms.lookup(camera, imu, None).rotation.T
        return ImuSamples(times_ns, rates @ turn, None if forces is None else forces @ turn)
    first, last = (transforms.lookup(camera, imu, stamp).rotation for stamp in exposure_ns)
    # C(t) = exp(-u t) C(0)
    turned = so3.log(np.ascontiguousarray(last @ first.T))
    own = -turned / ((end_ns - start_ns) * 1e-9)
    near = (times_ns >= start_ns - around_ns) & (times_ns <= end_ns + around_ns)
    since = (times_ns[near] - start_ns) / (end_ns - start_ns)
    mountings = so3.exp_many(since[:, None] * turned) @ first
    return ImuSamples(
        times_ns[near],
        np.einsum("nij,nj->ni", mountings, rates[near]) + own,
        None if forces is None else np.einsum("nij,nj->ni", mountings, forces[near]),
    )
