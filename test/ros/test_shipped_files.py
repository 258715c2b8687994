"""Launch files and views name what the node has; they are run by hand where ROS is installed."""

from __future__ import annotations

import json
import re
import runpy
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml

from rs_localizer.io.outputs import TYPES
from rs_localizer.ros.feed import Feed
from rs_localizer.settings import NODE_NAME

ROOT = Path(__file__).parents[2]
# Displays of RViz and what they can show.
RVIZ = {
    "PoseWithCovariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "Odometry": "nav_msgs/msg/Odometry",
    "PointCloud2": "sensor_msgs/msg/PointCloud2",
}


class Piece:
    """Stands in for everything of launch and launch_ros: it keeps what it was made of."""

    def __init__(self, kind: str, arguments: tuple[Any, ...], options: dict[str, Any]) -> None:
        self.kind, self.arguments, self.options = kind, arguments, options


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


@pytest.fixture
def describe(monkeypatch: pytest.MonkeyPatch) -> Any:
    for name in (
        *("launch", "launch.actions", "launch.conditions", "launch.launch_description_sources"),
        *("launch.substitutions", "launch_ros", "launch_ros.actions", "launch_ros.substitutions"),
        "launch_ros.parameter_descriptions",
    ):
        monkeypatch.setitem(sys.modules, name, Fake(name))
    return lambda file: pieces(
        runpy.run_path(str(ROOT / "launch" / file))["generate_launch_description"]()
    )


def declared(description: list[Piece]) -> set[str]:
    return {piece.arguments[0] for piece in description if piece.kind == "DeclareLaunchArgument"}


def used(description: list[Piece]) -> set[str]:
    return {piece.arguments[0] for piece in description if piece.kind == "LaunchConfiguration"}


@pytest.mark.parametrize("file", [path.name for path in (ROOT / "launch").glob("*.launch.py")])
def test_arguments_and_files_exist(describe: Any, file: str) -> None:
    description = describe(file)
    assert used(description) == declared(description)
    shared = [
        piece.arguments[0][1:] for piece in description if piece.kind == "PathJoinSubstitution"
    ]
    assert shared
    for path in shared:
        assert ROOT.joinpath(*path).is_file()
    for piece in description:
        if piece.kind == "Node" and piece.options["package"] == "rs_localizer":
            assert (
                f"{piece.options['executable']} = rs_localizer." in (ROOT / "setup.py").read_text()
            )


def test_every_input_can_be_remapped(describe: Any) -> None:
    unused: Any = None
    inputs = set(Feed(unused, unused, unused, unused).topics())
    (launched,) = [
        piece
        for piece in describe("localizer.launch.py")
        if piece.kind == "Node" and piece.options["executable"] == "localizer"
    ]
    assert {name for name, _ in launched.options["remappings"]} == inputs
    assert launched.options["name"] == NODE_NAME


def test_two_cameras_pass_on_what_one_camera_takes(describe: Any) -> None:
    known = declared(describe("localizer.launch.py"))
    included = [
        piece
        for piece in describe("two_cameras.launch.py")
        if piece.kind == "IncludeLaunchDescription"
    ]
    assert len({id(piece.arguments[0]) for piece in included}) == 2
    for piece in included:
        assert {name for name, _ in piece.options["launch_arguments"]} <= known


def test_rviz_shows_what_the_node_publishes() -> None:
    view = yaml.safe_load((ROOT / "config" / "rs_localizer.rviz").read_text())
    displays = view["Visualization Manager"]["Displays"]
    shown = {
        item["Topic"]["Value"].removeprefix(f"{NODE_NAME}/"): RVIZ[item["Class"].split("/")[1]]
        for item in displays
        if "Topic" in item
    }
    assert shown.items() <= TYPES.items()
    assert set(shown) == {"pose_with_covariance", "odometry", "inliers"}
    assert "rviz_default_plugins/TF" in [item["Class"] for item in displays]


def test_foxglove_shows_what_the_node_publishes() -> None:
    text = (ROOT / "config" / "rs_localizer.foxglove.json").read_text()
    layout = json.loads(text)
    topics = set(re.findall(rf'"/{NODE_NAME}/(\w+)', text))
    assert {"pose_with_covariance", "inliers", "twist"} <= topics <= set(TYPES)
    panels = re.findall(r'"(?:first|second)": "([^"]+)"', text)
    assert sorted(panels) == sorted(layout["configById"])
