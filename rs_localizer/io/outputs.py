# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Published parts of a localized frame, and their messages."""

from collections.abc import Collection
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.core.types import Estimate
from rs_localizer.io import topics
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.messages import Make, make_header, make_quaternion, make_vector

TYPES = {
    topics.POSE: "geometry_msgs/msg/PoseStamped",
    topics.TWIST: "geometry_msgs/msg/TwistStamped",
    topics.POSE_WITH_COVARIANCE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    topics.TWIST_WITH_COVARIANCE: "geometry_msgs/msg/TwistWithCovarianceStamped",
    topics.ODOMETRY: "nav_msgs/msg/Odometry",
    topics.INLIERS: "sensor_msgs/msg/PointCloud2",
}
"""Output topics, below the node's name, and their types."""


@dataclass(frozen=True, slots=True, eq=False)
class BodyPose:
    """Pose of the body in the map."""

    position: Array  # (3,) m
    rotation: Array  # (3,3) map_from_body
    covariance: Array  # (6,6) x, y, z, then small rotations about the fixed axes of the map


@dataclass(frozen=True, slots=True, eq=False)
class Twist:
    """Velocity of the body with respect to the map, in the body's axes."""

    linear: Array  # (3,) m/s, of the body's origin
    angular: Array  # (3,) rad/s
    covariance: Array  # (6,6) linear, then angular


# Variances of what nobody knows: 1,000 m/s and rad/s, as filters take them for none.
_UNKNOWN = Twist(np.zeros(3), np.zeros(3), 1e6 * np.eye(6))


@dataclass(frozen=True, slots=True)
class CameraShare:
    """Contribution of one camera of a rig to a frame."""

    name: str
    points: int
    inliers: int
    residual: float  # px, root mean square of the inliers
    start_ns: int = 0  # exposure of its first row


@dataclass(frozen=True, slots=True, eq=False)
class Localized:
    """A localized frame: all that gets published of it; true in a condition."""

    input_stamp_ns: int
    stamp_ns: int  # for which pose and twist are valid
    map_frame: str
    body_frame: str
    pose: BodyPose
    twist: Twist | None  # None: the readout time is unknown, or the solver sees no motion
    inliers: NDArray[Any]  # (k,) structured: the input rows that were kept, and their residual
    dropped: int  # input rows with NaN or infinity
    estimate: Estimate
    cameras: tuple[CameraShare, ...] = ()  # those of a rig that had a part

    def __bool__(self) -> Literal[True]:
        return True

    @property
    def known_twist(self) -> Twist | None:
        """The twist, or None where it is unknown, too: it would be a mean of rest and motion."""
        return self.twist if self.estimate.twist_known else None


def _sent(covariance: Array) -> Array:
    """Return a covariance (6,6) as in messages (36,), with -1 on the diagonal if there is none."""
    known: Array = -np.eye(6) if np.isnan(covariance[0, 0]) else covariance
    return known.ravel()


def make_pose_with_covariance(pose: BodyPose, make: Make) -> Any:
    """Return the geometry_msgs/PoseWithCovariance of a pose."""
    position = make_vector(make, pose.position, "Point")
    orientation = make_quaternion(make, pose.rotation)
    made = make("geometry_msgs/msg/Pose", position=position, orientation=orientation)
    kind, covariance = "geometry_msgs/msg/PoseWithCovariance", _sent(pose.covariance)
    return make(kind, pose=made, covariance=covariance)


def messages(frame: Localized, make: Make, wanted: Collection[str] = TYPES) -> dict[str, Any]:
    """Return the messages of a frame by topic (:data:`TYPES`), for node and replay alike.

    Without a readout time there is neither twist nor odometry: zeros would be a claim. Where the
    twist is unknown, those with covariance say so.

    Args:
        wanted: topics; of others nothing is built.
    """
    made: dict[str, Any] = {}
    header = cache(partial(make_header, make, frame.stamp_ns))

    def add(name: str, axes: str, **fields: Any) -> None:
        if name in wanted:
            made[name] = make(TYPES[name], header=header(axes), **fields)

    if set(wanted) - {topics.INLIERS}:
        sure = make_pose_with_covariance(frame.pose, make)
        add(topics.POSE, frame.map_frame, pose=sure.pose)
        add(topics.POSE_WITH_COVARIANCE, frame.map_frame, pose=sure)
        if frame.twist is not None:
            twist = frame.known_twist or _UNKNOWN
            linear, angular = make_vector(make, twist.linear), make_vector(make, twist.angular)
            velocity = make("geometry_msgs/msg/Twist", linear=linear, angular=angular)
            kind, covariance = "geometry_msgs/msg/TwistWithCovariance", _sent(twist.covariance)
            motion = make(kind, twist=velocity, covariance=covariance)
            if frame.known_twist:
                add(topics.TWIST, frame.body_frame, twist=velocity)
            add(topics.TWIST_WITH_COVARIANCE, frame.body_frame, twist=motion)
            body = frame.body_frame
            add(topics.ODOMETRY, frame.map_frame, child_frame_id=body, pose=sure, twist=motion)
    if topics.INLIERS in wanted:
        cloud = make_cloud(make, frame.input_stamp_ns, frame.map_frame, frame.inliers)
        made[topics.INLIERS] = cloud
    return made
