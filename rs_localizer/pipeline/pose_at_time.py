# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pose and twist of the body at one moment of a motion, with covariances in REP-103's order.

The estimate is centred on the middle row and counts time in readouts. A published pose holds at one
moment, in SI units, and its covariance has the order of REP-103. Errors are propagated to first
order. ``R = map_from_camera`` and ``c``, the camera centre, are at ``tau = 0``; the rotation since
then is ``theta = tau omega + tau^2/2 alpha``, the way ``w = tau v + tau^2/2 a``. The estimate's
errors in its own order are ``phi, rho, d_omega, d_v, d_alpha, d_a``:

    rotation(tau) = R exp(phi) exp(theta + d_theta)
                  = exp(R (phi + J(theta) d_theta)) R exp(theta)
    centre(tau)   = c + R rho + R exp(phi) (w + d_w)
                  = c + R w + R (rho - [w]x phi + d_w)
    v(tau)        = exp(-theta - d_theta) (u + d_u),   u = v + tau a
                  = E u + E d_u + [E u]x J(-theta) d_theta,   E = exp(-theta)
    omega(tau)    = J(-theta) (omega + tau alpha)
                  = omega + tau/2 (I + J(-theta)) alpha + ...

where J is the left Jacobian of SO(3): ``exp(a + d) = exp(J(a) d) exp(a)``; it is the right one of
``-a``. Without acceleration the body rate is ``omega`` at any time; second orders of the
acceleration are left out.

Vibration rotates the camera by ``delta(tau)`` in its own axes beside this motion. Its coefficients
stand behind the motion in the estimate's covariance, and its rotation and rate are linear in them.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rs_localizer.config import Acceleration, NodeConfig, PoseTime
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.moment_kernels import pose_of, twist_of
from rs_localizer.core.shutter import Numbers, numbers_of
from rs_localizer.core.state import MOTION_PARAMETERS
from rs_localizer.core.types import Estimate, beyond_rows
from rs_localizer.io.outputs import BodyPose, Twist
from rs_localizer.shutter_watch import ShutterWatch
from rs_localizer.solvers.table import SOLVERS


class PublishedMoment(NamedTuple):
    """The moment of a published pose."""

    stamp_ns: int
    tau: float  # row time
    motion: Estimate | None = None  # there, if readings tell it; None: that of the frame


def pose_at(estimate: Estimate, tau: float) -> BodyPose:
    """Return the pose of the camera in the map at row time ``tau``."""
    position, rotation, covariance = pose_of(
        *_numbers(estimate, tau), beyond_rows(estimate, tau)[0]
    )
    return BodyPose(position=position, rotation=rotation, covariance=covariance)


def twist_at(estimate: Estimate, tau: float, readout_time: float) -> Twist:
    """Return the twist at row time ``tau``, in camera axes then; readout_time in s."""
    linear, angular, covariance = twist_of(*_numbers(estimate, tau), beyond_rows(estimate, tau))
    return Twist(
        linear=linear / readout_time,
        angular=angular / readout_time,
        covariance=covariance / readout_time**2,
    )


def _numbers(estimate: Estimate, tau: float) -> tuple[Numbers, Array, Array, float]:
    """Return the numbers of an estimate at a row time, as kernels take them."""
    joint = np.ascontiguousarray(estimate.joint_covariance.copy())
    joint[:MOTION_PARAMETERS, :MOTION_PARAMETERS] = estimate.covariance
    return numbers_of(estimate), np.ascontiguousarray(estimate.shake), joint, float(tau)


def with_timing(
    pose: BodyPose, twist: Twist, deviation: float, delay: float, acceleration: Acceleration
) -> tuple[BodyPose, Twist]:
    """Add the uncertainty of the readout time to the covariances.

    Args:
        pose, twist: of the camera at one moment.
        deviation: of the readout time, as a part of it: velocities are inverse to it.
        delay: s by which the moment itself is uncertain.
        acceleration: that the camera may have all the time.
    """
    velocity = np.concatenate([twist.linear, twist.angular])
    in_map = np.concatenate([pose.rotation @ twist.linear, pose.rotation @ twist.angular])
    change = np.diag(np.repeat([acceleration.linear, acceleration.angular], 3) * delay) ** 2
    moved = delay**2 * np.outer(in_map, in_map) + 0.25 * delay**2 * change
    changed = deviation**2 * np.outer(velocity, velocity) + change
    return (
        replace(pose, covariance=pose.covariance + moved),
        replace(twist, covariance=twist.covariance + changed),
    )


def published_motion(
    estimate: Estimate, moment: PublishedMoment, config: NodeConfig, camera: Camera,
    watch: ShutterWatch,
) -> tuple[BodyPose, Twist | None]:  # fmt: skip
    """Return pose and twist of the camera at a moment; no twist where frames tell none.

    Args:
        estimate: of the frame.
        moment: for which they are valid.
        config: settings.
        camera: the first one.
        watch: of the shutter; before a global one an image says nothing of velocities.
    """
    readout_time, (_, tau, there) = estimate.span, moment
    moving = readout_time > 0.0 and SOLVERS[config.solver].rolling_shutter
    moving = moving and (estimate.aided or not watch.is_global)
    motion, at = (estimate, tau) if there is None else (there, 0.0)
    pose = pose_at(motion, at)
    twist = twist_at(motion, at, readout_time) if moving else None
    deviation = 0.0 if config.of_cameras else config.readout_time_deviation
    late = max(deviation, watch.error)
    if twist is not None and late > 0.0:
        # The middle row comes later where the readout takes longer; the first one does not.
        delay = late * camera.first_row_time * (tau == 0.0)
        return with_timing(pose, twist, deviation / readout_time, delay, config.acceleration)
    return pose, twist


def middle_row_ns(config: NodeConfig, camera: Camera, stamp_ns: int) -> int:
    """Return the time at which the middle row of the image with this stamp was exposed."""
    delay = config.stamp_offset - config.readout_time * camera.first_row_time
    return stamp_ns + round(delay * 1e9)


def published_moment(config: NodeConfig, camera: Camera, stamp_ns: int) -> PublishedMoment:
    """Return the moment of the published pose of a frame."""
    if config.pose_time == PoseTime.MID_FRAME:
        return PublishedMoment(middle_row_ns(config, camera, stamp_ns), 0.0)
    tau = camera.first_row_time
    if config.readout_time > 0.0:
        tau -= config.stamp_offset / config.readout_time
    return PublishedMoment(stamp_ns, tau)
