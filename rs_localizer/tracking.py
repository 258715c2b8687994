"""From frame to frame: the last motion predicts the next, and its prior makes the next better.

A single image sees the camera's velocity only through the shutter, and the linear part badly; two
poses a frame apart show it well. The tracker is the extended Kalman filter that brings both
together: its state is the camera's pose, velocities and accelerations with their covariance, its
motion model accelerations that fade within a tenth of a second while new ones come (Singer,
"Estimating optimal tracking filter performance for manned maneuvering targets", 1970), its
measurement update the localizer's maximum a posteriori estimate with the prediction as prior (an
iterated update). A gyroscope takes the place of the motion model's rotation where there is one
(:mod:`rs_localizer.inertial.aiding`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.config import Acceleration
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.known_turn import KnownTurn
from rs_localizer.core.shake import shake_in_the_middle
from rs_localizer.core.shutter import Motion
from rs_localizer.core.state import (
    ANGULAR,
    ANGULAR_ACCELERATION,
    LINEAR,
    LINEAR_ACCELERATION,
    MOVE,
    PARAMETERS,
    TURN,
)
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.prior import Prior, state_in
from rs_localizer.estimation.refine import step_between
from rs_localizer.inertial.aiding import Before, Foreseen, GyroscopeAid
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.settings import InertialSettings
from rs_localizer.inertial.status import InertialStatus
from rs_localizer.localizer import Localizer
from rs_localizer.solvers.table import find_solver

# A prediction over a longer gap (s) says less than a fresh search costs.
_LONGEST_GAP = 0.5
# Frames in a row without a pose after which the track is given up.
_MOST_FAILURES = 5
# Share of inliers of the last frames: weight of the newest.
_NEWEST = 0.3
# Time (s) in which accelerations fade: hands and drones change them about twice a second.
_FADING = 0.1
# What a frame says of shaking and model error fades by this from frame to frame, and counts as part
# of what an independent frame would say: the next frame shows much the same.
_MEMORY = 0.95
_INDEPENDENT = 0.3
# How fast surprises change the accelerations that are expected (exponent), and how much at most.
_LEARNING = 0.2
_MOST_JOLTS = 1e4
# Below this part of the time of fading the closed form of the noise is rounding errors.
_SHORT = 0.03
# The least angular acceleration there is, rad/s^2: turns are told by a gyroscope.
_NO_TURN = 0.001
_IDENTITY = np.eye(3)


def predict(
    motion: Motion, covariance: Array, readouts: float, fading: float
) -> tuple[Motion, Array]:
    """The motion and its covariance (18,18) some readout times later.

    Accelerations fade by ``exp(-1)`` in ``fading`` readouts. The pose moves on by ``R exp(theta)``
    and ``c + R way``; all parts of the error are carried to first order into the camera axes of
    then.
    """
    left = math.exp(-readouts / fading)
    # What a unit of acceleration adds to the velocity and to the way.
    faster = fading * (1.0 - left)
    farther = fading * (readouts - faster)
    angle = readouts * motion.angular_velocity + farther * motion.angular_acceleration
    way = readouts * motion.linear_velocity + farther * motion.linear_acceleration
    back = so3.exp(-angle)  # then_from_now
    turned = so3.right_jacobian(angle)
    velocity = back @ (motion.linear_velocity + faster * motion.linear_acceleration)
    later = Motion(
        back @ motion.rotation,
        back @ (motion.translation - way),
        turned @ (motion.angular_velocity + faster * motion.angular_acceleration),
        velocity,
        angular_acceleration=left * motion.angular_acceleration,
        linear_acceleration=left * back @ motion.linear_acceleration,
    )
    transport = np.eye(PARAMETERS)
    transport[TURN, TURN] = back
    transport[TURN, ANGULAR] = readouts * turned
    transport[TURN, ANGULAR_ACCELERATION] = farther * turned
    transport[MOVE, MOVE] = back
    transport[MOVE, TURN] = -back @ so3.hat(way)
    transport[MOVE, LINEAR] = readouts * back
    transport[MOVE, LINEAR_ACCELERATION] = farther * back
    # Without acceleration the body rate stays what it is, however far the camera turns.
    mean = farther / readouts
    transport[ANGULAR, ANGULAR_ACCELERATION] = mean * np.eye(3) + (faster - mean) * turned
    transport[LINEAR, LINEAR] = back
    transport[LINEAR, LINEAR_ACCELERATION] = faster * back
    transport[LINEAR, ANGULAR] = readouts * so3.hat(velocity) @ turned
    transport[LINEAR, ANGULAR_ACCELERATION] = farther * so3.hat(velocity) @ turned
    transport[ANGULAR_ACCELERATION, ANGULAR_ACCELERATION] = left * np.eye(3)
    transport[LINEAR_ACCELERATION, LINEAR_ACCELERATION] = left * back
    return later, transport @ covariance @ transport.T


def acceleration_covariance(acceleration: Acceleration, dt: float, readout_time: float) -> Array:
    """Covariance (18,18) that new accelerations add to a prediction over ``dt`` s.

    The deviations are those of the accelerations themselves, at any time (Singer's model in closed
    form).
    """
    x = dt / _FADING
    if x < _SHORT:
        # White noise on the acceleration, to first order.
        upper = [[x**5 / 10.0, x**4 / 4.0, x**3 / 3.0], [0.0, 2.0 * x**3 / 3.0, x**2]]
        last = 2.0 * x
    else:
        e, e2 = math.exp(-x), math.exp(-2.0 * x)
        upper = [
            [
                1.0 - e2 + 2.0 * x + 2.0 * x**3 / 3.0 - 2.0 * x**2 - 4.0 * x * e,
                e2 + 1.0 - 2.0 * e + 2.0 * x * e - 2.0 * x + x**2,
                1.0 - e2 - 2.0 * x * e,
            ],
            [0.0, 4.0 * e - 3.0 - e2 + 2.0 * x, e2 + 1.0 - 2.0 * e],
        ]
        last = 1.0 - e2
    block = np.array([*upper, [0.0, 0.0, last]])
    block = np.triu(block) + np.triu(block, 1).T
    # Way, velocity per readout and acceleration per readout squared of a unit acceleration.
    units = np.array([_FADING**2, _FADING * readout_time, readout_time**2])
    block *= np.outer(units, units)
    covariance = np.zeros((PARAMETERS, PARAMETERS))
    angular, linear = (TURN, ANGULAR, ANGULAR_ACCELERATION), (MOVE, LINEAR, LINEAR_ACCELERATION)
    for deviation, parts in ((acceleration.angular, angular), (acceleration.linear, linear)):
        for i, rows in enumerate(parts):
            for j, columns in enumerate(parts):
                covariance[rows, columns] = deviation**2 * block[i, j] * _IDENTITY
    return covariance


@cache
def _without_shaking(coefficients: int) -> Array:
    """Derivatives (18,18 + 3 k) of a motion without its shaking by motion and coefficients."""
    jacobian = np.eye(PARAMETERS, PARAMETERS + 3 * coefficients)
    if coefficients:
        values, slopes = shake_in_the_middle(coefficients)
        jacobian[TURN, PARAMETERS:] = -np.kron(values[None], np.eye(3))
        jacobian[ANGULAR, PARAMETERS:] = -np.kron(slopes[None], np.eye(3))
    return jacobian


def unshaken(estimate: Estimate) -> tuple[Motion, Array, Array]:
    """The motion without its shaking, its covariance (18,18), and that of the shaking.

    A camera that shakes is, in the middle row, somewhere on its swing; a frame later it is
    somewhere else on it. What a gyroscope knows of the turn is not in the motion, either.
    """
    values, slopes = shake_in_the_middle(len(estimate.shake))
    turn, rate = values @ estimate.shake, slopes @ estimate.shake
    # As if turned back in its own axes: exp(-[-turn]x) R.
    turned = so3.exp(turn)
    beside = estimate.beside_turn()
    motion = Motion(
        turned @ beside.rotation,
        turned @ beside.translation,
        beside.angular_velocity - rate,
        beside.linear_velocity,
        angular_acceleration=beside.angular_acceleration,
        linear_acceleration=beside.linear_acceleration,
    )
    jacobian = _without_shaking((len(estimate.joint_covariance) - PARAMETERS) // 3)
    swing = np.zeros((PARAMETERS, PARAMETERS))
    squares = np.mean(estimate.shake**2, axis=1)
    if len(squares):
        values, slopes = shake_in_the_middle(len(squares))
        swing[TURN, TURN] = (values**2 @ squares) * np.eye(3)
        swing[ANGULAR, ANGULAR] = (slopes**2 @ squares) * np.eye(3)
    return motion, jacobian @ estimate.joint_covariance @ jacobian.T, swing


def with_mean_turn(motion: Motion, covariance: Array, turn: KnownTurn) -> tuple[Motion, Array]:
    """A motion beside a known turn with the mean rate of that, for a camera that goes on alone.

    How much the rate changed within the readout, a gyroscope knows it to change in the next.
    """
    ends, rates = turn.at_rows(np.array([-0.5, 0.5]))
    mean = so3.log(np.ascontiguousarray(ends[0] @ ends[1].T))
    spread = np.zeros((PARAMETERS, PARAMETERS))
    spread[ANGULAR, ANGULAR] = np.mean((rates - mean) ** 2) * np.eye(3)
    faster = replace(motion, angular_velocity=motion.angular_velocity + mean)
    return faster, covariance + spread


@dataclass(slots=True)
class _Track:
    """What is remembered of the last frame with a pose."""

    estimate: Estimate
    time_ns: int
    share: float  # of inliers among the points
    of_shake_sizes: Array  # what all frames so far say of shaking and model error
    of_field_sizes: Array
    jolts: float  # how many times the configured accelerations, squared
    failures: int = 0  # frames without a pose since then


class Tracker:
    """Localizes the frames of one camera in their order.

    Args:
        localizer: its camera must have a readout time, because the velocities of one image are
            per readout, and its solver must be one for rolling shutters, because a global shutter
            knows no velocities.
        inertial: of the gyroscope whose samples come with the frames; None: there is none.

    Raises:
        ValueError: without a readout time, or with a global-shutter solver.
    """

    def __init__(self, localizer: Localizer, inertial: InertialSettings | None = None) -> None:
        if not localizer.camera.readout_time > 0.0:
            raise ValueError("tracking needs the readout time of the camera, which is 0 (unknown)")
        if not find_solver(localizer.config.solver).rolling_shutter:
            raise ValueError(
                f"tracking needs velocities, which solver {localizer.config.solver} does not find"
            )
        self.localizer = localizer
        self._track: _Track | None = None
        readout_time = localizer.camera.readout_time
        self._aid = None if inertial is None else GyroscopeAid(inertial, readout_time)
        if self._aid is not None:
            self._aid.warm_up()

    def reset(self) -> None:
        """Forget all frames so far."""
        self._track = None
        if self._aid is not None:
            self._aid.reset()

    @property
    def inertial(self) -> InertialStatus | None:
        """What became of the gyroscope; None without one."""
        return None if self._aid is None else self._aid.status

    def _follows(self, time_ns: int) -> bool:
        """Whether a time follows that of the last frame with a pose."""
        track = self._track
        return track is not None and 0.0 < (time_ns - track.time_ns) * 1e-9 <= _LONGEST_GAP

    def prediction(self, time_ns: int) -> Prior | None:
        """What the last frames say of the motion at a time; None when there is no track."""
        track = self._track
        if track is None or not self._follows(time_ns):
            return None
        dt = (time_ns - track.time_ns) * 1e-9
        readout_time = self.localizer.camera.readout_time
        acceleration = self.localizer.config.acceleration
        motion, covariance, swing = unshaken(track.estimate)
        if track.estimate.turn is not None:
            motion, covariance = with_mean_turn(motion, covariance, track.estimate.turn)
        motion, covariance = predict(motion, covariance, dt / readout_time, _FADING / readout_time)
        covariance += track.jolts * acceleration_covariance(acceleration, dt, readout_time)
        covariance += swing
        return Prior(
            motion=motion,
            covariance=covariance,
            of_shake_sizes=track.of_shake_sizes,
            of_field_sizes=track.of_field_sizes,
        )

    def localize(
        self,
        time_ns: int,
        points: ArrayLike,
        pixels: ArrayLike,
        scores: ArrayLike | None = None,
        imu: ImuSamples | None = None,
    ) -> Estimate | Failure:
        """Localize the frame whose middle row was exposed at ``time_ns``.

        Arguments, result and errors otherwise as :meth:`Localizer.localize`. A time that does not
        follow the last one (a bag that starts over), a gap, or failures in a row end the track.

        Args:
            imu: samples from before the last frame with a pose, if there are any, until after the
                exposure of this one; None: the camera goes alone.
        """
        if not self._follows(time_ns):
            self._track = None
        share = 0.0 if self._track is None else self._track.share

        def localized(foreseen: Foreseen | None) -> tuple[Estimate | Failure, Prior | None]:
            prior = self.prediction(time_ns) if foreseen is None else foreseen.prior
            turn = None if foreseen is None else foreseen.turn
            return self.localizer.localize(points, pixels, scores, prior, share, turn), prior

        if self._aid is None:
            result, prior = localized(None)
        else:
            result, prior = self._aid.localize(
                imu, time_ns, lambda: self._before(time_ns), localized
            )
        if not result:
            if self._track is not None:
                self._track.failures += 1
                if self._track.failures >= _MOST_FAILURES:
                    self._track = None
            return result
        self._track = _followed(self._track, prior, result, time_ns)
        return result

    def _before(self, time_ns: int) -> Before | None:
        """What the last frame says of the motion beside what a gyroscope sees."""
        track = self._track
        if track is None:
            return None
        readout_time = self.localizer.camera.readout_time
        motion, covariance, added = unshaken(track.estimate)
        dt = 1e-9 * (time_ns - track.time_ns)
        acceleration = Acceleration(_NO_TURN, self.localizer.config.acceleration.linear)
        added += track.jolts * acceleration_covariance(acceleration, dt, readout_time)
        return Before(
            track.time_ns,
            motion,
            covariance,
            added,
            _FADING / readout_time,
            track.of_shake_sizes,
            track.of_field_sizes,
        )


def _followed(track: _Track | None, prior: Prior | None, found: Estimate, time_ns: int) -> _Track:
    """The track and its newest frame."""
    share = float(np.mean(found.inliers))
    if track is None or prior is None or prior.motion is None:
        return _Track(found, time_ns, share, found.of_shake_sizes, found.of_field_sizes, 1.0)
    if found.tracked:
        share = (1.0 - _NEWEST) * track.share + _NEWEST * share
    surprise = _surprise(prior, found)
    return _Track(
        found,
        time_ns,
        share,
        _MEMORY * track.of_shake_sizes + _INDEPENDENT * found.of_shake_sizes,
        _MEMORY * track.of_field_sizes + _INDEPENDENT * found.of_field_sizes,
        float(np.clip(track.jolts * surprise**_LEARNING, 1.0, _MOST_JOLTS)),
    )


def _surprise(prior: Prior, found: Estimate) -> float:
    """How many times farther than predicted the motion has changed, squared; 1 is as predicted.

    The squared step from the prediction to the estimate, in standard deviations of the prediction,
    is expected to be what the points decide of the parameters.
    """
    assert prior.motion is not None
    assert prior.covariance is not None
    scale = 1.0 / np.sqrt(np.diag(prior.covariance))
    information = np.linalg.inv(prior.covariance * np.outer(scale, scale)) * np.outer(scale, scale)
    motion = found.beside_turn()
    step = step_between(state_in(prior.motion, np.zeros(3)), state_in(motion, np.zeros(3)))
    posterior = found.joint_covariance[:PARAMETERS, :PARAMETERS]
    expected = PARAMETERS - float(np.einsum("ij,ji->", information, posterior))
    return float(step @ information @ step) / max(expected, 1.0)
