# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What the launch files share: arguments that are settings, and checks before anything starts."""

import difflib
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from rs_localizer.config import NO_NAMES, DetectorConfig, NodeConfig
from rs_localizer.settings import (
    NODE_NAME,
    NODES,
    Kind,
    SettingsError,
    load_params_file,
    settings,
)

PACKAGE = "rs_localizer"
# Drivers by their package, and their executables; both publish image_raw and camera_info.
DRIVERS = {"v4l2_camera": "v4l2_camera_node", "usb_cam": "usb_cam_node_exe"}


# Settings that name files, with the argument that names the params file of their node.
_FILES: tuple[tuple[str, Kind, str], ...] = (
    ("params_file", NodeConfig, "map_file"),
    ("params_file", NodeConfig, "marker_map"),
    ("detector_params_file", DetectorConfig, "marker_map"),
)
# An unknown argument that is so much like a known one (difflib) is a slip of the pen; others may
# belong to the launch file that includes these.
_ALIKE = 0.85
_RESPAWN_DELAY = 2.0  # s: a node that cannot start shall not take the whole CPU


def share(*path: str) -> PathJoinSubstitution:
    """A file that the package installs."""
    return PathJoinSubstitution([FindPackageShare(PACKAGE), *path])


def argument(name: str, default: object, description: str) -> DeclareLaunchArgument:
    return DeclareLaunchArgument(name, default_value=default, description=description)


def setting_arguments(kind: Kind = NodeConfig) -> list[DeclareLaunchArgument]:
    """An argument for each setting of a node; not given, the params file decides."""
    return [
        argument(name, "", f"{setting.description} (not given: as in the params file)")
        for name, setting in settings(kind).items()
        if "." not in name
    ]


def chosen_parameters(configurations: Mapping[str, str], kind: Kind = NodeConfig) -> dict[str, Any]:
    """The parameters of a node that were given as arguments, ``use_sim_time`` among them.

    What cannot be read as the setting's type goes on as text: the node says what is wrong with it.
    """
    defaults: dict[str, Any] = {name: item.default for name, item in settings(kind).items()}
    defaults["use_sim_time"] = False
    return {
        name: _typed(text, defaults[name])
        for name, text in configurations.items()
        if name in defaults and text != ""
    }


def _typed(text: str, default: Any) -> Any:
    if isinstance(default, bool):
        return {"true": True, "false": False}.get(text.lower(), text)
    if default == NO_NAMES:
        return [word.strip() for word in text.strip("[] ").split(",")]
    if isinstance(default, (int, float)):
        try:
            return type(default)(text)
        except ValueError:
            return text
    return ParameterValue(text, value_type=str)  # or "1" would become a number


def read_params(params_file: str, kind: Kind) -> dict[str, Any]:
    """The settings of a node in a params file; none where the node will refuse it."""
    with suppress(SettingsError):
        return load_params_file(Path(params_file), kind)
    return {}


def starting(
    arguments: Sequence[DeclareLaunchArgument], nodes: Callable[[Any], list[Any]]
) -> list[Any]:
    """Arguments, and what to start once they are known, if they can be right.

    Args:
        nodes: makes it of the launch context.
    """
    names = [item.name for item in arguments]

    def function(context: Any) -> list[Any]:
        need_known(getattr(context, "argv", None) or (), names)
        need_files(context.launch_configurations)
        return nodes(context)

    return [*arguments, OpaqueFunction(function=function)]


def need_known(words: Iterable[str], names: Sequence[str]) -> None:
    """Name arguments of the command line, ``NAME:=VALUE``, that no launch file takes.

    Raises:
        RuntimeError: for one that is nearly the name of another.
    """
    for name in (word.split(":=")[0] for word in words if ":=" in word):
        if name in names:
            continue
        if alike := difflib.get_close_matches(name, names, 1, _ALIKE):
            raise RuntimeError(f"unknown launch argument {name!r}: did you mean {alike[0]!r}?")
        logging.getLogger(PACKAGE).warning(
            f"unknown launch argument {name!r} (ros2 launch --show-args)"
        )


def need_files(configurations: Mapping[str, str]) -> None:
    """Raise ``RuntimeError`` if a file that is named does not exist."""
    files = {name: text for name, text in configurations.items() if name.endswith("params_file")}
    for params_file, kind, name in _FILES:
        if params_file in configurations:
            parameters = read_params(configurations[params_file], kind)
            files[name] = configurations.get(name) or parameters.get(name, "")
    for name, text in files.items():
        if text and not Path(text).expanduser().exists():
            raise RuntimeError(f"{name}: {text} does not exist")


def lifetime(configurations: Mapping[str, str]) -> dict[str, Any]:
    """What happens when a node ends: it starts again, or everything is shut down."""
    if configurations["respawn"].lower() == "true":
        return {"respawn": True, "respawn_delay": _RESPAWN_DELAY}
    return {"on_exit": Shutdown(reason="a node of rs_localizer has ended")}


def need_package(name: str, why: str) -> None:
    """Raise ``RuntimeError`` if a package is not installed, before anything has been started."""
    try:
        get_package_prefix(name)
    except PackageNotFoundError:
        raise RuntimeError(
            f"{why} needs the package {name}, which is not installed: "
            f"sudo apt install ros-jazzy-{name.replace('_', '-')}"
        ) from None


def own_node(
    configurations: Mapping[str, str], executable: str, name: str, parameters: list[Any],
    remappings: Iterable[tuple[str, Any]] = (), namespace: Any = None,
) -> Node:  # fmt: skip
    """A node of this package, with its log level; in the namespace of all unless one is given."""
    return Node(
        package=PACKAGE,
        executable=executable,
        name=name,
        namespace=LaunchConfiguration("namespace") if namespace is None else namespace,
        parameters=parameters,
        remappings=list(remappings),
        arguments=["--ros-args", "--log-level", LaunchConfiguration("log_level")],
        output="screen",
        **lifetime(configurations),
    )


def localizer(
    configurations: Mapping[str, str], remappings: Iterable[tuple[str, Any]],
    of_map: Mapping[str, Any] | None = None,
) -> Node:  # fmt: skip
    """The node rs_localizer with its params file, what its map says, and the given settings."""
    given = {**(of_map or {}), **chosen_parameters(configurations)}
    parameters = [LaunchConfiguration("params_file"), given]
    return own_node(configurations, "localizer", NODE_NAME, parameters, remappings)


def views(configurations: Mapping[str, str]) -> list[Node]:
    """RViz, if it is asked for."""
    if configurations["rviz"].lower() != "true":
        return []
    need_package("rviz2", "rviz:=true")
    return [
        Node(
            package="rviz2",
            executable="rviz2",
            # Its topics are relative, so that they lie in this namespace, too.
            namespace=LaunchConfiguration("namespace"),
            arguments=["-d", share("config", "rs_localizer.rviz")],
        )
    ]


def common_arguments() -> list[DeclareLaunchArgument]:
    """Of every launch file with a localizer."""
    return [
        argument("namespace", "", "of all nodes and their topics"),
        argument("params_file", share("config", "rs_localizer.yaml"), "parameters of rs_localizer"),
        argument("use_sim_time", "", "true: take the time from /clock"),
        argument("log_level", "info", "debug, info, warn, error or fatal"),
        argument("respawn", "false", "true: start a node again that ends; false: end all others"),
        argument("rviz", "false", "start RViz with a view of the node's outputs, too"),
        *setting_arguments(),
    ]


def from_camera(kind: Kind, params_argument: str, nodes: Callable[[Any], list[Node]]) -> list[Any]:
    """From images to poses: arguments for a camera, a detector and the localizer, and their nodes.

    Args:
        kind: the detector's settings.
        params_argument: the launch argument that names its params file.
        nodes: to start, when the launch context knows the arguments.
    """
    common = common_arguments()
    declared = {item.name for item in common}
    name = NODES[kind]
    arguments = [
        argument(
            "camera",
            "none",
            "driver to start: v4l2_camera or usb_cam; none: one that runs already",
        ),
        argument("calibration", "", "URL of the camera's calibration, for the driver"),
        argument("image", "image_raw", "topic of the raw images (never rectified ones)"),
        argument("camera_info", "camera_info", "topic of the calibration"),
        argument(params_argument, share("config", f"{name}.yaml"), f"parameters of {name}"),
        *common,
        *(item for item in setting_arguments(kind) if item.name not in declared),
    ]
    return starting(arguments, nodes)


def camera_driver(configurations: Mapping[str, str]) -> list[Node]:
    """The driver, if it is asked for; nothing has been started when it is refused."""
    package = configurations["camera"]
    if package == "none":
        return []
    if package not in DRIVERS:
        raise RuntimeError(f"camera must be one of none, {', '.join(DRIVERS)}; got {package!r}")
    need_package(package, f"camera:={package}")
    url = ParameterValue(configurations["calibration"], value_type=str)
    chosen = chosen_parameters(configurations)
    time = {name: chosen[name] for name in chosen if name == "use_sim_time"}
    return [
        Node(
            package=package,
            executable=DRIVERS[package],
            name="camera",
            namespace=LaunchConfiguration("namespace"),
            parameters=[{"camera_info_url": url} | time],
            output="screen",
            **lifetime(configurations),
        )
    ]


def detector(
    configurations: Mapping[str, str], name: str, params_file: str, parameters: Mapping[str, Any]
) -> Node:
    """A node that looks at the camera's images; its executable has its name.

    Args:
        configurations: the launch arguments.
        name: of the node.
        params_file: the launch argument that names its params file.
        parameters: those that were given besides.
    """
    image = LaunchConfiguration("image")
    remappings = [
        ("image", image),
        ("image/compressed", [image, "/compressed"]),
        ("camera_info", LaunchConfiguration("camera_info")),
    ]
    given = [LaunchConfiguration(params_file), dict(parameters)]
    return own_node(configurations, name, name, given, remappings)
