# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters, clock and views of a node."""

import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import rclpy
from rclpy.clock import ClockType
from rclpy.context import Context
from rclpy.parameter import Parameter
from rclpy.time import Time
from scipy.spatial.transform import Rotation

from rs_localizer.config import NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.io.camera_files import lens_parameters
from rs_localizer.io.rigs import RigParts, mounted_lenses, node_parameters
from rs_localizer.ros.node.clock import watch_clock
from rs_localizer.ros.node.parameters import SettingsNode
from rs_localizer.ros.node.views import camera_marker
from rs_localizer.settings import settings, write_parameters


@pytest.fixture
def context() -> Iterator[Context]:
    context = Context()
    rclpy.init(context=context)
    yield context
    rclpy.shutdown(context=context)


class Recorder(SettingsNode[NodeConfig]):
    """A node with the parameters, that refuses one seed and keeps what is applied."""

    def __init__(self, context: Context, *arguments: str) -> None:
        words = ["--ros-args", *arguments]
        self.applied: list[NodeConfig] = []
        self.warnings: list[str] = []
        super().__init__("some_node", NodeConfig, context=context, cli_args=words)

    def warn(self, text: str) -> None:
        self.warnings.append(text)

    def change(self, config: NodeConfig) -> None:
        self.applied.append(config)

    def check(self, config: NodeConfig) -> None:
        if config.seed == 13:
            raise ValueError("13 brings bad luck")

    def set_all(self, **values: object) -> tuple[bool, str]:
        changes = [
            Parameter(name.replace("__", "."), value=value) for name, value in values.items()
        ]
        result = self.set_parameters_atomically(changes)
        return result.successful, result.reason


@pytest.fixture
def recorder(context) -> Iterator[Recorder]:
    recorder = Recorder(context)
    yield recorder
    recorder.destroy_node()


def test_every_setting_is_a_parameter_with_its_default(recorder):
    assert recorder.config == NodeConfig()
    for name, setting in settings().items():
        value = recorder.get_parameter(name).value
        assert value == setting.default
        assert type(value) is type(setting.default)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"solver": "epnp"}, "solver must be one of .*; got 'epnp'"),
        ({"inlier_threshold": 0.0}, "inlier_threshold out of range.*0.01.*1000.0.*0.0"),
        ({"seed": 1.5}, "Wrong parameter type"),
        ({"autostart": False}, "read-only parameter: autostart"),
        ({"inlier_threshold": 3.0, "seed": 13}, "13 brings bad luck"),
    ],
)
def test_what_is_refused_stays_as_it_was(recorder, change, reason):
    successful, text = recorder.set_all(**change)
    assert not successful
    assert re.search(reason, text)
    assert recorder.applied == []
    assert recorder.config == NodeConfig()


@pytest.mark.parametrize(
    ("assignment", "text"),
    [
        ("solver:=epnp", "solver must be one of"),
        ("readout_time:=0.5", r"readout_time out of range"),
        ("inlier_threshold:=-3", r"got -3 \(write -3\.0\)$"),
        ("seed:=high", "seed must be of type int, got 'high'$"),
    ],
)
def test_bad_values_at_start(context, assignment, text):
    with pytest.raises(ValueError, match=text):
        Recorder(context, "-p", assignment)


@pytest.mark.parametrize("way", ["--params-file", "camera_file"])
def test_a_file_of_a_camera_or_of_a_rig_is_a_params_file_too(context, tmp_path, way):
    """Its lens is no parameter; the file of all defaults does not take back what it says."""
    file, shipped = tmp_path / "camera.yaml", Path("config/rs_localizer.yaml").absolute()
    K = np.array([[400.0, 0.0, 319.5], [0.0, 400.0, 239.5], [0.0, 0.0, 1.0]])
    cameras = {name: Camera(640, 480, K, readout_time=0.02) for name in ("a", "b")}
    parts = RigParts(cameras, dict.fromkeys(cameras, (np.eye(3), np.zeros(3))), {"b": 0.01})
    one = {"readout_time": 0.021, "min_inliers": 9}
    words = ["-r", "__node:=rs_localizer", "--params-file", str(shipped)]
    words += [way, str(file)] if way != "camera_file" else ["-p", f"camera_file:={file}"]
    configs = []
    for values, lens in (
        (one, lens_parameters(cameras["a"])), (node_parameters(parts), mounted_lenses(parts))
    ):  # fmt: skip
        write_parameters(file, values, lens)
        made = Recorder(context, *words, "-p", "min_inliers:=11")
        assert made.warnings == []
        configs.append(made.config)
        made.destroy_node()
    assert (configs[0].readout_time, configs[0].min_inliers) == (0.021, 11)
    assert configs[1].cameras == ("a", "b")
    own = configs[1].of_cameras["b"]
    assert (own.readout_time, own.stamp_offset) == (0.02, 0.01)


def test_a_node_hears_jumps_and_no_steps(peer):
    simulated = [Parameter("use_sim_time", value=True)]
    node = rclpy.create_node("simulated", context=peer.node.context, parameter_overrides=simulated)
    told: list[float] = []
    handle = watch_clock(node, told.append)

    def set_to(seconds: float) -> None:
        stamp = Time(nanoseconds=round(1e9 * seconds), clock_type=ClockType.ROS_TIME)
        node.get_clock().set_ros_time_override(stamp)

    for tick in range(20):  # the first one sets it
        set_to(1e9 + 0.1 * tick)
    assert told == []
    set_to(3.0)
    assert told.pop() == pytest.approx(-1e9 + 1.1)
    for tick in range(20):  # played tenfold
        set_to(5.0 + 1.0 * tick)
    assert told == []
    set_to(60.0)
    set_to(60.1)
    assert told == pytest.approx([36.0])
    set_to(20.0)
    assert told[1:] == pytest.approx([-40.1])
    node.set_parameters([Parameter("use_sim_time", value=False)])
    assert len(told) == 3
    handle.unregister()
    node.destroy_node()


def numbers(points: Any) -> Any:
    return np.array([[p.x, p.y, p.z] for p in points])


@pytest.mark.parametrize(
    ("doubt", "color"),
    [(0.0, (0, 1, 0)), (0.5, (1, 1, 0)), (1.0, (1, 0, 0)), (np.nan, (0.2, 0.5, 1.0))],
)
def test_the_camera_stands_where_it_is_and_its_colour_is_the_doubt(doubt, color):
    turn = Rotation.from_euler("xyz", [20, -40, 70], degrees=True)
    estimate = SimpleNamespace(
        rotation=turn.inv().as_matrix(), position=np.array([1.0, 2.0, 3.0]), integrity=doubt
    )
    frame: Any = SimpleNamespace(map_frame="hall", stamp_ns=5 * 10**9, estimate=estimate)
    camera = Camera(5, 5, K=np.array([[4.0, 0.0, 2.0], [0.0, 4.0, 2.0], [0.0, 0.0, 1.0]]))
    marker = camera_marker(frame, camera)  # which sees half a metre to each side, in one
    assert (marker.header.stamp.sec, marker.header.frame_id, marker.ns) == (5, "hall", "camera")
    q, p = marker.pose.orientation, marker.pose.position
    pose = Rotation.from_quat([q.x, q.y, q.z, q.w])
    assert pose.as_matrix() == pytest.approx(turn.as_matrix())
    assert [p.x, p.y, p.z] == [1.0, 2.0, 3.0]
    assert (marker.color.r, marker.color.g, marker.color.b) == pytest.approx(color)
    assert len(marker.points) == 16  # four sides, four rays
    assert numbers(marker.points)[:, 2].max() == pytest.approx(0.3 * 2 / np.sqrt(6.0))
