"""From frame to frame: the last motion predicts the next, and its prior makes the next better.

A single image sees the camera's velocity only through the shutter, and the linear part badly; two
poses a frame apart show it well. The tracker is the extended Kalman filter that brings both
together: its state is the camera's pose and velocities with their covariance, its motion model
constant velocities under random accelerations, its measurement update the localizer's maximum a
posteriori estimate with the prediction as prior (an iterated update).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.config import Acceleration
from rs_localizer.core import so3
from rs_localizer.core.prior import Prior
from rs_localizer.core.shutter import Motion
from rs_localizer.core.so3 import Array
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.localizer import Localizer
from rs_localizer.solvers import find_solver

# A prediction over a longer gap (s) says less than a fresh search costs.
_LONGEST_GAP = 0.5
# Frames in a row without a pose after which the track is given up.
_MOST_FAILURES = 5
# Share of inliers of the last frames: weight of the newest.
_NEWEST = 0.3

# Blocks of the covariance: camera turn, camera position, angular, linear velocity.
_PHI, _RHO, _OMEGA, _V = (slice(k, k + 3) for k in (0, 3, 6, 9))


def predict(motion: Motion, covariance: Array, readouts: float) -> tuple[Motion, Array]:
    """The motion and its covariance (12,12) some readout times later, at constant velocities.

    The pose moves on by ``R exp(readouts omega)`` and ``c + readouts R v``; all four parts of the
    error are carried to first order into the camera axes of then.
    """
    rotation, translation = motion.at(readouts)
    velocity = motion.linear_velocity_at(readouts)
    later = Motion(rotation, translation, motion.angular_velocity, velocity)
    back = so3.exp(-readouts * motion.angular_velocity)  # then_from_now
    turned = readouts * so3.right_jacobian(readouts * motion.angular_velocity)
    transport = np.eye(12)
    transport[_PHI, _PHI] = back
    transport[_PHI, _OMEGA] = turned
    transport[_RHO, _RHO] = back
    transport[_RHO, _PHI] = -readouts * back @ so3.hat(motion.linear_velocity)
    transport[_RHO, _V] = readouts * back
    transport[_V, _V] = back
    transport[_V, _OMEGA] = so3.hat(velocity) @ turned
    return later, transport @ covariance @ transport.T


def acceleration_covariance(acceleration: Acceleration, dt: float, readout_time: float) -> Array:
    """Covariance (12,12) that random accelerations add to a prediction over ``dt`` s.

    Those of white noise that changes the velocity by the deviation times ``dt``. An acceleration
    that is constant from frame to frame would tie the change of velocity to the way, and where the
    poses are sharp the filter then rings: it takes every deviation of the way twice, to and fro.
    """
    block = np.array(
        [[dt**2 / 3.0, 0.5 * dt * readout_time], [0.5 * dt * readout_time, readout_time**2]]
    )
    block *= dt**2
    covariance = np.zeros((12, 12))
    for deviation, pose, velocity in (
        (acceleration.angular, _PHI, _OMEGA),
        (acceleration.linear, _RHO, _V),
    ):
        for i, rows in enumerate((pose, velocity)):
            for j, columns in enumerate((pose, velocity)):
                covariance[rows, columns] = deviation**2 * block[i, j] * np.eye(3)
    return covariance


@dataclass(slots=True)
class _Track:
    """What is remembered of the last frame with a pose."""

    estimate: Estimate
    time_ns: int
    share: float  # of inliers among the points
    failures: int = 0  # frames without a pose since then


class Tracker:
    """Localizes the frames of one camera in their order.

    Args:
        localizer: its camera must have a readout time, because the velocities of one image are
            per readout, and its solver must be one for rolling shutters, because a global shutter
            knows no velocities.
        acceleration: standard deviations of the camera's accelerations.

    Raises:
        ValueError: without a readout time, or with a global-shutter solver.
    """

    def __init__(self, localizer: Localizer, acceleration: Acceleration) -> None:
        if not localizer.camera.readout_time > 0.0:
            raise ValueError("tracking needs the readout time of the camera, which is 0 (unknown)")
        if not find_solver(localizer.config.solver).rolling_shutter:
            raise ValueError(
                f"tracking needs velocities, which solver {localizer.config.solver} does not find"
            )
        self.localizer = localizer
        self.acceleration = acceleration
        self._track: _Track | None = None

    def reset(self) -> None:
        """Forget all frames so far."""
        self._track = None

    def prediction(self, time_ns: int) -> Prior | None:
        """What the last frames say of the motion at a time; None when there is no track."""
        track = self._track
        if track is None:
            return None
        dt = (time_ns - track.time_ns) * 1e-9
        if not 0.0 < dt <= _LONGEST_GAP:
            return None
        readout_time = self.localizer.camera.readout_time
        motion, covariance = predict(track.estimate, track.estimate.covariance, dt / readout_time)
        covariance = covariance + acceleration_covariance(self.acceleration, dt, readout_time)
        return Prior(motion=motion, covariance=covariance)

    def localize(
        self, time_ns: int, points: ArrayLike, pixels: ArrayLike, scores: ArrayLike | None = None
    ) -> Estimate | Failure:
        """Localize the frame whose middle row was exposed at ``time_ns``.

        Arguments, result and errors otherwise as :meth:`Localizer.localize`. A time that does not
        follow the last one (a bag that starts over), a gap, or failures in a row end the track.
        """
        prior = self.prediction(time_ns)
        if prior is None:
            self._track = None
        share = 0.0 if self._track is None else self._track.share
        result = self.localizer.localize(points, pixels, scores, prior, share)
        if not result:
            if self._track is not None:
                self._track.failures += 1
                if self._track.failures >= _MOST_FAILURES:
                    self._track = None
            return result
        found = float(np.mean(result.inliers))
        if result.tracked:
            found = (1.0 - _NEWEST) * share + _NEWEST * found
        self._track = _Track(result, time_ns, found)
        return result
