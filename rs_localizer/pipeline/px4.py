# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A localized frame as PX4's external vision takes it: ``px4_msgs/msg/VehicleOdometry``.

ROS has bodies whose x is forward, y left and z up (FLU), and maps whose z is up (REP-103, REP-105);
PX4 has bodies of x forward, y right, z down (FRD) and worlds whose z is down. Both changes are
rotations, so errors of rotations turn with the axes as velocities do. Of the covariances PX4 takes
variances: of positions along the axes of its world, of orientations about those of the body, of
velocities along the latter (PX4-Autopilot, msg/versioned/VehicleOdometry.msg).
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from rs_localizer.config import NodeConfig
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.io.outputs import Localized, Twist

TYPE = "px4_msgs/msg/VehicleOdometry"

_FLIP = np.diag([1.0, -1.0, -1.0])  # FLU and FRD, either way
# PX4's world from the map: its axes, and the message's number for them.
_WORLDS = {
    "frd": (_FLIP, 2),
    "ned": (np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]), 1),
}
WORLDS = tuple(_WORLDS)
"""The map's z is up, and its x and y anywhere (``frd``), or east and north (``ned``)."""

_BODY_FRD = 3  # the message's number for axes of the body
_LINEAR, _ANGULAR = slice(0, 3), slice(3, 6)
_UNKNOWN = np.full(3, np.nan, dtype=np.float32)


def vehicle_odometry(frame: Localized, world: str, resets: int, now_ns: int) -> dict[str, Any]:
    """The fields of the message.

    Args:
        frame: of a body with x forward, y left, z up (``base_frame``). Without a twist, velocities
            are NaN, which is PX4's word for unknown.
        world: of :data:`WORLDS`.
        resets: how often poses have jumped so far; modulo 256.
        now_ns: time of the message, of the same clock as the stamps.
    """
    world_from_map, pose_frame = _WORLDS[world]
    pose = frame.pose
    rotation = world_from_map @ pose.rotation @ _FLIP
    x, y, z, w = so3.quaternion(np.ascontiguousarray(rotation))
    body_from_map = _FLIP @ pose.rotation.T
    return {
        "timestamp": now_ns // 1000,
        "timestamp_sample": frame.stamp_ns // 1000,
        "pose_frame": pose_frame,
        "position": _floats(world_from_map @ pose.position),
        "q": _floats(np.array([w, x, y, z])),
        "position_variance": _variances(pose.covariance[_LINEAR, _LINEAR], world_from_map),
        "orientation_variance": _variances(pose.covariance[_ANGULAR, _ANGULAR], body_from_map),
        "reset_counter": resets % 256,
        # Percent of the points that fit the pose, at least 1: PX4 takes 0 for invalid.
        "quality": max(1, round(100.0 * float(np.mean(frame.estimate.inliers)))),
        **_velocities(frame.twist),
    }


def _velocities(twist: Twist | None) -> dict[str, Any]:
    if twist is None:
        names = ("velocity", "angular_velocity", "velocity_variance")
        return {"velocity_frame": _BODY_FRD, **dict.fromkeys(names, _UNKNOWN)}
    return {
        "velocity_frame": _BODY_FRD,
        "velocity": _floats(_FLIP @ twist.linear),
        "angular_velocity": _floats(_FLIP @ twist.angular),
        "velocity_variance": _variances(twist.covariance[_LINEAR, _LINEAR], _FLIP),
    }


def _variances(covariance: Array, rotation: Array) -> Any:
    """Along the axes to which a rotation turns."""
    return _floats(np.einsum("ij,jk,ik->i", rotation, covariance, rotation))


def _floats(values: Array) -> Any:
    return values.astype(np.float32)


# Squared distance in standard deviations: exceeded once in 10 million (chi-square, 3).
_GATE = 36.0


class Jumps:
    """Counts poses that jump, of one camera: who filters them has to begin anew.

    A pose after a gap, or one that was searched for afresh, is no jump: it is of the same map. A
    jump does not follow from the last pose, within what both are uncertain by and what a camera can
    accelerate: a mirrored or wrong pose came before, or the map has changed.

    Args:
        config: tells the settings that hold now: how fast cameras move and accelerate.
    """

    def __init__(self, config: Callable[[], NodeConfig]) -> None:
        self.count = 0
        self._config = config
        self._last: Localized | None = None

    def add(self, frame: Localized) -> int:
        """The number of jumps up to this frame, with this one."""
        last, self._last = self._last, frame
        if last is not None and self._jumps(last, frame):
            self.count += 1
        return self.count

    def _jumps(self, last: Localized, frame: Localized) -> bool:
        seconds = (frame.stamp_ns - last.stamp_ns) * 1e-9
        if seconds <= 0.0 or frame.map_frame != last.map_frame:
            return True
        config = self._config()
        twist = last.twist or _unknown(config)
        orientation = last.pose.rotation
        displacement = orientation @ twist.linear * seconds
        turn = orientation @ so3.exp(twist.angular * seconds) @ frame.pose.rotation.T
        steps = (
            frame.pose.position - last.pose.position - displacement,
            so3.log(np.ascontiguousarray(turn)),
        )
        both = last.pose.covariance + frame.pose.covariance
        accelerations = (config.acceleration.linear, config.acceleration.angular)
        parts = zip(steps, (_LINEAR, _ANGULAR), accelerations, strict=True)
        return any(
            _distance(
                step,
                both[part, part]
                + seconds**2 * orientation @ twist.covariance[part, part] @ orientation.T
                + (0.5 * acceleration * seconds**2) ** 2 * np.eye(3),
            )
            > _GATE
            for step, part, acceleration in parts
        )


def _unknown(config: NodeConfig) -> Twist:
    """What is known of a velocity that no frame tells: how fast cameras move."""
    prior = config.velocity_prior
    speeds = np.repeat([prior.linear, prior.angular], 3)
    return Twist(linear=np.zeros(3), angular=np.zeros(3), covariance=np.diag(speeds**2))


def _distance(step: Array, covariance: Array) -> float:
    """Squared, in standard deviations."""
    return float(step @ np.linalg.solve(covariance, step))
