"""What is published of a localized frame, and its messages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core import so3
from rs_localizer.core.so3 import Array
from rs_localizer.core.types import Estimate
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.messages import Make, make_header

TYPES = {
    "pose": "geometry_msgs/msg/PoseStamped",
    "twist": "geometry_msgs/msg/TwistStamped",
    "pose_with_covariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "twist_with_covariance": "geometry_msgs/msg/TwistWithCovarianceStamped",
    "odometry": "nav_msgs/msg/Odometry",
    "inliers": "sensor_msgs/msg/PointCloud2",
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


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
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

    def __bool__(self) -> Literal[True]:
        return True


def messages(frame: Frame, make: Make) -> dict[str, Any]:
    """The messages of a frame by output topic (see :data:`TYPES`), the same for node and replay.

    Without a twist there is no odometry either: zeros would be a claim.
    """
    in_map = make_header(make, frame.stamp_ns, frame.map_frame)
    pose = _pose(make, frame.pose)
    pose_with_covariance = make(
        "geometry_msgs/msg/PoseWithCovariance",
        pose=pose,
        covariance=frame.pose.covariance.ravel(),
    )
    result = {
        "pose": make(TYPES["pose"], header=in_map, pose=pose),
        "pose_with_covariance": make(
            TYPES["pose_with_covariance"], header=in_map, pose=pose_with_covariance
        ),
    }
    if frame.twist is not None:
        in_body = make_header(make, frame.stamp_ns, frame.body_frame)
        twist = make(
            "geometry_msgs/msg/Twist",
            linear=_vector(make, frame.twist.linear),
            angular=_vector(make, frame.twist.angular),
        )
        twist_with_covariance = make(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=twist,
            covariance=frame.twist.covariance.ravel(),
        )
        result["twist"] = make(TYPES["twist"], header=in_body, twist=twist)
        result["twist_with_covariance"] = make(
            TYPES["twist_with_covariance"], header=in_body, twist=twist_with_covariance
        )
        result["odometry"] = make(
            TYPES["odometry"],
            header=in_map,
            child_frame_id=frame.body_frame,
            pose=pose_with_covariance,
            twist=twist_with_covariance,
        )
    result["inliers"] = make_cloud(make, frame.input_stamp_ns, frame.map_frame, frame.inliers)
    return result


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
