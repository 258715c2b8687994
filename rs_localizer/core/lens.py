"""Distortion that a calibration lacks.

Most of what a calibration may have wrong is radial: an image point at ``r`` from the axis moves
along the radius by ``r (a r^2 + b r^4)``; a little is tangential, ``c`` and ``d`` (Brown,
"Close-range camera calibration", 1971). ``equidistant`` lenses have powers of the angle, and
nothing tangential. Distances are in parts of that of the image's corner, so that the coefficients
of all cameras are of one size.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera, DistortionModel

# No model has fewer coefficients; k1, k2 stand first in all, and p1, p2 behind them.
_FEWEST = 4
_RADII = np.linspace(0.0, 1.0, 21)


@dataclass(frozen=True, slots=True, eq=False)
class LensError:
    """What distortion a calibration lacks: a Gaussian of its coefficients, two or four."""

    mean: Array  # (k,) of a, b, c, d
    covariance: Array  # (k,k)
    corner: float  # px, distance of the image's corners, see corner_of

    def mended(self, camera: Camera) -> Camera:
        """The camera with the distortion that it lacks."""
        return with_distortion(camera, self.mean)

    @property
    def pixels(self) -> float:
        """How far (px) the radial part moves the image points that it moves farthest."""
        a, b = self.mean[:2]
        return float(self.corner * np.abs(a * _RADII**3 + b * _RADII**5).max())


def corner_of(camera: Camera) -> float:
    """Distance of the image's corners from its middle, in focal lengths.

    A region of the sensor may lie far from the axis: then that of its farthest corner from there.
    """
    roi, K = camera.roi, camera.K
    if roi is None:
        return float(0.5 * np.hypot(*camera.size) / camera.focal_length)
    across = np.array([roi.x_offset, roi.x_offset + roi.width]) - K[0, 2]
    down = np.array([roi.y_offset, roi.y_offset + roi.height]) - K[1, 2]
    return float(np.hypot(np.abs(across).max() / K[0, 0], np.abs(down).max() / K[1, 1]))


def coefficients_of(camera: Camera) -> int:
    """How many coefficients may be off."""
    return 2 if _model_of(camera) == DistortionModel.EQUIDISTANT else 4


def with_distortion(camera: Camera, coefficients: Array) -> Camera:
    """The camera with coefficients (k,) beside its own."""
    distortion = _distortion_of(camera)
    count = len(coefficients)
    distortion[:count] += coefficients / _scales_of(camera)[:count]
    return replace(camera, D=distortion, distortion_model=_model_of(camera))


def by_distortion(camera: Camera, rays: Array) -> Array:
    """Derivatives (n,2,k) of the pixels of rays (n,2) by all coefficients."""
    count, zero, found = coefficients_of(camera), np.zeros(3), _distortion_of(camera)
    bearings = np.column_stack([rays, np.ones(len(rays))])[:, None]
    if _model_of(camera) == DistortionModel.EQUIDISTANT:
        first = 4  # behind focal lengths and centre
        jacobian = cv2.fisheye.projectPoints(bearings, zero, zero, camera.K, found)[1]
    else:
        first = 10  # and behind the pose
        jacobian = cv2.projectPoints(bearings, zero, zero, camera.K, found)[1]
    columns = jacobian.reshape(len(rays), 2, -1)[:, :, first : first + count]
    scaled: Array = columns / np.outer(camera.binning, _scales_of(camera))
    return scaled


def _model_of(camera: Camera) -> str:
    """Whose coefficients may be off: a camera without any is a pinhole, whatever its model."""
    return camera.distortion_model if len(camera.D) else DistortionModel.PLUMB_BOB


def _distortion_of(camera: Camera) -> Array:
    return camera.D.copy() if len(camera.D) else np.zeros(_FEWEST)


def _scales_of(camera: Camera) -> Array:
    """What the coefficients (k,) are in parts of OpenCV's."""
    corner = corner_of(camera)
    return np.array([corner**2, corner**4, corner, corner])[: coefficients_of(camera)]
