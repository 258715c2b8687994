# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The names of topics, relative to a node's namespace.

The inputs are in :mod:`rs_localizer.pipeline.inputs`, the outputs in :mod:`.outputs`.
"""

# Inputs of the localizer.
CORRESPONDENCES = "correspondences"  # which the marker detector publishes
KEYPOINTS = "keypoints"
DETECTIONS = "detections"  # tags of apriltag_ros
MAP_POINTS = "map_points"
CAMERA_INFO = "camera_info"
IMU = "imu"
PRIOR_ODOMETRY = "prior_odometry"
# A user's pose, as RViz and nav2 give it, and a filter's: of the node alone, and their types.
GIVEN_POSES = {
    "initialpose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "~/set_pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    PRIOR_ODOMETRY: "nav_msgs/msg/Odometry",
}
# Inputs of the detectors.
IMAGE = "image"
COMPRESSED_IMAGE = "image/compressed"
# Outputs, below the name of their node.
POSE = "pose"
TWIST = "twist"
POSE_WITH_COVARIANCE = "pose_with_covariance"
TWIST_WITH_COVARIANCE = "twist_with_covariance"
ODOMETRY = "odometry"
INLIERS = "inliers"
# Outputs that only the live node has, and their types.
INTEGRITY, MAP_MARKERS, CAMERA_MARKER = "integrity", "map_markers", "camera_marker"
MAP_TO_ODOM = "map_to_odom"
LIVE = {
    INTEGRITY: "diagnostic_msgs/msg/DiagnosticArray",
    MAP_TO_ODOM: "geometry_msgs/msg/PoseWithCovarianceStamped",
    MAP_MARKERS: "visualization_msgs/msg/MarkerArray",
    CAMERA_MARKER: "visualization_msgs/msg/MarkerArray",
}
DEBUG_IMAGE = "debug_image"
# Topics of ROS itself.
TF = "/tf"
TF_STATIC = "/tf_static"
DIAGNOSTICS = "/diagnostics"
