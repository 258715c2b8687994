# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Parts of the launch files: every setting is an argument, and a wrong value ends the launch."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription  # type: ignore[attr-defined]  # not our folder of this name
from rs_localizer.config import NO_NAMES, DetectorConfig, NodeConfig
from rs_localizer.io.reading import YamlError, load_yaml
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.markers.maps import MarkerMapError
from rs_localizer.settings import NODES, Kind, SettingsError, load_params_file, settings

PACKAGE = "rs_localizer"
Texts = Mapping[str, str]
"""The launch arguments by name; empty: not given."""

# Arguments of a launch file that starts from a camera: names, defaults and descriptions.
CAMERA = {
    "image": ("image_raw", "topic of the raw images (never rectified ones)"),
    "camera_info": ("camera_info", "topic of the calibration"),
}


def share(*path: str) -> PathJoinSubstitution:
    """Return the path of a file that the package installs."""
    return PathJoinSubstitution([FindPackageShare(PACKAGE), *path])


def description(
    nodes: Callable[[Texts], list[Node]],
    kinds: Iterable[Kind] = (),
    others: Mapping[str, tuple[str, str]] | None = None,
) -> LaunchDescription:
    """Return the launch arguments, and what to start once they are known; RViz if wanted.

    Args:
        nodes: to start, given the arguments.
        kinds: of the settings of nodes besides the localizer's.
        others: default and description of arguments that are no settings.
    """
    own = {
        "namespace": ("", "of all nodes and their topics"),
        "use_sim_time": ("false", "take the time from /clock"),
        "log_level": ("info", "debug, info, warn, error or fatal"),
        "rviz": ("false", "start RViz with a view of the outputs, too"),
        **(others or {}),
    }
    for kind in (NodeConfig, *kinds):
        file = share("config", f"{NODES[kind]}.yaml")
        own[_file_of(kind)] = (file, f"parameters of {NODES[kind]}")
        for name, one in settings(kind).items():
            if "." not in name:
                own.setdefault(name, ("", f"{one.description} (not given: as in the params file)"))
    rviz = Node(
        package="rviz2", executable="rviz2", namespace=LaunchConfiguration("namespace"),
        arguments=["-d", share("config", "rs_localizer.rviz")],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )  # fmt: skip
    arguments = (
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in own.items()
    )
    start = OpaqueFunction(function=lambda context: nodes(context.launch_configurations))
    return LaunchDescription([*arguments, rviz, start])


def _file_of(kind: Kind) -> str:
    """Return the argument that names the params file of a node."""
    return "params_file" if kind is NodeConfig else f"{NODES[kind]}_params_file"


def given(texts: Texts, kind: Kind = NodeConfig) -> dict[str, Any]:
    """Return the settings of a node among the launch arguments; it refuses wrong ones itself."""
    return {
        name: _read(texts[name], setting.default)
        for name, setting in settings(kind).items()
        if texts.get(name)
    }


def _read(text: str, default: Any) -> Any:
    """Read the value of a text; a text of another type stays, and the node refuses it."""
    if isinstance(default, str):
        return text
    if default == NO_NAMES:
        return [word.strip() for word in text.strip("[] ").split(",")]
    with suppress(ValueError, YamlError):
        return float(text) if isinstance(default, float) else load_yaml(text)
    return text


def node(
    texts: Texts,
    kind: Kind,
    remappings: Mapping[str, str] | None = None,
    values: Mapping[str, Any] | None = None,
    namespace: str | None = None,
) -> Node:
    """Return a node of this package; when it ends, everything does.

    Args:
        texts: the launch arguments.
        kind: of its settings.
        remappings: of its topics.
        values: settings instead of those that were given.
        namespace: instead of the one that was given.

    Raises:
        ValueError: for a params file that is not there.
    """
    file = texts[_file_of(kind)]
    if not Path(file).expanduser().is_file():
        raise ValueError(f"{_file_of(kind)}: {file} does not exist")
    chosen = given(texts, kind) if values is None else values
    # Or "1" as the name of a frame would become a number.
    typed = {k: ParameterValue(v, value_type=str) if isinstance(v, str) else v
             for k, v in chosen.items()}  # fmt: skip
    typed["use_sim_time"] = texts["use_sim_time"].lower() == "true"
    name = NODES[kind]
    return Node(
        package=PACKAGE, executable="localizer" if kind is NodeConfig else name, name=name,
        namespace=texts["namespace"] if namespace is None else namespace,
        parameters=[file, typed], remappings=list((remappings or {}).items()),
        arguments=["--ros-args", "--log-level", texts["log_level"]],
        output="screen", on_exit=Shutdown(reason=f"{name} has ended"),
    )  # fmt: skip


def from_camera(texts: Texts, kind: Kind, values: Mapping[str, Any] | None = None) -> list[Node]:
    """Return a detector of this kind and the localizer, of a camera whose driver runs.

    Args:
        values: settings of the localizer instead of those that were given.
    """
    image = texts["image"]
    return [
        node(texts, kind, {"image": image, "image/compressed": f"{image}/compressed"}),
        node(texts, NodeConfig, {"camera_info": texts["camera_info"]}, values),
    ]


def with_board(texts: Texts) -> dict[str, Any]:
    """Return settings beside a marker detector: the deviation of the boards in its map.

    Given arguments and settings of its params file take precedence.
    """
    values = given({name: text for name, text in texts.items() if name != "marker_map"})
    with suppress(SettingsError, MarkerMapError):  # the nodes say what is wrong with their files
        if "map_deviation" not in values and not load_params_file(Path(texts["params_file"])).get(
            "map_deviation"
        ):
            file = texts["marker_map"] or load_params_file(
                Path(texts[_file_of(DetectorConfig)]), DetectorConfig
            ).get("marker_map", "")
            values |= read_marker_map(Path(file).expanduser()).settings
    return values
