# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of prints in known poses, drawn without the package's own code."""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

K = np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
# How finely an image is rendered before it is shrunk, and pixels per cell of a drawn print.
_FINE, _DRAWN = 4, 12


def look(
    roll: float = 0.0, tilt: float = 15.0, distance: float = 0.35, x: float = 0.0, y: float = 0.0
) -> tuple[Array, Array]:
    """Rotation (3,3), translation (3,) camera_from_map of a camera before the origin's front.

    The map's x is right, its y up, its z toward the camera; the print turns clockwise by roll.
    """
    turn = Rotation.from_euler("ZYX", [roll, tilt, -0.7 * tilt], degrees=True).as_matrix()
    return turn @ np.diag([1.0, -1.0, -1.0]), np.array([x, y, distance])


def project(points: Array, pose: tuple[Array, Array]) -> Array:
    rotation, translation = pose
    seen = (points @ rotation.T + translation) @ K.T
    return seen[:, :2] / seen[:, 2:]


def render(
    prints: list[tuple[NDArray[np.bool_], Array]],
    pose: tuple[Array, Array],
    *,
    blur: float = 0.5,
    noise: float = 0.0,
    seed: int = 0,
) -> NDArray[np.uint8]:
    """The image (240,320) of prints: cells (true is white), corners (4,3) from the top left."""
    big = np.full((240 * _FINE, 320 * _FINE), 190, np.uint8)
    fine = np.array([[_FINE, 0, (_FINE - 1) / 2], [0, _FINE, (_FINE - 1) / 2], [0, 0, 1.0]])
    for cells, corners in prints:
        cells = np.pad(cells, 1, constant_values=True)  # the white rim
        rows, columns = (n - 2 for n in cells.shape)
        drawn = np.kron(np.where(cells, 230, 20), np.ones((_DRAWN, _DRAWN))).astype(np.uint8)
        # The corners of the inner cells, in pixels of the drawing whose first centre is 0, 0.
        inner = np.array([[0, 0], [columns, 0], [columns, rows], [0, rows]]) + 1.0
        source = (inner * _DRAWN - 0.5).astype(np.float32)
        to_image = cv2.getPerspectiveTransform(source, project(corners, pose).astype(np.float32))
        size = (big.shape[1], big.shape[0])
        warped = cv2.warpPerspective(drawn, fine @ to_image, size, flags=cv2.INTER_LINEAR)
        inside = cv2.warpPerspective(
            np.full_like(drawn, 255), fine @ to_image, size, flags=cv2.INTER_NEAREST
        )
        big[inside > 0] = warped[inside > 0]
    image = cv2.GaussianBlur(
        cv2.resize(big, (320, 240), interpolation=cv2.INTER_AREA), (0, 0), blur
    )
    if noise:
        disturbed = image + np.random.default_rng(seed).normal(0.0, noise, image.shape)
        image = np.clip(np.rint(disturbed), 0, 255).astype(np.uint8)
    return np.asarray(image, np.uint8)


def chessboard_cells(columns: int, rows: int) -> NDArray[np.bool_]:
    """Squares of a board by its squares; the top left one is black."""
    y, x = np.mgrid[:rows, :columns]
    return np.asarray((x + y) % 2 == 1)


def rectangle(width: float, height: float) -> Array:
    """Corners (4,3) of a print around the origin of the map, from the top left clockwise."""
    x, y = 0.5 * width, 0.5 * height
    return np.array([[-x, y, 0], [x, y, 0], [x, -y, 0], [-x, -y, 0]])
