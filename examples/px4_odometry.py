#!/usr/bin/env python3
# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A node that turns ``~/odometry`` of the localizer into PX4's external vision.

    ros2 run rs_localizer localizer --ros-args -p readout_time:=0.02 -p base_frame:=base_link
    python examples/px4_odometry.py ned

Needs px4_msgs of PX4's release. ROS has bodies of x forward, y left, z up and maps whose z is up;
PX4 has x forward, y right, z down, and worlds whose z is down. ``frd``: the map has z up and any
heading; ``ned``: its x is east and its y north. Of covariances PX4 takes variances: of positions
along the axes of its world, of orientations and velocities along those of the body.
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from script import run

FLIP = np.diag([1.0, -1.0, -1.0])  # FLU and FRD, either way
# PX4's world from the map: its axes, and the message's number for them.
WORLDS = {"frd": (FLIP, 2), "ned": (np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]]), 1)}
BODY_FRD = 3
# Squared distance in standard deviations: exceeded once in 10 million (chi-square, 3).
GATE = 36.0


def vector(of: Any) -> np.ndarray:
    """Components (3,) of a message."""
    return np.array([of.x, of.y, of.z])


def vehicle_odometry(message: Any, world: str, resets: int, now_ns: int) -> dict[str, Any]:
    """The fields of px4_msgs/VehicleOdometry of a nav_msgs/Odometry.

    Args:
        message: of a body with x forward, y left, z up.
        world: one of :data:`WORLDS`.
        resets: how often poses have jumped so far.
        now_ns: time of the message, of the same clock as its stamp.
    """
    world_from_map, pose_frame = WORLDS[world]
    pose, twist, stamp = message.pose.pose, message.twist.twist, message.header.stamp
    q = pose.orientation
    map_from_body = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    x, y, z, w = Rotation.from_matrix(world_from_map @ map_from_body @ FLIP).as_quat()
    of_pose = np.reshape(message.pose.covariance, (6, 6))
    of_twist = np.reshape(message.twist.covariance, (6, 6))

    def variances(covariance: np.ndarray, turn: np.ndarray) -> np.ndarray:
        return np.float32(np.diag(turn @ covariance @ turn.T))

    return {
        "timestamp": now_ns // 1000,
        "timestamp_sample": stamp.sec * 10**6 + stamp.nanosec // 1000,
        "pose_frame": pose_frame,
        "position": np.float32(world_from_map @ vector(pose.position)),
        "q": np.float32([w, x, y, z]),
        "velocity_frame": BODY_FRD,
        "velocity": np.float32(FLIP @ vector(twist.linear)),
        "angular_velocity": np.float32(FLIP @ vector(twist.angular)),
        "position_variance": variances(of_pose[:3, :3], world_from_map),
        "orientation_variance": variances(of_pose[3:, 3:], FLIP @ map_from_body.T),
        "velocity_variance": variances(of_twist[:3, :3], FLIP),
        "reset_counter": resets % 256,
        "quality": 100,
    }


def jumps(last: Any, message: Any, acceleration: float = 4.0) -> bool:
    """Whether a position contradicts the last one: another map, or a wrong pose before.

    What both are uncertain by, and what a body can accelerate (m/s^2), is no jump.
    """
    then, now = (m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in (last, message))
    seconds = (now - then) * 1e-9
    if seconds <= 0.0:
        return True
    q = last.pose.pose.orientation
    turn = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    step = vector(message.pose.pose.position) - vector(last.pose.pose.position)
    step -= turn @ vector(last.twist.twist.linear) * seconds
    covariance = sum(np.reshape(m.pose.covariance, (6, 6))[:3, :3] for m in (last, message))
    of_twist = np.reshape(last.twist.covariance, (6, 6))[:3, :3]
    covariance = covariance + seconds**2 * turn @ of_twist @ turn.T
    covariance = covariance + (0.5 * acceleration * seconds**2) ** 2 * np.eye(3)
    return float(step @ np.linalg.solve(covariance, step)) > GATE


def main(world: str = "frd") -> None:
    """Convert until Ctrl-C."""
    import rclpy
    from nav_msgs.msg import Odometry
    from px4_msgs.msg import VehicleOdometry
    from rclpy.signals import SignalHandlerOptions

    if world not in WORLDS:
        raise ValueError(f"the world must be one of {', '.join(WORLDS)}, found {world}")
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # whose end cuts callbacks off
    node = rclpy.create_node("px4_odometry")
    out = node.create_publisher(VehicleOdometry, "/fmu/in/vehicle_visual_odometry", 10)
    state: dict[str, Any] = {"last": None, "resets": 0}

    def convert(message: Any) -> None:
        state["resets"] += state["last"] is not None and jumps(state["last"], message)
        state["last"] = message
        now_ns = node.get_clock().now().nanoseconds
        out.publish(VehicleOdometry(**vehicle_odometry(message, world, state["resets"], now_ns)))

    node.create_subscription(Odometry, "/rs_localizer/odometry", convert, 10)
    while True:
        rclpy.spin_once(node, timeout_sec=0.2)  # in between, Ctrl-C is heard


if __name__ == "__main__":
    run(main, "[frd | ned]    (until Ctrl-C)")
