# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A matcher for the node: publishes matches, and prints the poses and twists that come back.

ros2 run rs_localizer localizer --ros-args -p readout_time:=0.03
python examples/03_node_client.py
"""

import numpy as np
from moving_camera import HEIGHT, WIDTH, K, Moving, matches, scene
from script import one_line

with one_line():
    import rclpy
    from geometry_msgs.msg import PoseStamped, TwistStamped
    from rclpy.qos import qos_profile_sensor_data
    from rclpy.signals import SignalHandlerOptions
    from sensor_msgs.msg import CameraInfo, PointCloud2, PointField

ROW = np.dtype([(name, "<f4") for name in ("x", "y", "z", "u", "v")])
FIELDS = [PointField(name=n, offset=4 * k, datatype=7, count=1) for k, n in enumerate(ROW.names)]
rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # whose end cuts callbacks off
node = rclpy.create_node("matcher")
clouds = node.create_publisher(PointCloud2, "correspondences", qos_profile_sensor_data)
infos = node.create_publisher(CameraInfo, "camera_info", 1)
node.create_subscription(PoseStamped, "rs_localizer/pose", lambda it: print(it.pose), 10)
node.create_subscription(TwistStamped, "rs_localizer/twist", lambda it: print(it.twist), 10)
moving, points, start = Moving(turn=(0.1, -0.2, 0.0)), scene(150), node.get_clock().now()


def publish() -> None:
    """Of an image that was just taken: here the matches of yours go."""
    now = node.get_clock().now()
    age_ns = (now - start).nanoseconds
    x, pixels = matches(moving, points, 1e-9 * age_ns, seed=age_ns)
    rows = np.rec.fromarrays([*x.T, *pixels.T], dtype=ROW)
    cloud = PointCloud2(height=1, width=len(rows), fields=FIELDS, point_step=20, is_dense=True)
    cloud.row_step, cloud.data = 20 * len(rows), rows.tobytes()
    cloud.header.stamp, cloud.header.frame_id = now.to_msg(), "map"
    info = CameraInfo(width=WIDTH, height=HEIGHT, distortion_model="plumb_bob", k=K.ravel())
    info.d, info.header.frame_id, info.header.stamp = [0.0] * 5, "camera", cloud.header.stamp
    infos.publish(info)  # once would do, of a publisher that is transient local
    clouds.publish(cloud)


node.create_timer(1 / 30, publish)
with one_line():  # also after Ctrl-C
    rclpy.spin(node)
