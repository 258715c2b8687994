# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What goes out on TF of a localized frame: ``publish_tf`` of the settings.

``map_to_camera`` says where the body is in the map (the camera, or ``base_frame``: a frame has one
parent only, and a camera on a robot has one already). ``map_to_odom`` is REP-105: odometry says
where the robot is in ``odom_frame``, smoothly but drifting, and the localizer where odom is in the
map. That changes slowly, so it is stamped ``transform_tolerance`` into the future, as nav2_amcl
and slam_toolbox do: until the next frame comes, others can still use it.
"""

from dataclasses import dataclass

from rs_localizer.config import NodeConfig, PublishTf
from rs_localizer.io.outputs import Localized
from rs_localizer.io.transforms import Transform, TransformError, Transforms


@dataclass(frozen=True, slots=True, eq=False)
class Broadcast:
    """One transform for TF."""

    stamp_ns: int
    parent: str
    child: str
    parent_from_child: Transform


def broadcast(frame: Localized, config: NodeConfig, transforms: Transforms) -> Broadcast | None:
    """The transform to publish of a frame; None when ``publish_tf`` is ``none``.

    Raises:
        TransformError: when the frame says nothing of its time, or odometry says nothing for it.
    """
    if config.publish_tf == PublishTf.NONE:
        return None
    if frame.input_stamp_ns == 0:
        raise TransformError("header.stamp of the input is zero: the pose has no time for TF")
    map_from_body = Transform(frame.pose.rotation, frame.pose.position)
    if config.publish_tf == PublishTf.MAP_TO_CAMERA:
        return Broadcast(frame.stamp_ns, frame.map_frame, frame.body_frame, map_from_body)
    body_from_odom = transforms.lookup(frame.body_frame, config.odom_frame, frame.stamp_ns)
    return Broadcast(
        frame.stamp_ns + round(config.transform_tolerance * 1e9),
        frame.map_frame,
        config.odom_frame,
        map_from_body @ body_from_odom,
    )
