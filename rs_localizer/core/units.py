# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""An estimate in SI units and in the map: where the camera is, and how fast it moves.

The estimator counts time in readouts and has its poses as ``camera_from_map``, as its solvers do.
Users mostly want the camera in the map, rad/s and m/s.
"""

from dataclasses import dataclass

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, instance
from rs_localizer.core.camera import Camera
from rs_localizer.core.rig import Rig, RigEstimate
from rs_localizer.core.shutter import Motion


@dataclass(frozen=True, slots=True, eq=False)
class CameraState:
    """The camera at one moment, in SI units.

    Velocities are NaN where the readout time is unknown: they are known per readout only.
    """

    position: Array  # (3,) m, of the camera centre in the map
    orientation: Array  # (4,) x y z w, unit: turns the camera's axes into the map's
    rotation: Array  # (3,3) the same as a matrix, map_from_camera
    angular_velocity: Array  # (3,) rad/s, in camera axes
    linear_velocity: Array  # (3,) m/s, of the camera centre, in camera axes


def camera_state(motion: Motion, camera: Camera | Rig, tau: float = 0.0) -> CameraState:
    """Return an estimate in SI units, at one of its rows.

    Args:
        motion: an :class:`rs_localizer.Estimate`, or any motion; of a rig a ``RigEstimate``, of
            whose span ``tau`` is a part, and whose axes and origin take the place of the camera's.
        camera: with its readout time, or the rig.
        tau: row time: 0 for the middle row, -0.5 for the first, 0.5 for the last.

    Raises:
        ValueError: for a row time that is not finite, or a Failure instead of a motion.
    """
    instance("motion", motion, Motion)
    if isinstance(camera, Rig):
        if not isinstance(motion, RigEstimate):
            raise ValueError(f"a rig's motion must be a RigEstimate, got {type(motion).__name__}")
        seconds = motion.span
    else:
        instance("camera", camera, Camera)
        seconds = camera.readout_time
    if not np.isfinite(tau):
        raise ValueError(f"tau must be finite, got {tau!r}")
    rotation, translation = motion.at(tau)
    in_map = np.ascontiguousarray(rotation.T)
    per_readout = seconds if seconds > 0.0 else np.nan
    return CameraState(
        position=-in_map @ translation,
        orientation=so3.quaternion(in_map),
        rotation=in_map,
        angular_velocity=motion.angular_velocity_at(tau) / per_readout,
        linear_velocity=motion.linear_velocity_at(tau) / per_readout,
    )
