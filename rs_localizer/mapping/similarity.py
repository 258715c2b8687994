"""Similarities: how a map in its own units and axes lies in another frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.trajectory.spline import Spline

# Points whose spread across their best line is less than this share of that along it leave the
# rotation about the line open.
_FLAT = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """``x -> scale rotation x + translation``."""

    scale: float
    rotation: Array  # (3,3)
    translation: Array  # (3,)

    def __call__(self, points: Array) -> Array:
        """Points (n,3) in the other frame."""
        moved: Array = self.scale * points @ self.rotation.T + self.translation
        return moved

    def moved(self, spline: Spline) -> Spline:
        """A motion, as it is in the other frame."""
        return Spline(spline.layout, self.rotation @ spline.rotations, self(spline.positions))

    def covariances(self, before: Array) -> Array:
        """Covariances of points (n,3,3) in the other frame."""
        after: Array = self.scale**2 * self.rotation @ before @ self.rotation.T
        return after


def scaled(factor: float) -> Similarity:
    """Everything becomes larger about the origin."""
    return Similarity(factor, np.eye(3), np.zeros(3))


def through(points: Array, there: Array) -> Similarity:
    """The similarity that brings points (n,3) to places (n,3), with the least squared distances.

    S. Umeyama, Least-squares estimation of transformation parameters between two point patterns,
    PAMI 1991.

    Raises:
        ValueError: for fewer than three points, or points on a line.
    """
    if len(points) < 3:
        raise ValueError(f"three points or more determine a frame and its scale, got {len(points)}")
    middle, other = points.mean(axis=0), there.mean(axis=0)
    x, y = points - middle, there - other
    u, spread, vt = np.linalg.svd(y.T @ x / len(x))
    if spread[1] < _FLAT * spread[0]:
        raise ValueError("points on one line do not determine a frame")
    signs = np.array([1.0, 1.0, np.linalg.det(u @ vt)])
    rotation = (u * signs) @ vt
    scale = float(spread @ signs / np.mean(np.sum(x**2, axis=1)))
    return Similarity(scale, rotation, other - scale * rotation @ middle)


def upright(down: Array) -> Array:
    """The rotation (3,3) that turns a direction (3,) by the shortest way to ``-z``."""
    unit = down / np.linalg.norm(down)
    axis = np.cross(unit, [0.0, 0.0, -1.0])
    cosine = float(-unit[2])
    if cosine < -1.0 + 1e-12:  # upside down: any horizontal axis will do
        return np.diag([1.0, -1.0, -1.0])
    hat = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    turn: Array = np.eye(3) + hat + hat @ hat / (1.0 + cosine)
    return turn
