# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Estimators that others use: one pose per image, no shutter. OpenCV, and PoseLib by its wheel."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any, Literal

import cv2
import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion

_THRESHOLD = 3.0  # px of an inlier: what both call a good default
_FEWEST = 4  # points of a pose


@dataclass(frozen=True, slots=True, eq=False)
class GlobalPose(Motion):
    """A pose of the whole image; true in a condition, as an ``Estimate``."""

    residuals: Array  # (n,) px
    turn_covariance: Array  # (3,3) rad^2, of least squares on the inliers

    @property
    def position(self) -> Array:
        """Camera centre (3,) in the map frame, m."""
        return np.asarray(-self.rotation.T @ self.translation)

    def __bool__(self) -> Literal[True]:
        return True


Peer = Callable[[Camera, Array, Array], GlobalPose | None]


def solve_pnp(camera: Camera, points: Array, pixels: Array) -> GlobalPose | None:
    """SQPNP, then Levenberg and Marquardt: on all points."""
    return _refined(camera, points, pixels, np.ones(len(points), np.bool_))


def solve_pnp_ransac(camera: Camera, points: Array, pixels: Array) -> GlobalPose | None:
    """``solvePnPRansac`` by SQPNP, then Levenberg and Marquardt on its inliers."""
    if len(points) < _FEWEST:
        return None
    cv2.setRNGSeed(0)
    good, _, _, inliers = cv2.solvePnPRansac(
        points, pixels, camera.K, camera.D, reprojectionError=_THRESHOLD, flags=cv2.SOLVEPNP_SQPNP
    )
    if not good or inliers is None:
        return None
    chosen = np.zeros(len(points), np.bool_)
    chosen[inliers.ravel()] = True
    return _refined(camera, points, pixels, chosen)


def poselib(camera: Camera, points: Array, pixels: Array) -> GlobalPose | None:
    """PoseLib's ``estimate_absolute_pose``: LO-RANSAC of P3P, refined by a robust loss.

    Raises:
        ImportError: without the wheel ``poselib`` (``pip install rs-localizer[peers]``).
    """
    import poselib as library

    lens = np.zeros(4)
    lens[: min(len(camera.D), 4)] = camera.D[:4]
    K = camera.K
    model = {
        "model": "OPENCV", "width": camera.width, "height": camera.height,
        "params": [K[0, 0], K[1, 1], K[0, 2], K[1, 2], *lens],
    }  # fmt: skip
    limits = {"max_reproj_error": _THRESHOLD}
    pose, found = library.estimate_absolute_pose(pixels, points, model, limits, {})
    inliers = np.asarray(found["inliers"], np.bool_)
    if inliers.sum() < _FEWEST:
        return None
    turn = cv2.Rodrigues(pose.R)[0]
    return _pose(camera, points, pixels, inliers, turn, np.asarray(pose.t, float))


PEERS: dict[str, Peer] = {"solvepnp": solve_pnp}
if find_spec("poselib") is not None:
    PEERS["poselib"] = poselib


def _refined(camera: Camera, points: Array, pixels: Array, chosen: BoolArray) -> GlobalPose | None:
    if chosen.sum() < _FEWEST:
        return None
    picked = points[chosen], pixels[chosen], camera.K, camera.D
    good, turn, move = cv2.solvePnP(*picked, flags=cv2.SOLVEPNP_SQPNP)
    if not good:
        return None
    turn, move = cv2.solvePnPRefineLM(*picked, turn, move)
    return _pose(camera, points, pixels, chosen, turn, move)


def _pose(
    camera: Camera, points: Array, pixels: Array, chosen: BoolArray, turn: Any, move: Any
) -> GlobalPose:
    shown, slopes = cv2.projectPoints(points, turn, move, camera.K, camera.D)
    errors = shown[:, 0] - pixels
    by_pose = slopes[:, :6].reshape(-1, 2, 6)[chosen].reshape(-1, 6)
    freedom = max(len(by_pose) - 6, 1)
    variance = float(np.sum(errors[chosen] ** 2)) / freedom
    rotation, translation = cv2.Rodrigues(turn)[0], np.asarray(move, float).ravel()
    covariance = variance * np.linalg.inv(by_pose.T @ by_pose)[:3, :3]
    residuals, rest = np.linalg.norm(errors, axis=1), (np.zeros(3), np.zeros(3))
    return GlobalPose(np.asarray(rotation, float), translation, *rest, residuals, covariance)
