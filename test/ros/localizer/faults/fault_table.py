# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""All faults: what is done to the node, and what it has to say."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from fault_events import (
    bug,
    burst,
    cleaned_up,
    deactivated,
    impossible,
    reset,
    second_node,
    setting,
    silence,
    simulated_time,
    stuck,
)
from fault_keypoints import (
    keypoints,
    late_map,
    mapped,
    marked,
    repeated,
    replaced_within_a_frame,
    without_a_map,
)
from fault_messages import cloud, garbage, info, many, noise, resized, rows, stamped
from fault_transforms import second_parent, without_odometry
from lifecycle_msgs.msg import Transition
from live_world import World
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import String


@dataclass(frozen=True)
class Fault:
    """A row: what is done to the node, and a pattern of what it has to say.

    Messages that are returned are sent until the node has said it (best effort may lose one). A
    text that is returned is what the node has answered. With ``pose`` it is to be localized all
    the same.
    """

    name: str
    do: Callable[[World], Any]
    says: str
    pose: bool = False


RELIABLE = ("-p", "qos_overrides./other/correspondences.subscription.reliability:=reliable")

FAULTS = [
    # camera_info
    Fault("no camera_info", lambda world: [world.cloud()], "no_camera_info: no usable camera_info"),
    Fault("K of zeros", info(k=np.zeros(9)), r"bad_camera_info: .*K\[0\] is 0"),
    Fault("other image size in the middle", resized, "", pose=True),
    # Clouds that cannot be read
    Fault("truncated", cloud(data=b"\0" * 100), "bad_cloud: the data are truncated"),
    Fault("2^62 points", cloud(width=2**31, height=2**31, row_step=2**32 - 1), "bad_cloud: "),
    Fault("empty", cloud(width=0, row_step=0, data=b""), "empty_cloud: the cloud has no points"),
    # Clouds that hold no pose
    Fault("one point", rows(lambda table: table[:1]), "too_few_points: 1 usable points of 1"),
    Fault("wrong matches only", rows(noise(100)), "too_few_inliers"),
    # What is unusual and right
    Fault("a million points", many, "", pose=True),
    Fault("stamp zero", stamped(0.0), "time_went_back", pose=True),
    Fault("time jumps forth and back", stamped(1e6, 5.0, 7e8, 6.0), "time_went_back", pose=True),
    Fault("the same stamp twice", stamped(10.0, 10.0), "", pose=True),
    # Overload and bugs
    Fault("10,000 garbage messages", garbage, "refused"),
    Fault("300 frames at once", burst, "replaced"),
    Fault("a frame that takes long", stuck, "worked on for"),
    Fault("a bug in the node", bug, r"internal_error: TypeError\('a bug'\) in fail"),
    # Parameters
    Fault("unknown solver", setting(solver="epnp"), "solver must be one of "),
    Fault("autostart while running", setting(autostart=False), "read-only"),
    Fault("one good, one bad", setting(min_inliers=20, solver="epnp"), "solver must be one of"),
    # Life cycle and services
    Fault("activate twice", impossible(Transition.TRANSITION_ACTIVATE), "false"),
    Fault("deactivated within a frame", deactivated, "inactive"),
    Fault("cleaned up within a frame", cleaned_up, "waiting for camera_info"),
    Fault("reset within a frame", reset, "the previous pose and twist are forgotten"),
    # The graph
    Fault("simulated time, no clock", simulated_time, "diagnostics go on"),
    Fault("frames stop", silence, "no frame has come"),
    Fault(
        "two nodes in one process; QoS that does not fit",
        second_node(RELIABLE, PointCloud2, qos_profile_sensor_data),
        "the QoS of /other/driver does not fit: Best effort publisher and reliable subscription",
    ),
    Fault(
        "two nodes in one process; another type on the topic",
        second_node((), String, 10),
        "/other/driver publishes std_msgs/msg/String, not sensor_msgs/msg/PointCloud2",
    ),
    # Keypoints and maps
    Fault("keypoints without a map", without_a_map, "no_map: no usable map has come yet"),
    Fault("a map with an id twice", mapped(repeated), "bad_map: 1 ids stand for several"),
    Fault("a map that comes late", late_map, "localized since the map came"),
    Fault("a map replaced within a frame", replaced_within_a_frame, "map_replaced: a map of"),
    Fault(
        "descriptors of another width",
        marked(descriptor=lambda ids: np.zeros((len(ids), 64), np.uint8)),
        "bad_keypoints: the keypoints have descriptors of 64 x uint8, the map has .*32 x uint8",
    ),
    Fault(
        "100,000 keypoints",
        lambda world: [keypoints(world, 100_000)],
        "too_many_keypoints: 100000 keypoints",
        pose=True,
    ),
    # TF
    Fault("map_to_odom without odometry", without_odometry, "not_broadcast: .*", pose=True),
    Fault(
        "the camera has a parent", second_parent, "not_broadcast: .* already has parent", pose=True
    ),
]
