"""Two trajectories in frames of their own, laid over each other by positions and orientations."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.io.trajectories import Trajectory

# Positions say nothing of the rotation where the camera stays within this (m).
_LEAST_SPREAD = 1e-3


def aligned(estimate: Trajectory, truth: Trajectory) -> Trajectory:
    """The estimate in the frame of the truth: rigidly moved to fit row by row.

    Positions alone (Umeyama, 1991) leave the rotation undetermined along a straight way, and
    orientations are wrong by what it takes then. Here both count, each by how well it fits:
    ``sum |R q_i p_i^-1|^2 / s_q^2 + sum |R (x_i - m_x) - (y_i - m_y)|^2 / s_x^2``, two steps.
    """
    estimated, true = (Rotation.from_quat(part.quaternions) for part in (estimate, truth))
    between = true * estimated.inv()
    turn = between.mean()
    x = estimate.positions - estimate.positions.mean(axis=0)
    y = truth.positions - truth.positions.mean(axis=0)
    spread = float(np.sqrt(np.mean(np.sum(x**2, axis=1))))
    if spread > _LEAST_SPREAD:
        for _ in range(2):
            angles = np.asarray((turn.inv() * between).magnitude())
            angle_squared = max(float(np.mean(angles**2)), 1e-12)
            off_squared = max(float(np.mean(np.sum((turn.apply(x) - y) ** 2, axis=1))), 1e-12)
            # Both terms are linear in R, so that their sum is a problem of Procrustes; a rotation
            # that is off by a adds 2 - 2 cos(a) times the weight, in two of three axes.
            matrix = np.einsum("nij->ij", between.as_matrix()) / (2.0 * angle_squared)
            matrix = matrix + (y.T @ x) / off_squared
            u, _, vt = np.linalg.svd(matrix)
            turn = Rotation.from_matrix(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)
    positions = turn.apply(x) + truth.positions.mean(axis=0)
    return Trajectory(estimate.stamps_ns, positions, np.asarray((turn * estimated).as_quat()))
