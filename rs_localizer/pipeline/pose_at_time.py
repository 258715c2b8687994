# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pose and twist of the body at one moment of a motion, with covariances in REP-103's order.

The estimate is centred on the middle row and counts time in readouts; :meth:`.Estimate.moved_to`
carries it to another row time. A published pose is in SI units, and its covariance has the order of
REP-103.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rs_localizer.config import Acceleration, NodeConfig, PoseTime
from rs_localizer.core.camera import Camera
from rs_localizer.core.state import ANGULAR, LINEAR, MOVE, POSE, TURN
from rs_localizer.core.types import Estimate
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
    there = estimate.moved_to(tau) if tau else estimate
    map_from_camera, jacobian = there.rotation.T, np.zeros((6, 6))
    jacobian[:3, MOVE] = jacobian[3:, TURN] = map_from_camera
    covariance = jacobian @ there.covariance[POSE, POSE] @ jacobian.T
    return BodyPose(there.position, map_from_camera, 0.5 * (covariance + covariance.T))


def twist_at(estimate: Estimate, tau: float, readout_time: float) -> Twist:
    """Return the twist at row time ``tau``, in camera axes then; readout_time in s."""
    there = estimate.moved_to(tau) if tau else estimate
    order = np.r_[LINEAR, ANGULAR]
    covariance = there.covariance[np.ix_(order, order)] / readout_time**2
    return Twist(
        there.linear_velocity / readout_time, there.angular_velocity / readout_time,
        0.5 * (covariance + covariance.T),
    )  # fmt: skip


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
    there = there or (estimate.moved_to(tau) if tau else estimate)
    pose = pose_at(there, 0.0)
    twist = twist_at(there, 0.0, readout_time) if moving else None
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
