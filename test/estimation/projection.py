# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A rolling-shutter camera of the tests' own: SciPy's rotations and NumPy, nothing of the package.

A motion is a dictionary of what stands in a state, and the shaking's coefficients (k,3).
"""

import numpy as np
from scipy.spatial.transform import Rotation

# Skewed and with a lens, so that the derivative of a pixel by its ray is no diagonal matrix.
MATRIX = np.array([[600.0, 40.0, 319.5], [25.0, 580.0, 239.5]])
RADIAL, SIZE = -0.12, (640, 480)
AXIS = {"top_to_bottom": (1, 1), "bottom_to_top": (1, -1),
        "left_to_right": (0, 1), "right_to_left": (0, -1)}  # fmt: skip


def waves(tau, count):
    """(n,count): a cosine and a sine per half-cycle of the readout, less value and slope at 0."""
    angle = np.pi * np.arange(1, count // 2 + 1) * np.asarray(tau)[:, None]
    pairs = np.stack([np.cos(angle) - 1.0, np.sin(angle) - angle], axis=-1)
    return pairs.reshape(len(tau), -1)[:, :count]


def shake(tau, coefficients):
    return waves(tau, len(coefficients)) @ coefficients


def disturbed(state, step):
    """The state (24,) after a step (18,): the camera turns and moves in its own axes."""
    turn = Rotation.from_rotvec(-step[:3]).as_matrix()
    rotation, translation = state[:9].reshape(3, 3), state[9:12]
    return np.concatenate(
        [(turn @ rotation).ravel(), turn @ (translation - step[3:6]), state[12:] + step[6:]]
    )


def pixels_of(rays):
    """Distorted pixels (n,2) of rays (n,2)."""
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


def in_camera(state, tau, points, extra):
    """Points (n,3) in the camera at row times (n,), turned by extra (n,3) beside the motion."""
    tau = tau[:, None]
    angle = tau * state[12:15] + 0.5 * tau**2 * state[18:21]
    way = tau * state[15:18] + 0.5 * tau**2 * state[21:24]
    moved = points @ state[:9].reshape(3, 3).T + state[9:12] - way
    return Rotation.from_rotvec(-extra).apply(Rotation.from_rotvec(-angle).apply(moved))


STILL = np.zeros((0, 3))
ALONE = np.eye(3), np.zeros(3)
# Axes and centre of a camera in its rig: nearly upside down, with a lever arm.
MOUNTED = Rotation.from_rotvec([0.1, -0.05, 2.9]).as_matrix(), np.array([0.3, -0.2, 0.1])


def project(state, points, direction, coefficients=STILL, extra=0.0, seat=ALONE):
    """Rays (n,2) and row times (n,) at which each point is seen by its own row.

    ``extra`` turns (n,3) or (3,) the camera, or its rig, once more, the same at all rows.
    """
    tau = np.zeros(len(points))
    for _ in range(200):
        swing = Rotation.from_rotvec(shake(tau, coefficients))
        turn = (swing * Rotation.from_rotvec(extra * np.ones((len(points), 3)))).as_rotvec()
        seen = (in_camera(state, tau, points, turn) - seat[1]) @ seat[0].T
        rays = seen[:, :2] / seen[:, 2:]
        later = row_time(pixels_of(rays), direction)
        if np.abs(later - tau).max() < 1e-15:
            break
        tau = later
    return rays, tau


def scene(direction, seed=0, count=40, speed=0.2, acceleration=0.1):
    """State (24,) and points (n,3) well inside the image."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    state = np.concatenate(
        [rotation.ravel(), [0.05, -0.1, 4.0], speed * rng.normal(size=6),
         acceleration * rng.normal(size=6)]
    )  # fmt: skip
    local = np.column_stack([rng.uniform(-2.0, 2.0, (8 * count, 2)), rng.uniform(-1, 1, 8 * count)])
    points = local @ rotation  # about the centre of the map
    seen = pixels_of(project(state, points, direction)[0])
    inside = np.flatnonzero(np.all((seen > 20) & (seen < np.array(SIZE) - 20), axis=1))[:count]
    assert len(inside) == count
    return state, points[inside]
