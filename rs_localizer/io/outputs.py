"""What is published of a localized frame, and its messages."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import cached_property
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
    parts = _Parts(frame, make)
    builders = _WITHOUT_TWIST if frame.twist is None else _BUILDERS
    return ((name, build(parts)) for name, build in builders.items() if name in wanted)


class _Parts:
    """What the messages of a frame share, built when the first of them needs it."""

    def __init__(self, frame: Localized, make: Make) -> None:
        self.frame = frame
        self.make = make

    @cached_property
    def in_map(self) -> Any:
        return make_header(self.make, self.frame.stamp_ns, self.frame.map_frame)

    @cached_property
    def in_body(self) -> Any:
        return make_header(self.make, self.frame.stamp_ns, self.frame.body_frame)

    @cached_property
    def pose(self) -> Any:
        return _pose(self.make, self.frame.pose)

    @cached_property
    def pose_with_covariance(self) -> Any:
        return self.make(
            "geometry_msgs/msg/PoseWithCovariance",
            pose=self.pose,
            covariance=self.frame.pose.covariance.ravel(),
        )

    @cached_property
    def twist(self) -> Any:
        return self.make(
            "geometry_msgs/msg/Twist",
            linear=_vector(self.make, self._twist.linear),
            angular=_vector(self.make, self._twist.angular),
        )

    @cached_property
    def twist_with_covariance(self) -> Any:
        return self.make(
            "geometry_msgs/msg/TwistWithCovariance",
            twist=self.twist,
            covariance=self._twist.covariance.ravel(),
        )

    @property
    def _twist(self) -> Twist:
        assert self.frame.twist is not None
        return self.frame.twist


_BUILDERS: dict[str, Callable[[_Parts], Any]] = {
    topics.POSE: lambda of: of.make(TYPES[topics.POSE], header=of.in_map, pose=of.pose),
    topics.POSE_WITH_COVARIANCE: lambda of: of.make(
        TYPES[topics.POSE_WITH_COVARIANCE], header=of.in_map, pose=of.pose_with_covariance
    ),
    topics.TWIST: lambda of: of.make(TYPES[topics.TWIST], header=of.in_body, twist=of.twist),
    topics.TWIST_WITH_COVARIANCE: lambda of: of.make(
        TYPES[topics.TWIST_WITH_COVARIANCE], header=of.in_body, twist=of.twist_with_covariance
    ),
    topics.ODOMETRY: lambda of: of.make(
        TYPES[topics.ODOMETRY],
        header=of.in_map,
        child_frame_id=of.frame.body_frame,
        pose=of.pose_with_covariance,
        twist=of.twist_with_covariance,
    ),
    topics.INLIERS: lambda of: make_cloud(
        of.make, of.frame.input_stamp_ns, of.frame.map_frame, of.frame.inliers
    ),
}
_WITHOUT_TWIST = {
    name: build
    for name, build in _BUILDERS.items()
    if name not in (topics.TWIST, topics.TWIST_WITH_COVARIANCE, topics.ODOMETRY)
}


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
