# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A rolling-shutter camera of the tests' own, by NumPy and SciPy's rotations alone."""

import numpy as np
from scipy.spatial.transform import Rotation

# Skewed and with a lens, so that the derivative of a pixel by its ray is no diagonal matrix.
MATRIX = np.array([[600.0, 40.0, 319.5], [25.0, 580.0, 239.5]])
RADIAL, SIZE = -0.12, (640, 480)
AXIS = {"top_to_bottom": (1, 1), "bottom_to_top": (1, -1),
        "left_to_right": (0, 1), "right_to_left": (0, -1)}  # fmt: skip


def shake(tau, coefficients):
    """Turn (n,3): a cosine and a sine per half-cycle of the readout, less value and slope at 0."""
    angle = np.pi * np.arange(1, len(coefficients) // 2 + 1) * np.asarray(tau)[:, None]
    pairs = np.stack([np.cos(angle) - 1.0, np.sin(angle) - angle], axis=-1)
    return pairs.reshape(len(tau), -1) @ coefficients


def disturbed(state, step):
    """The state (24,) after a step (18,): the camera turns and moves in its own axes."""
    turn = Rotation.from_rotvec(-step[:3]).as_matrix()
    rotation, translation = state[:9].reshape(3, 3), state[9:12]
    return np.concatenate(
        [(turn @ rotation).ravel(), turn @ (translation - step[3:6]), state[12:] + step[6:]]
    )


def pixels_of(rays):
    bent = rays * (1.0 + RADIAL * np.sum(rays**2, axis=1, keepdims=True))
    return np.column_stack([bent, np.ones(len(rays))]) @ MATRIX.T


def jacobian_of(rays):
    """Derivatives (n,2,2) of the pixels by the rays, in closed form."""
    square = np.sum(rays**2, axis=1)[:, None, None]
    bend = (1.0 + RADIAL * square) * np.eye(2) + 2 * RADIAL * rays[:, :, None] * rays[:, None, :]
    return MATRIX[:, :2] @ bend


def row_time(pixels, direction):
    axis, sign = AXIS[direction]
    return sign * (pixels[:, axis] / (SIZE[axis] - 1) - 0.5)


def gradient(direction):
    axis, sign = AXIS[direction]
    return sign / (SIZE[axis] - 1) * np.eye(2)[axis]


ALONE = np.eye(3), np.zeros(3)
# Axes and centre of a camera in its rig: nearly upside down, with a lever arm.
MOUNTED = Rotation.from_rotvec([0.1, -0.05, 2.9]).as_matrix(), np.array([0.3, -0.2, 0.1])


def steady(tau):
    """Turn (n,3) at row times (n,) of a camera that does not shake."""
    return np.zeros((len(tau), 3))


def project(state, points, direction="top_to_bottom", swing=steady, extra=(0, 0, 0), seat=ALONE):
    """Rays (n,2) and row times (n,) at which each point is seen by its own row.

    ``swing`` turns the camera, or its rig, beside its motion, and ``extra`` (3,) once more, the
    same at all rows.
    """
    tau = np.zeros(len(points))
    for _ in range(200):
        t = tau[:, None]
        angle = t * state[12:15] + 0.5 * t**2 * state[18:21]
        way = t * state[15:18] + 0.5 * t**2 * state[21:24]
        moved = points @ state[:9].reshape(3, 3).T + state[9:12] - way
        turn = Rotation.from_rotvec(angle) * Rotation.from_rotvec(swing(tau))
        seen = (turn * Rotation.from_rotvec(extra)).inv().apply(moved)
        seen = (seen - seat[1]) @ seat[0].T
        rays = seen[:, :2] / seen[:, 2:]
        later = row_time(pixels_of(rays), direction)
        if np.abs(later - tau).max() < 1e-15:
            break
        tau = later
    return rays, tau
