"""What is known of the motion before the image: Gaussian priors and the direction of gravity."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.core.arrays import Array
from rs_localizer.core.lens import LensError
from rs_localizer.core.scales import Scales
from rs_localizer.core.shutter import Motion
from rs_localizer.estimation.prior_checks import check_covariance, check_motion

_LEAST_DEVIATION = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What else is known of one frame; give any of the three.

    Args:
        motion, covariance: expected motion and its (12,12) covariance, in the order of
            ``Estimate.covariance``, or (18,18) with its accelerations, in the order of
            ``Estimate.joint_covariance``; infinite variances leave a parameter free.
        angular_velocity, angular_velocity_deviation: a gyroscope's body rate (3,) in camera axes
            times the readout time (rad per readout), and its standard deviation.
        scales: what the frames before say of shaking, smooth errors and speed.
        of_rest: logarithm of the odds that the camera does not move within the image, beside
            those of any camera.
        lens: what the calibration lacks, by other frames; None: nothing.
        asks_lens: whether the frame shall say what it lacks.
        gravity, gravity_deviation: a vector (3,) in camera axes at the middle row that points
            along ``gravity_in_map``, of any length, and the standard deviation of its direction
            in rad.

    Raises:
        ValueError: wrong shapes, values that are not finite, deviations that are not positive.
    """

    motion: Motion | None = None
    covariance: Array | None = None
    angular_velocity: ArrayLike | None = None
    angular_velocity_deviation: float = math.nan
    gravity: ArrayLike | None = None
    gravity_deviation: float = math.nan
    gravity_in_map: ArrayLike = (0.0, 0.0, -1.0)
    scales: Scales | None = None
    of_rest: float = 0.0
    lens: LensError | None = None
    asks_lens: bool = False

    def __post_init__(self) -> None:
        if (self.motion is None) != (self.covariance is None):
            raise ValueError("a prior motion and its covariance go together")
        if self.motion is not None and self.covariance is not None:
            check_motion(self.motion)
            check_covariance(np.asarray(self.covariance, float))
        for name in ("angular_velocity", "gravity", "gravity_in_map"):
            vector = getattr(self, name)
            if vector is None:
                continue
            array = np.array(vector, dtype=np.float64)
            if array.shape != (3,) or not np.all(np.isfinite(array)):
                raise ValueError(f"{name} must be three finite numbers, got {vector!r}")
            if name != "angular_velocity" and not np.abs(array).max() > 0.0:
                raise ValueError(f"{name} has no direction: {vector!r}")
            deviation = getattr(self, f"{name}_deviation", 1.0)
            if not _LEAST_DEVIATION <= deviation < math.inf:
                raise ValueError(
                    f"{name}_deviation must be at least {_LEAST_DEVIATION:g} and finite, "
                    f"got {deviation}"
                )


def state_in(motion: Motion, centre: Array) -> Array:
    """State (24,) of a motion for points taken relative to ``centre`` (3,)."""
    rotation = np.asarray(motion.rotation, float)
    translation = motion.translation + rotation @ centre
    return np.concatenate(
        [
            rotation.ravel(), translation, motion.angular_velocity, motion.linear_velocity,
            motion.angular_acceleration, motion.linear_acceleration,
        ]
    )  # fmt: skip
