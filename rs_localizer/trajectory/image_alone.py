"""What one image says of its motion, without any prior: a Gaussian about an estimate of it."""

from __future__ import annotations

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion

# Directions that the image does not see: least eigenvalue of the information, diagonal scaled to 1.
_LEAST_EIGENVALUE = 1e-9
_LEAST_PACE = 0.1  # where rows overtake the image points, they say nothing
_LEAST_NOISE = 1e-4  # px
_PARAMETERS = 12
# A step in directions that the image hardly sees would leave the range of the linear model: the
# velocities stay within about this (rad, m per readout) of the given ones. The covariance says
# that such directions are not known.
_HELD = np.diag(np.repeat([0.0, 0.0, 0.05**-2, 0.05**-2], 3))


def image_alone(
    camera: Camera, motion: Motion, points: Array, pixels: Array
) -> tuple[Array, Array] | None:
    """The step (12,) from a motion to what the image says, and its covariance (12,12).

    Order and units as of ``Estimate.covariance``: one Gauss-Newton step of the constant-velocity
    model on points (n,3) and raw pixels (n,2), all of them inliers, whose noise it leaves is
    theirs. None when they are too few.
    """
    if len(points) <= _PARAMETERS:
        return None
    tau = camera.row_time(pixels)
    omega, v = motion.angular_velocity, motion.linear_velocity
    rotations, translations = motion.at_rows(tau)
    local = np.einsum("nij,nj->ni", rotations, points) + translations
    before = np.where(local[:, 2:] > 0.0, local, 1.0)
    seen = camera.project(before)
    by_ray = camera.pixel_jacobian(before[:, :2] / before[:, 2:])
    turned = so3.exp_many(-tau[:, None] * omega)  # row from middle axes
    inverse_depth = 1.0 / local[:, 2]
    by_point = np.empty((len(points), 2, 3))
    by_point[:, :, :2] = by_ray * inverse_depth[:, None, None]
    by_point[:, :, 2] = -np.einsum(
        "nij,nj->ni", by_point[:, :, :2], local[:, :2] * inverse_depth[:, None]
    )
    crossed = so3.hat(local)
    carried = np.einsum("nij,j->ni", turned, v)
    flow = np.einsum("nij,nj->ni", by_point, np.einsum("nij,j->ni", crossed, omega) - carried)
    pace = 1.0 - flow @ camera.row_time_gradient
    whitener = np.eye(2) + flow[:, :, None] * camera.row_time_gradient / pace[:, None, None]
    error = np.einsum("nij,nj->ni", whitener, seen - pixels)
    usable = (local[:, 2] > 0.0) & (np.abs(pace) > _LEAST_PACE) & np.isfinite(error).all(axis=1)
    if np.count_nonzero(usable) <= _PARAMETERS:
        return None
    by_row = np.concatenate([crossed @ turned, -turned], axis=2)  # turn, place
    by_row[:, :, :3] += tau[:, None, None] * (turned @ so3.hat(v))
    by_velocity = np.concatenate(
        [crossed @ _right_jacobians(tau[:, None] * omega), -turned], axis=2
    )
    by_all = np.concatenate([by_row, tau[:, None, None] * by_velocity], axis=2)
    rows = (whitener @ by_point @ by_all)[usable].reshape(-1, _PARAMETERS)
    error = error[usable].ravel()
    information = rows.T @ rows
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale)
    basis = scale[:, None] * vectors
    inverse = basis / np.maximum(values, _LEAST_EIGENVALUE) @ basis.T
    variance = max(float(error @ error) / (len(error) - _PARAMETERS), _LEAST_NOISE**2)
    step = -np.linalg.solve(information + variance * _HELD, rows.T @ error)
    return step, variance * inverse


def _right_jacobians(vectors: Array) -> Array:
    """Right Jacobians (n,3,3) of the exponential at small rotation vectors (n,3)."""
    cross = so3.hat(vectors)
    jacobians: Array = np.eye(3) - 0.5 * cross + cross @ cross / 6.0
    return jacobians
