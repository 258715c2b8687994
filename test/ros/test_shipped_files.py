# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Launch files and views name what the node has; they are run by hand where ROS is installed."""

import json
import re
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
import rclpy
import yaml
from rclpy.context import Context

from rs_localizer.config import DetectorConfig, FeatureConfig, NodeConfig
from rs_localizer.io.outputs import TYPES
from rs_localizer.io.recording import PARAMETERS
from rs_localizer.io.topics import DEBUG_IMAGE, LIVE, MAP_MARKERS, MAP_TO_ODOM
from rs_localizer.markers.map_files import write_marker_map
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.prints import Chessboard
from rs_localizer.pipeline.inputs import INPUTS
from rs_localizer.ros import main
from rs_localizer.ros.localizer.node import LocalizerNode
from rs_localizer.settings import (
    DETECTOR_NAME,
    NODE_NAME,
    build,
    load_params_file,
    settings,
    write_parameters,
)

ROOT = Path(__file__).parents[2]
# Displays of RViz and what they can show.
RVIZ = {
    "PoseWithCovariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "Odometry": "nav_msgs/msg/Odometry",
    "PointCloud2": "sensor_msgs/msg/PointCloud2",
    "MarkerArray": "visualization_msgs/msg/MarkerArray",
    "Image": "sensor_msgs/msg/Image",
}
# What the nodes publish, by its name in the namespace of both.
SENT = {
    **{f"{NODE_NAME}/{name}": kind for name, kind in {**TYPES, **LIVE}.items()},
    f"{DETECTOR_NAME}/{MAP_MARKERS}": LIVE[MAP_MARKERS],
    f"{DETECTOR_NAME}/{DEBUG_IMAGE}": "sensor_msgs/msg/Image",
}


class Piece:
    """Stands in for everything of launch and launch_ros: it keeps what it was made of."""

    def __init__(self, kind: str, arguments: tuple[Any, ...], options: dict[str, Any]) -> None:
        self.kind, self.arguments, self.options = kind, arguments, options

    @property
    def name(self) -> str:
        return str(self.arguments[0])

    @property
    def installed(self) -> Path:
        """The file of the sources that is joined from where the package is."""
        return ROOT.joinpath(*self.arguments[0][1:])


class Fake(ModuleType):
    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return lambda *arguments, **options: Piece(name, arguments, options)


def pieces(item: Any) -> list[Piece]:
    """All of a launch description, from the outside in."""
    if isinstance(item, Piece):
        inside = [*item.arguments, *item.options.values()]
        return [item, *(piece for part in inside for piece in pieces(part))]
    if isinstance(item, dict):
        return [piece for part in item.values() for piece in pieces(part)]
    if isinstance(item, (str, type)) or not hasattr(item, "__iter__"):
        return []
    return [piece for part in item for piece in pieces(part)]


Describe = Callable[..., list[Piece]]


@pytest.fixture
def describe(monkeypatch) -> Describe:
    """All of a launch file when these arguments are given."""
    for name in (
        *("launch", "launch.actions", "launch.conditions", "launch.substitutions", "launch_ros"),
        *("launch_ros.actions", "launch_ros.substitutions", "launch_ros.parameter_descriptions"),
    ):
        monkeypatch.setitem(sys.modules, name, Fake(name))
    monkeypatch.delitem(sys.modules, "rs_localizer.ros.launching", raising=False)

    def describe(file: str, **given: str) -> list[Piece]:
        code = runpy.run_path(str(ROOT / "launch" / file))
        found = pieces(code["generate_launch_description"]())
        defaults = declared(found)
        assert given.keys() <= defaults.keys()
        context = SimpleNamespace(launch_configurations=defaults | given)
        for piece in list(found):
            if piece.kind == "OpaqueFunction":
                found += pieces(piece.options["function"](context))
        return found

    yield describe
    sys.modules.pop("rs_localizer.ros.launching", None)


def declared(description: list[Piece]) -> dict[str, str]:
    """Arguments of a launch file, and what they are when none is given."""
    values = {
        piece.name: piece.options["default_value"]
        for piece in description
        if piece.kind == "DeclareLaunchArgument"
    }
    return {k: str(v.installed) if isinstance(v, Piece) else v for k, v in values.items()}


def nodes(description: list[Piece], executable: str) -> list[dict[str, Any]]:
    """Options of the nodes that are started."""
    started = [piece.options for piece in description if piece.kind == "Node"]
    return [options for options in started if options["executable"] == executable]


def parameters(description: list[Piece], executable: str) -> dict[str, Any]:
    """What a node gets besides its params file."""
    ((file, given),) = (options["parameters"] for options in nodes(description, executable))
    assert Path(file).is_file()
    return {k: v.arguments[0] if isinstance(v, Piece) else v for k, v in given.items()}


WALL = __file__  # any file that exists
MAP = {"markers.launch.py": {"marker_map": WALL}, "rig.launch.py": {"cameras": "front, rear"}}
LOCALIZING = ["localizer.launch.py", "markers.launch.py", "features.launch.py"]
DETECTORS = {"markers.launch.py": DetectorConfig, "features.launch.py": FeatureConfig}


@pytest.mark.parametrize("file", [path.name for path in (ROOT / "launch").glob("*.launch.py")])
def test_arguments_and_files_exist(describe, file):
    description = describe(file, **MAP.get(file, {}))
    shared = [piece.installed for piece in description if piece.kind == "PathJoinSubstitution"]
    assert shared
    assert all(path.is_file() for path in shared)
    for piece in description:
        if piece.kind == "Node" and piece.options["package"] == "rs_localizer":
            declared = f"{piece.options['executable']} = rs_localizer."
            assert declared in (ROOT / "setup.py").read_text()


def test_every_input_can_be_remapped(describe):
    inputs = set(LocalizerNode.topics(Mock(), NodeConfig())) | set(INPUTS)
    inputs -= {name for name in inputs if name.startswith("~/")}
    (launched,) = nodes(describe("localizer.launch.py"), "localizer")
    assert {name for name, _ in launched["remappings"]} == inputs
    assert launched["name"] == NODE_NAME


@pytest.mark.parametrize("file", LOCALIZING)
def test_every_setting_can_be_given(describe, file):
    names = {name for name in settings() if "." not in name}
    if file in DETECTORS:
        names |= set(settings(DETECTORS[file]))
    assert names | {"use_sim_time"} <= declared(describe(file, **MAP.get(file, {}))).keys()
    words = {"readout_time": ("2e-2", 0.02), "seed": ("3", 3), "tracking": ("False", False),
             "map_frame": ("1", "1"), "use_sim_time": ("true", True),
             "scan_direction": ("bottom_to_top", "bottom_to_top")}  # fmt: skip
    given = {name: typed for name, (typed, _) in words.items()}
    found = parameters(describe(file, **MAP.get(file, {}), **given), "localizer")
    assert found == {name: value for name, (_, value) in words.items()}


def test_the_localizer_knows_how_well_a_board_is_known(describe, tmp_path):
    file = tmp_path / "board.yaml"
    board = Chessboard(6, 4, 0.03, deviation=2.5e-4)
    write_marker_map(file, MarkerMap(boards=(board,)))
    chosen = {"marker_map": str(file)}
    found = parameters(describe("markers.launch.py", **chosen), "localizer")
    assert found == {"map_deviation": pytest.approx(2.5e-4), "use_sim_time": False}
    given = describe("markers.launch.py", **chosen, map_deviation="0.0")
    assert parameters(given, "localizer")["map_deviation"] == 0.0
    own = tmp_path / "own.yaml"
    own.write_text("/**:\n  ros__parameters: {map_deviation: 0.001}\n")
    chosen["params_file"] = str(own)
    assert "map_deviation" not in parameters(describe("markers.launch.py", **chosen), "localizer")


@pytest.mark.parametrize(
    ("file", "given", "text"),
    [
        ("localizer.launch.py", {"params_file": "/nowhere"}, "^params_file: /nowhere does not"),
        ("rig.launch.py", {"cameras": ""}, "cameras must name the cameras"),
    ],
)
def test_what_cannot_be_started_fails_before_anything_is(describe, file, given, text):
    with pytest.raises(ValueError, match=text):
        describe(file, **(MAP.get(file, {}) | given))


def test_each_camera_of_a_rig_has_a_detector_in_its_namespace(describe):
    found = describe("rig.launch.py", cameras="[front, rear]", marker_map=WALL, namespace="robot")
    detectors = nodes(found, "marker_detector")
    assert [options["namespace"] for options in detectors] == ["robot/front", "robot/rear"]
    for options in detectors:
        assert options["parameters"][1]["marker_map"].arguments == (WALL,)
    (launched,) = nodes(found, "localizer")
    assert launched["parameters"][1]["cameras"] == ["front", "rear"]


@pytest.mark.parametrize("namespace", ["/", "/front", "/robot/front"])
def test_the_parameters_of_a_recording_hold_in_every_namespace(tmp_path, namespace):
    shutter = {"readout_time": 0.021, "scan_direction": "bottom_to_top"}
    write_parameters(tmp_path / "parameters.yaml", shutter)
    context = Context()
    rclpy.init(args=["--ros-args", "--params-file", str(tmp_path / PARAMETERS)], context=context)
    made = rclpy.create_node(NODE_NAME, namespace=namespace, context=context)
    try:
        assert made.declare_parameter("readout_time", 0.0).value == 0.021
        assert made.declare_parameter("scan_direction", "").value == "bottom_to_top"
    finally:
        made.destroy_node()
        rclpy.shutdown(context=context)
    assert load_params_file(tmp_path / PARAMETERS)["readout_time"] == 0.021


def test_viewers_show_what_the_nodes_publish():
    view = yaml.safe_load((ROOT / "config" / "rs_localizer.rviz").read_text())
    displays = [item for item in view["Visualization Manager"]["Displays"] if "Topic" in item]
    shown = {item["Topic"]["Value"]: RVIZ[item["Class"].split("/")[1]] for item in displays}
    assert shown.items() <= SENT.items()
    text = (ROOT / "config" / "rs_localizer.foxglove.json").read_text()
    topics = set(re.findall(r'"/(\w+/\w+)', text))
    assert topics <= set(SENT)
    assert len(shown) == len(topics) == 8
    panels = re.findall(r'"(?:first|second)": "([^"]+)"', text)
    assert sorted(panels) == sorted(json.loads(text)["configById"])


def test_nav2_manages_the_node():
    file = ROOT / "config" / "nav2.yaml"
    config = build(load_params_file(file))
    assert (config.autostart, config.publish_tf) == (False, "map_to_odom")
    manager = yaml.safe_load(file.read_text())["/**/lifecycle_manager_localization"]
    assert NODE_NAME in manager["ros__parameters"]["node_names"]
    assert manager["ros__parameters"]["bond_timeout"] == 4.0  # nav2's default
    condition = (ROOT / "examples" / "nav2_is_localized.cpp").read_text()
    topic = f"/{NODE_NAME}/{MAP_TO_ODOM}"
    assert f'InputPort<std::string>("topic", "{topic}"' in condition
    assert topic.lstrip("/") in SENT


def test_robot_localization_listens_to_what_the_node_publishes():
    file = ROOT / "config" / "robot_localization.yaml"
    found = yaml.safe_load(file.read_text())["/**/ekf_map"]["ros__parameters"]
    kinds = {"pose0": "geometry_msgs/msg/PoseWithCovarianceStamped",
             "twist0": "geometry_msgs/msg/TwistWithCovarianceStamped"}  # fmt: skip
    for name, kind in kinds.items():
        assert TYPES[found[name].removeprefix(f"/{NODE_NAME}/")] == kind
    for name in ("odom0", *kinds):
        assert [type(item) for item in found[f"{name}_config"]] == [bool] * 15
    assert found["world_frame"] == found["map_frame"]


def test_only_what_is_for_ros_is_handed_on(capsys):
    for words in ("", "--ros-args -r imu:=/imu --log-level debug", "--ros-args -p a:=1 --"):
        main.check_words("localizer", words.split())
    for words, code in (("--badarg", 2), ("imu:=/imu", 2), ("--ros-args -p a:=1 -- --help", 0)):
        with pytest.raises(SystemExit) as end:
            main.main(words.split())
        assert end.value.code == code
        said = capsys.readouterr()
        assert "localizer --ros-args [-p NAME:=VALUE]" in said.out + said.err
        assert words.split()[-1] in said.out + said.err
