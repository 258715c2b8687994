"""Start the nodes of two cameras, each in its own namespace.

ros2 launch rs_localizer two_cameras.launch.py left:=front right:=rear left_params_file:=front.yaml
"""

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def share(*path: str) -> PathJoinSubstitution:
    """A file that the package installs."""
    return PathJoinSubstitution([FindPackageShare("rs_localizer"), *path])


def generate_launch_description() -> LaunchDescription:
    """localizer.launch.py twice; each node has the topics of its namespace: /left/camera_info."""
    actions = []
    for camera in ("left", "right"):
        actions += [
            DeclareLaunchArgument(
                camera, default_value=camera, description=f"namespace of the {camera} camera"
            ),
            DeclareLaunchArgument(
                f"{camera}_params_file",
                default_value=share("config", "rs_localizer.yaml"),
                description=f"parameters of the {camera} camera's node",
            ),
        ]
    actions += [
        IncludeLaunchDescription(
            # Each its own: what has been launched is not launched again.
            PythonLaunchDescriptionSource(share("launch", "localizer.launch.py")),
            launch_arguments={
                "namespace": LaunchConfiguration(camera),
                "params_file": LaunchConfiguration(f"{camera}_params_file"),
            }.items(),
        )
        for camera in ("left", "right")
    ]
    return LaunchDescription(actions)
