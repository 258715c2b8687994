"""The pose of a global shutter, from corners whose rays are known: for checks, not for results."""

from __future__ import annotations

import cv2
import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera


def still_pose(points: Array, rays: Array) -> tuple[Array, Array] | None:
    """Rotation (3,3) and translation (3,) camera_from_map that fit best; None: there are none.

    Args:
        points: (n,3) m, map frame.
        rays: (n,2) undistorted bearings.
    """
    try:
        solved, rotation, translation = cv2.solvePnP(
            points, np.ascontiguousarray(rays), np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:
        return None
    if not solved:
        return None
    turn = np.asarray(cv2.Rodrigues(rotation)[0], np.float64)
    return turn, np.asarray(translation, np.float64).ravel()


def still_errors(camera: Camera, pose: tuple[Array, Array], points: Array, pixels: Array) -> Array:
    """From where the pixels (n,2) are to where a pose puts the points (n,3): px."""
    return camera.project(points @ pose[0].T + pose[1]) - pixels


def rms(errors: Array) -> float:
    """Root mean square of the lengths of errors (n,2)."""
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
