"""The rolling-shutter motion model: row time -> pose -> camera point -> pixel.

Row time ``tau`` is -0.5 at the first exposed row (or column) of the full sensor image and 0.5 at
the last. Over the readout the camera centre moves on a straight line and the camera turns at a
constant body rate (model B of the project):

    camera_point(tau) = exp(-tau [omega]x) (R X + t - tau v)

with ``R, t`` the pose camera_from_map at ``tau = 0``, ``omega`` the camera's body rate in rad per
readout and ``v`` the velocity of its centre in metres per readout, along the camera axes at
``tau = 0``. In the literature's letters (Kukelova et al., ACCV 2018): ``w = -omega``; model A
there has ``exp(tau [w]x) R X + t + tau t_drift``, so ``t_drift = w x t - v``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.camera import Camera
from rs_localizer.core.so3 import Array


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A camera pose at the middle row and the velocities during the readout (see the module)."""

    rotation: Array  # (3,3) camera_from_map at tau = 0
    translation: Array  # (3,) m, camera_from_map at tau = 0
    angular_velocity: Array  # (3,) rad per readout, body rate in camera axes
    linear_velocity: Array  # (3,) m per readout, of the camera centre, in camera axes at tau = 0

    def at(self, tau: float) -> tuple[Array, Array]:
        """Rotation (3,3) and translation (3,) camera_from_map at row time ``tau``."""
        turn = so3.exp(-tau * self.angular_velocity)
        return turn @ self.rotation, turn @ (self.translation - tau * self.linear_velocity)

    def at_rows(self, tau: Array) -> tuple[Array, Array]:
        """Rotations (n,3,3) and translations (n,3) camera_from_map at row times (n,)."""
        tau = np.asarray(tau, float)
        turns = so3.exp_many(-tau[:, None] * self.angular_velocity)
        moved = self.translation - tau[:, None] * self.linear_velocity
        return turns @ self.rotation, np.einsum("nij,nj->ni", turns, moved)

    def linear_velocity_at(self, tau: float) -> Array:
        """Velocity (3,) of the camera centre in the camera axes at ``tau``, m per readout."""
        return so3.exp(-tau * self.angular_velocity) @ self.linear_velocity


def from_model_a(rotation: Array, translation: Array, w: Array, drift: Array) -> Motion:
    """Motion of the solvers' parameters ``exp(tau [w]x) R X + C + tau t`` (model A).

    The two models agree to first order in ``tau``; see theory in the module's docstring.
    """
    return Motion(rotation, translation, -w, np.cross(w, translation) - drift)


# Secant steps double the digits; even rows that overtake the image settle well before this.
_MOST_STEPS = 50
_ROW_TIME_TOLERANCE = 1e-12


def project_rolling(
    camera: Camera, poses_at: Callable[[Array], tuple[Array, Array]], points: Array
) -> tuple[Array, Array]:
    """Raw pixels and row times at which a moving rolling-shutter camera sees points.

    Solves the implicit equation ``row_time(project(pose(tau), X)) = tau`` for each point.

    Args:
        camera: intrinsics, distortion and scan direction.
        poses_at: row times (n,) -> rotations (n,3,3), translations (n,3) camera_from_map, one
            pose per point (``Motion.at_rows`` or any other motion).
        points: (n,3) map frame, metres.

    Returns:
        pixels (n,2) and row times (n,); NaN where the point is behind the camera, or where no row
        sees it (the iteration does not settle).
    """
    points = np.asarray(points, float)

    def view(tau: Array) -> tuple[Array, Array]:
        rotations, translations = poses_at(tau)
        pixels = camera.project(np.einsum("nij,nj->ni", rotations, points) + translations)
        return pixels, camera.row_time(pixels)

    before = np.zeros(len(points))
    error_before = view(before)[1] - before
    tau = before + error_before
    for _ in range(_MOST_STEPS):
        error = view(tau)[1] - tau
        moving = np.abs(error) > _ROW_TIME_TOLERANCE
        if not np.any(moving):
            break
        with np.errstate(all="ignore"):  # points that no row sees end as NaN
            step = -error * (tau - before) / (error - error_before)
        before, error_before = tau, error
        tau = np.where(moving, tau + step, tau)
    pixels, row_time = view(tau)
    settled = np.abs(row_time - tau) < 1e3 * _ROW_TIME_TOLERANCE  # NaN compares false
    return np.where(settled[:, None], pixels, np.nan), np.where(settled, tau, np.nan)
