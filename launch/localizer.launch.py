"""Start the node: ros2 launch rs_localizer localizer.launch.py camera_info:=/camera/camera_info"""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    """A node with its params file, its namespace and the topics of its camera as arguments."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params_file",
                default_value=PathJoinSubstitution(
                    [FindPackageShare("rs_localizer"), "config", "rs_localizer.yaml"]
                ),
                description="parameters of the node",
            ),
            DeclareLaunchArgument(
                "namespace", default_value="", description="namespace of the node"
            ),
            DeclareLaunchArgument(
                "correspondences",
                default_value="correspondences",
                description="topic of the correspondences (sensor_msgs/PointCloud2)",
            ),
            DeclareLaunchArgument(
                "camera_info",
                default_value="camera_info",
                description="topic of the camera's calibration (sensor_msgs/CameraInfo)",
            ),
            Node(
                package="rs_localizer",
                executable="localizer",
                name="rs_localizer",
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration("params_file")],
                remappings=[
                    ("correspondences", LaunchConfiguration("correspondences")),
                    ("camera_info", LaunchConfiguration("camera_info")),
                ],
                output="screen",
            ),
        ]
    )
