# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Starts the installed `localizer`, publishes a rolling-shutter motion, compares with the truth.

    smoke_installed.py path/to/lib/rs_localizer/localizer

Imports nothing of the package: the truth comes from the motion itself. Each pixel is given the time
of its row, and its map point is placed where the camera of that time sees it.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import numpy as np
import rclpy
from geometry_msgs.msg import PoseStamped, TwistStamped
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, PointCloud2, PointField

WIDTH, HEIGHT, FOCAL = 640, 480, 400.0
READOUT = 0.03  # s from the first to the last row
ANGULAR = np.array([0.8, -2.5, 1.5])  # rad/s, of the camera in its own axes: 175 deg/s
LINEAR = np.array([0.7, -0.3, 0.5])  # m/s, of the camera centre in map axes
HANG = 3600.0  # s: the kernels are compiled at the first start, on whatever machine
WANTED = 10  # poses
POSITION_ERROR, ROTATION_ERROR, ANGULAR_ERROR = 0.01, 0.2, 0.05  # m, degrees, share of the truth


def rotation(vector: np.ndarray) -> np.ndarray:
    """Rotation matrix of a rotation vector (Rodrigues)."""
    angle = np.linalg.norm(vector)
    if angle == 0.0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def map_from_camera(seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """The true motion: orientation and centre of the camera at a time after the start."""
    start = rotation(np.array([0.3, -0.2, 0.1]))
    return start @ rotation(ANGULAR * seconds), np.array([1.0, 2.0, 3.0]) + LINEAR * seconds


def correspondences(seconds: float, rng: np.random.Generator) -> np.ndarray:
    """200 rows x y z u v of the image that starts at `seconds`, every fifth of them wrong."""
    pixels = rng.uniform([0, 0], [WIDTH - 1, HEIGHT - 1], size=(200, 2))
    depths = rng.uniform(2.0, 8.0, size=200)
    rows = np.empty((200, 5), dtype=np.float32)
    for row, (u, v), depth in zip(rows, pixels, depths, strict=True):
        orientation, centre = map_from_camera(seconds + READOUT * v / (HEIGHT - 1))
        ray = np.array([(u - (WIDTH - 1) / 2) / FOCAL, (v - (HEIGHT - 1) / 2) / FOCAL, 1.0])
        row[:] = [*(centre + orientation @ (depth * ray)), u, v]
    rows[::5, 3:] = rng.uniform([0, 0], [WIDTH - 1, HEIGHT - 1], size=(40, 2))
    return rows


def cloud_message(rows: np.ndarray) -> PointCloud2:
    """The rows as a PointCloud2 in the frame `map`."""
    fields = [
        PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
        for i, name in enumerate("xyzuv")
    ]
    cloud = PointCloud2(height=1, width=len(rows), fields=fields, point_step=20, is_dense=True)
    cloud.row_step = cloud.point_step * cloud.width
    cloud.data = rows.tobytes()
    cloud.header.frame_id = "map"
    return cloud


def camera_info_message() -> CameraInfo:
    """A camera without distortion."""
    info = CameraInfo(width=WIDTH, height=HEIGHT, distortion_model="plumb_bob")
    info.k = [FOCAL, 0.0, (WIDTH - 1) / 2, 0.0, FOCAL, (HEIGHT - 1) / 2, 0.0, 0.0, 1.0]
    info.d = [0.0] * 5
    info.header.frame_id = "camera"
    return info


def pose_errors(pose: PoseStamped, seconds: float) -> tuple[float, float]:
    """Distance in metres and angle in degrees between a pose and the truth."""
    orientation, centre = map_from_camera(seconds)
    p, q = pose.pose.position, pose.pose.orientation
    vector = np.array([q.x, q.y, q.z])
    half = np.linalg.norm(vector)
    estimate = rotation(vector * (2 * np.arctan2(half, q.w) / half) if half else vector)
    cosine = np.clip((np.trace(estimate.T @ orientation) - 1) / 2, -1, 1)
    distance = np.linalg.norm(np.array([p.x, p.y, p.z]) - centre)
    return float(distance), float(np.degrees(np.arccos(cosine)))


def run(localizer: subprocess.Popen) -> None:
    """Publish frames at 10 Hz until enough poses and twists came back, then compare them."""
    rclpy.init()
    node = rclpy.create_node("smoke_installed")
    poses: dict[tuple[int, int], PoseStamped] = {}
    twists: dict[tuple[int, int], TwistStamped] = {}

    def keep(messages: dict) -> object:
        return lambda m: messages.setdefault((m.header.stamp.sec, m.header.stamp.nanosec), m)

    node.create_subscription(PoseStamped, "/rs_localizer/pose", keep(poses), 10)
    node.create_subscription(TwistStamped, "/rs_localizer/twist", keep(twists), 10)
    infos = node.create_publisher(CameraInfo, "camera_info", qos_profile_sensor_data)
    clouds = node.create_publisher(PointCloud2, "correspondences", qos_profile_sensor_data)

    rng = np.random.default_rng(1)
    starts: dict[tuple[int, int], float] = {}
    begin = time.monotonic()
    while len(poses.keys() & twists.keys()) < WANTED:
        assert localizer.poll() is None, f"localizer ended with exit code {localizer.returncode}"
        waited = time.monotonic() - begin
        assert waited < HANG, f"{len(poses)} poses, {len(twists)} twists after {waited:.0f} s"
        seconds = len(starts) * 0.1
        cloud, info = cloud_message(correspondences(seconds, rng)), camera_info_message()
        stamp = info.header.stamp
        stamp.sec, stamp.nanosec = 1000 + len(starts) // 10, len(starts) % 10 * 100_000_000
        cloud.header.stamp = stamp
        starts[stamp.sec, stamp.nanosec] = seconds
        infos.publish(info)
        clouds.publish(cloud)
        pause = time.monotonic() + 0.1
        while (left := pause - time.monotonic()) > 0:
            rclpy.spin_once(node, timeout_sec=left)

    for key in sorted(poses.keys() & twists.keys()):
        pose, twist = poses[key], twists[key].twist.angular
        distance, angle = pose_errors(pose, starts[key])
        turn = np.linalg.norm(np.array([twist.x, twist.y, twist.z]) - ANGULAR)
        turn /= np.linalg.norm(ANGULAR)
        print(f"  {starts[key]:.1f} s: {distance:.1e} m, {angle:.1e} deg, twist {turn:.1e}")
        assert pose.header.frame_id == "map", pose.header.frame_id
        assert twists[key].header.frame_id == "camera", twists[key].header.frame_id
        assert distance < POSITION_ERROR, "position too far from the truth"
        assert angle < ROTATION_ERROR, "orientation too far from the truth"
        assert turn < ANGULAR_ERROR, "angular velocity too far from the truth"
    node.destroy_node()
    rclpy.shutdown()


def main() -> None:
    """Run the comparison with a fresh process and end that with Ctrl-C's signal."""
    command = [sys.argv[1], "--ros-args", "-p", f"readout_time:={READOUT}"]
    localizer = subprocess.Popen(command)
    try:
        run(localizer)
        localizer.send_signal(signal.SIGINT)
        code = localizer.wait(HANG)
        assert code == 0, f"exit code {code} after SIGINT"
    finally:
        localizer.kill()
        localizer.wait()


if __name__ == "__main__":
    main()
