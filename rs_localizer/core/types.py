"""What passes between the stages and out of the library."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.shutter import Motion
from rs_localizer.core.so3 import Array

BoolArray = NDArray[np.bool_]


class Reason(StrEnum):
    """Why a frame has no pose."""

    TOO_FEW_POINTS = "too_few_points"
    NO_HYPOTHESIS = "no_hypothesis"
    TOO_FEW_INLIERS = "too_few_inliers"
    BEHIND_CAMERA = "behind_camera"
    RESIDUAL = "residual"
    DEGENERATE = "degenerate"
    IMPLAUSIBLE = "implausible"
    MIRRORED = "mirrored"


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Estimate(Motion):
    """An accepted pose and velocity; true in a condition.

    ``covariance`` orders its 12 rows: rotation (the camera turns by exp of it, in its own axes),
    camera position in camera axes, angular velocity, linear velocity; units as the fields.
    """

    inliers: BoolArray  # (n,)
    residuals: Array  # (n,) reprojection error in raw pixels, NaN where a point was unusable
    covariance: Array  # (12,12)
    global_shutter_inliers: int  # of the best global-shutter pose, at the same threshold
    iterations: int  # minimal samples drawn
    tracked: bool = False  # found near a prior motion, without a search

    @property
    def position(self) -> Array:
        """Camera centre (3,) in the map frame at tau = 0."""
        centre: Array = -self.rotation.T @ self.translation
        return centre

    @property
    def residual_rms(self) -> float:
        """Root mean square reprojection error of the inliers, in pixels."""
        return float(np.sqrt(np.mean(self.residuals[self.inliers] ** 2)))

    def __bool__(self) -> Literal[True]:
        return True

    def __repr__(self) -> str:
        turn = np.degrees(np.linalg.norm(self.angular_velocity))
        return (
            f"Estimate(position={np.round(self.position, 4).tolist()}, "
            f"{np.count_nonzero(self.inliers)} of {len(self.inliers)} inliers at "
            f"{self.residual_rms:.3g} px rms, {turn:.3g} deg and "
            f"{np.linalg.norm(self.linear_velocity):.3g} m per readout)"
        )


@dataclass(frozen=True, slots=True)
class Failure:
    """No pose, and why; false in a condition."""

    reason: Reason
    detail: str  # one sentence with the figures

    def __bool__(self) -> Literal[False]:
        return False

    def __str__(self) -> str:
        return f"{self.reason}: {self.detail}"
