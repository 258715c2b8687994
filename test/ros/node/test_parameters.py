# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Parameters are the settings: declared with description and range, refused with the reason."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.parameter import Parameter

from rs_localizer.config import NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.io.camera_files import lens_parameters
from rs_localizer.io.rigs import RigParts, mounted_lenses, node_parameters
from rs_localizer.ros.node.parameters import SettingsNode
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
