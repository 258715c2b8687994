# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""TF that is missing, contradicts or changes."""

import contextlib
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from live_world import CLOSE, World
from robot import tf2_ros


def without_odometry(world: World) -> str:
    """The pose is published, its transform is not."""
    before = len(world.said)
    with tf2_ros():
        assert world.set(publish_tf="map_to_odom") == ""
        assert world.localizes()
    assert world.set(publish_tf="none") == ""
    return "; ".join(world.said[before:])


class Static:
    """Says on /tf_static where a frame is, as long as it is open."""

    def __init__(self, world: World, tf2: Any, parent: str, child: str, x: float) -> None:
        self._world = world
        item = TransformStamped(child_frame_id=child)
        item.header.frame_id, item.transform.translation.x = parent, x
        self._broadcaster = tf2.StaticTransformBroadcaster(world.peer.node)
        self._broadcaster.sendTransform(item)

    def close(self) -> None:
        self._world.peer.node.destroy_publisher(self._broadcaster.pub_tf)


def second_parent(world: World) -> str:
    """The camera hangs on something already."""
    before = len(world.said)
    with (
        tf2_ros() as tf2,
        contextlib.closing(
            Static(world, tf2, "camera_link", world.recording.info.header.frame_id, 0.0)
        ),
    ):
        assert world.set(publish_tf="map_to_camera") == ""
        world.wait(
            lambda: (
                world.localizes() and any("already has parent" in t for t in world.said[before:])
            )
        )
    assert world.set(publish_tf="none") == ""
    return "; ".join(world.said[before:])


def mounting(world: World) -> str:
    """A node for a body whose camera is nowhere, then at its origin, then 2 m ahead of it."""
    camera = world.recording.info.header.frame_id
    with tf2_ros() as tf2:
        other = World(world.recording, "-p", "base_frame:=body", namespace="/other")
        try:
            other.send(other.info())
            assert not other.poses(other.cloud(), within=0.5)
            other.wait(lambda: other.poses(other.cloud(), within=0.2) or other.said)
            answer = other.said[-1]
            with contextlib.closing(Static(world, tf2, "body", camera, 0.0)):
                other.wait(other.localizes)
            with contextlib.closing(Static(world, tf2, "body", camera, 2.0)):
                other.wait(lambda: not other.localizes())
                assert other.poses(other.cloud())
                found = other.peer.poses[-1].pose.position
                error = np.array([found.x, found.y, found.z]) - world.recording.truth[0]
                assert abs(np.linalg.norm(error) - 2.0) < CLOSE
        finally:
            other.close()
    return str(answer)
