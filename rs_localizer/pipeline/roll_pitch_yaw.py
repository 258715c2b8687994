"""Covariances of orientations for those who read them as variances of roll, pitch and yaw.

REP-103 and the messages mean small rotations about the fixed axes of the map, and so do ours. An
extended Kalman filter whose state has roll, pitch and yaw (robot_localization) takes the same
numbers for errors of these angles. They are the same for a body that looks along the map's x; at a
yaw of 90 degrees roll and pitch have changed places. A small rotation about the fixed axes is

    theta = E (d_roll, d_pitch, d_yaw),   E = [Rz Ry x, Rz y, z]

because the rotation is ``Rz(yaw) Ry(pitch) Rx(roll)``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.io.outputs import Pose

_ROTATION = slice(3, 6)
# A body that looks straight up or down has no yaw.
_LEAST_COSINE = 0.02


def about_angles(pose: Pose) -> Pose:
    """The pose with the covariance of x, y, z, roll, pitch and yaw.

    Within a degree of looking straight up or down, where the angles do not say how a body is
    turned, it is the pose as it came.
    """
    x_axis = pose.rotation[:, 0]  # Rz Ry x
    level = float(np.hypot(x_axis[0], x_axis[1]))  # cosine of the pitch
    if level < _LEAST_COSINE:
        return pose
    left = np.array([-x_axis[1], x_axis[0], 0.0]) / level  # Rz y
    axes = np.column_stack([x_axis, left, [0.0, 0.0, 1.0]])
    jacobian: Array = np.eye(6)
    jacobian[_ROTATION, _ROTATION] = np.linalg.inv(axes)
    covariance = jacobian @ pose.covariance @ jacobian.T
    return replace(pose, covariance=0.5 * (covariance + covariance.T))
