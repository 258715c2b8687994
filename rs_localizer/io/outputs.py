# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What is published of a localized frame, and its messages."""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.types import Estimate
from rs_localizer.io import topics
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.messages import Make, make_header

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
class Pose:
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


@dataclass(frozen=True, slots=True)
class CameraShare:
    """What one camera of a rig has contributed to a frame."""

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
    pose: Pose
    twist: Twist | None  # None: the readout time is unknown, or the solver sees no motion
    inliers: NDArray[Any]  # (k,) structured: the input rows that were kept, and their residual
    dropped: int  # input rows with NaN or infinity
    estimate: Estimate
    cameras: tuple[CameraShare, ...] = ()  # those of a rig that had a part

    def __bool__(self) -> Literal[True]:
        return True


def messages(frame: Localized, make: Make) -> dict[str, Any]:
    """The messages of a frame by output topic (see :data:`TYPES`), the same for node and replay.

    Without a twist there is no odometry either: zeros would be a claim.
    """
    return dict(each_message(frame, make, TYPES))


def each_message(
    frame: Localized, make: Make, wanted: Collection[str]
) -> Iterator[tuple[str, Any]]:
    """Those of these topics, one after the other; each is built when it is asked for."""
    twist = frame.twist

    @cache
    def header(name: str) -> Any:
        return make_header(make, frame.stamp_ns, name)

    @cache
    def pose() -> Any:
        return _pose(make, frame.pose)

    @cache
    def pose_with_covariance() -> Any:
        covariance = frame.pose.covariance.ravel()
        kind = "geometry_msgs/msg/PoseWithCovariance"
        return make(kind, pose=pose(), covariance=covariance)

    @cache
    def velocity() -> Any:
        assert twist is not None
        linear, angular = _vector(make, twist.linear), _vector(make, twist.angular)
        return make("geometry_msgs/msg/Twist", linear=linear, angular=angular)

    @cache
    def velocity_with_covariance() -> Any:
        assert twist is not None
        kind = "geometry_msgs/msg/TwistWithCovariance"
        return make(kind, twist=velocity(), covariance=twist.covariance.ravel())

    def odometry() -> dict[str, Any]:
        parts = {"pose": pose_with_covariance(), "twist": velocity_with_covariance()}
        return {"header": header(frame.map_frame), "child_frame_id": frame.body_frame, **parts}

    poses: dict[str, Callable[[], dict[str, Any]]] = {
        topics.POSE: lambda: {"header": header(frame.map_frame), "pose": pose()},
        topics.POSE_WITH_COVARIANCE: lambda: {
            "header": header(frame.map_frame), "pose": pose_with_covariance()
        },
    }  # fmt: skip
    twists: dict[str, Callable[[], dict[str, Any]]] = {
        topics.TWIST: lambda: {"header": header(frame.body_frame), "twist": velocity()},
        topics.TWIST_WITH_COVARIANCE: lambda: {
            "header": header(frame.body_frame), "twist": velocity_with_covariance()
        },
        topics.ODOMETRY: odometry,
    }  # fmt: skip
    for name, fields in (poses | ({} if twist is None else twists)).items():
        if name in wanted:
            yield name, make(TYPES[name], **fields())
    if topics.INLIERS in wanted:
        cloud = make_cloud(make, frame.input_stamp_ns, frame.map_frame, frame.inliers)
        yield topics.INLIERS, cloud


def _pose(make: Make, pose: Pose) -> Any:
    x, y, z = pose.position.tolist()
    qx, qy, qz, qw = so3.quaternion(np.ascontiguousarray(pose.rotation)).tolist()
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
    )


def _vector(make: Make, vector: Array) -> Any:
    x, y, z = vector.tolist()
    return make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)
