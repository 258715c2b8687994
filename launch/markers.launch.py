"""From a camera to poses by markers or a board: camera driver, marker detector, localizer.

ros2 launch rs_localizer markers.launch.py camera:=v4l2_camera marker_map:=$PWD/wall.yaml \
    readout_time:=0.02 calibration:=file://$PWD/camera.yaml
"""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import EqualsSubstitution, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

# Drivers by their package, and their executables; both publish image_raw and camera_info.
DRIVERS = {"v4l2_camera": "v4l2_camera_node", "usb_cam": "usb_cam_node_exe"}


def share(*path: str) -> PathJoinSubstitution:
    """A file that the package installs."""
    return PathJoinSubstitution([FindPackageShare("rs_localizer"), *path])


def argument(name: str, description: str, **default: object) -> DeclareLaunchArgument:
    return DeclareLaunchArgument(
        name, **{f"{key}_value": value for key, value in default.items()}, description=description
    )


def number(name: str) -> ParameterValue:
    return ParameterValue(LaunchConfiguration(name), value_type=float)


def generate_launch_description() -> LaunchDescription:
    """The nodes share a namespace, in which they find each other."""
    namespace = LaunchConfiguration("namespace")
    shutter = {
        "readout_time": number("readout_time"),
        "scan_direction": LaunchConfiguration("scan_direction"),
        "stamp_offset": number("stamp_offset"),
    }
    cameras = [
        Node(
            package=package,
            executable=executable,
            name="camera",
            namespace=namespace,
            parameters=[
                {
                    "camera_info_url": ParameterValue(
                        LaunchConfiguration("calibration"), value_type=str
                    )
                }
            ],
            output="screen",
            condition=IfCondition(EqualsSubstitution(LaunchConfiguration("camera"), package)),
        )
        for package, executable in DRIVERS.items()
    ]
    return LaunchDescription(
        [
            argument("marker_map", "file of the map, of rs_localizer markers make"),
            argument(
                "camera",
                "driver to start: v4l2_camera or usb_cam; none: one that runs already",
                default="none",
            ),
            argument("calibration", "URL of the camera's calibration, for the driver", default=""),
            argument("namespace", "of all nodes and their topics", default=""),
            argument(
                "image", "topic of the raw images (never rectified ones)", default="image_raw"
            ),
            argument("camera_info", "topic of the calibration", default="camera_info"),
            argument("readout_time", "s from the first to the last row; 0: unknown", default="0.0"),
            argument("scan_direction", "of the shutter", default="top_to_bottom"),
            argument("stamp_offset", "s from the stamp to the first row", default="0.0"),
            argument(
                "params_file",
                "parameters of the localizer",
                default=share("config", "rs_localizer.yaml"),
            ),
            *cameras,
            Node(
                package="rs_localizer",
                executable="marker_detector",
                name="marker_detector",
                namespace=namespace,
                parameters=[
                    share("config", "marker_detector.yaml"),
                    shutter,
                    {
                        "marker_map": ParameterValue(
                            LaunchConfiguration("marker_map"), value_type=str
                        )
                    },
                ],
                remappings=[
                    ("image", LaunchConfiguration("image")),
                    ("image/compressed", [LaunchConfiguration("image"), "/compressed"]),
                    ("camera_info", LaunchConfiguration("camera_info")),
                ],
                output="screen",
            ),
            Node(
                package="rs_localizer",
                executable="localizer",
                name="rs_localizer",
                namespace=namespace,
                parameters=[LaunchConfiguration("params_file"), shutter],
                remappings=[("camera_info", LaunchConfiguration("camera_info"))],
                output="screen",
            ),
        ]
    )
