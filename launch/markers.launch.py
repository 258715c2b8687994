"""From a camera to poses by markers or a board: camera driver, marker detector, localizer.

ros2 launch rs_localizer markers.launch.py camera:=v4l2_camera marker_map:=$PWD/wall.yaml \
    readout_time:=0.02 calibration:=file://$PWD/camera.yaml
"""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from launch.actions import OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchContext, LaunchDescription
from rs_localizer.config import DetectorConfig, NodeConfig
from rs_localizer.ros.launching import (
    argument,
    common_arguments,
    given,
    localizer,
    need_package,
    setting_arguments,
    share,
    views,
)
from rs_localizer.settings import DETECTOR_NAME, Kind, SettingsError, load_params_file, settings

# Drivers by their package, and their executables; both publish image_raw and camera_info.
DRIVERS = {"v4l2_camera": "v4l2_camera_node", "usb_cam": "usb_cam_node_exe"}


def generate_launch_description() -> LaunchDescription:
    """The nodes share a namespace, in which they find each other."""
    common = common_arguments()
    known = {item.name for item in common}
    return LaunchDescription(
        [
            argument(
                "camera",
                "none",
                "driver to start: v4l2_camera or usb_cam; none: one that runs already",
            ),
            argument("calibration", "", "URL of the camera's calibration, for the driver"),
            argument("image", "image_raw", "topic of the raw images (never rectified ones)"),
            argument("camera_info", "camera_info", "topic of the calibration"),
            argument(
                "detector_params_file",
                share("config", "marker_detector.yaml"),
                "parameters of marker_detector",
            ),
            *common,
            *(item for item in setting_arguments(DetectorConfig) if item.name not in known),
            OpaqueFunction(function=_nodes),
        ]
    )


def _nodes(context: LaunchContext) -> list:
    chosen = context.launch_configurations
    if not (
        chosen["marker_map"]
        or _read(chosen["detector_params_file"], DetectorConfig).get("marker_map")
    ):
        raise RuntimeError("marker_map must name a file: rs_localizer markers make writes one")
    localizer_topics = [("camera_info", LaunchConfiguration("camera_info"))]
    return [
        *_camera(chosen),
        *views(chosen),
        Node(
            package="rs_localizer",
            executable="marker_detector",
            name=DETECTOR_NAME,
            namespace=LaunchConfiguration("namespace"),
            parameters=[
                LaunchConfiguration("detector_params_file"),
                _shutter(chosen["params_file"]) | given(chosen, DetectorConfig),
            ],
            remappings=[
                ("image", LaunchConfiguration("image")),
                ("image/compressed", [LaunchConfiguration("image"), "/compressed"]),
                *localizer_topics,
            ],
            arguments=["--ros-args", "--log-level", LaunchConfiguration("log_level")],
            output="screen",
        ),
        localizer(chosen, localizer_topics),
    ]


def _camera(chosen: Mapping[str, str]) -> list[Node]:
    """The driver; nothing has been started when it is refused."""
    package = chosen["camera"]
    if package == "none":
        return []
    if package not in DRIVERS:
        raise RuntimeError(f"camera must be one of none, {', '.join(DRIVERS)}; got {package!r}")
    need_package(package, f"camera:={package}")
    url = ParameterValue(chosen["calibration"], value_type=str)
    return [
        Node(
            package=package,
            executable=DRIVERS[package],
            name="camera",
            namespace=LaunchConfiguration("namespace"),
            parameters=[{"camera_info_url": url} | _sim_time(chosen)],
            output="screen",
        )
    ]


def _sim_time(chosen: Mapping[str, str]) -> dict[str, Any]:
    return {name: value for name, value in given(chosen).items() if name == "use_sim_time"}


def _shutter(params_file: str) -> dict[str, Any]:
    """What the localizer's params file says of the shutter, for the detector's debug image."""
    values = _read(params_file, NodeConfig)
    return {name: values[name] for name in settings(DetectorConfig) if name in values}


def _read(params_file: str, kind: Kind) -> dict[str, Any]:
    with suppress(SettingsError):  # of which the node will tell
        return load_params_file(Path(params_file), kind)
    return {}
