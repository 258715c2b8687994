"""Start the node of one camera.

ros2 launch rs_localizer localizer.launch.py namespace:=front params_file:=front.yaml
"""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

# Input topics, which the drivers of cameras and the trackers of features name as they like.
TOPICS = {
    "correspondences": "points of the map and their pixels (sensor_msgs/PointCloud2)",
    "keypoints": "pixels with ids or descriptors, to be matched (sensor_msgs/PointCloud2)",
    "map_points": "the map for keypoints, latched (sensor_msgs/PointCloud2)",
    "camera_info": "the camera's calibration (sensor_msgs/CameraInfo)",
}


def share(*path: str) -> PathJoinSubstitution:
    """A file that the package installs."""
    return PathJoinSubstitution([FindPackageShare("rs_localizer"), *path])


def argument(name: str, default: object, description: str) -> DeclareLaunchArgument:
    return DeclareLaunchArgument(name, default_value=default, description=description)


def generate_launch_description() -> LaunchDescription:
    """A node with its parameters, its namespace and the topics of its camera as arguments."""
    default_params = share("config", "rs_localizer.yaml")
    return LaunchDescription(
        [
            argument("namespace", "", "of the node and of its topics"),
            argument("params_file", default_params, "parameters of the node"),
            argument("use_sim_time", "false", "take the time from /clock"),
            argument("log_level", "info", "debug, info, warn, error or fatal"),
            argument("rviz", "false", "start RViz with a view of the node's outputs, too"),
            *(argument(name, name, f"topic: {text}") for name, text in TOPICS.items()),
            Node(
                package="rs_localizer",
                executable="localizer",
                name="rs_localizer",
                namespace=LaunchConfiguration("namespace"),
                parameters=[
                    LaunchConfiguration("params_file"),
                    {
                        "use_sim_time": ParameterValue(
                            LaunchConfiguration("use_sim_time"), value_type=bool
                        )
                    },
                ],
                remappings=[(name, LaunchConfiguration(name)) for name in TOPICS],
                arguments=["--ros-args", "--log-level", LaunchConfiguration("log_level")],
                output="screen",
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                # Its topics are relative, so that they lie in this namespace, too.
                namespace=LaunchConfiguration("namespace"),
                arguments=["-d", share("config", "rs_localizer.rviz")],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
