# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Published parts of a localized frame, and their messages."""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import cache
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


def make_pose(pose: BodyPose, make: Make) -> Any:
    """Return the geometry_msgs/Pose of a pose."""
    position = make_vector(make, pose.position, "Point")
    orientation = make_quaternion(make, pose.rotation)
    return make("geometry_msgs/msg/Pose", position=position, orientation=orientation)


def make_pose_with_covariance(pose: BodyPose, make: Make, made: Any = None) -> Any:
    """Return the geometry_msgs/PoseWithCovariance of a pose, whose message may be made already."""
    kind, covariance = "geometry_msgs/msg/PoseWithCovariance", _sent(pose.covariance)
    return make(kind, pose=made or make_pose(pose, make), covariance=covariance)


def messages(frame: Localized, make: Make) -> dict[str, Any]:
    """Return the messages of a frame by topic (:data:`TYPES`), for node and replay alike.

    Without a readout time there is neither twist nor odometry: zeros would be a claim. Where the
    twist is unknown, those with covariance say so.
    """
    return dict(each_message(frame, make, TYPES))


def each_message(
    frame: Localized, make: Make, wanted: Collection[str]
) -> Iterator[tuple[str, Any]]:
    """Yield the messages of these topics; each is built when it is asked for."""
    twist, known = frame.twist, frame.known_twist is not None
    if twist is not None and not known:
        twist = _UNKNOWN

    @cache
    def header(name: str) -> Any:
        return make_header(make, frame.stamp_ns, name)

    @cache
    def pose() -> Any:
        return make_pose(frame.pose, make)

    @cache
    def pose_with_covariance() -> Any:
        return make_pose_with_covariance(frame.pose, make, pose())

    @cache
    def velocity() -> Any:
        assert twist is not None
        linear, angular = make_vector(make, twist.linear), make_vector(make, twist.angular)
        return make("geometry_msgs/msg/Twist", linear=linear, angular=angular)

    @cache
    def velocity_with_covariance() -> Any:
        assert twist is not None
        kind = "geometry_msgs/msg/TwistWithCovariance"
        return make(kind, twist=velocity(), covariance=_sent(twist.covariance))

    parts: dict[str, dict[str, Callable[[], Any]]] = {
        topics.POSE: {"pose": pose},
        topics.POSE_WITH_COVARIANCE: {"pose": pose_with_covariance},
    }
    if twist is not None:
        parts |= {
            **({topics.TWIST: {"twist": velocity}} if known else {}),
            topics.TWIST_WITH_COVARIANCE: {"twist": velocity_with_covariance},
            topics.ODOMETRY: {"pose": pose_with_covariance, "twist": velocity_with_covariance},
        }
    for name, builders in parts.items():
        if name in wanted:
            fields = {key: build() for key, build in builders.items()}
            if name == topics.ODOMETRY:
                fields["child_frame_id"] = frame.body_frame
            axes = frame.map_frame if "pose" in builders else frame.body_frame
            yield name, make(TYPES[name], header=header(axes), **fields)
    if topics.INLIERS in wanted:
        cloud = make_cloud(make, frame.input_stamp_ns, frame.map_frame, frame.inliers)
        yield topics.INLIERS, cloud
