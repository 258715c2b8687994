"""Parameters are the settings: declared with description and range, refused with the reason."""

import re
from collections.abc import Iterator

import pytest
import rclpy
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from rs_localizer.config import NodeConfig, VelocityPrior
from rs_localizer.ros.node import parameters
from rs_localizer.settings import settings


@pytest.fixture
def context() -> Iterator[Context]:
    context = Context()
    rclpy.init(context=context)
    yield context
    rclpy.shutdown(context=context)


class Recorder:
    """A node with the parameters, that refuses one seed and keeps what is applied."""

    def __init__(self, context: Context, *arguments: str) -> None:
        self.node = Node("some_node", context=context, cli_args=["--ros-args", *arguments])
        self.config = parameters.declare(self.node, NodeConfig)
        self.applied: list[NodeConfig] = []
        parameters.on_change(self.node, NodeConfig, self.check, self.applied.append)

    def check(self, config: NodeConfig) -> None:
        if config.seed == 13:
            raise ValueError("13 brings bad luck")

    def set_all(self, **values: object) -> tuple[bool, str]:
        changes = [
            Parameter(name.replace("__", "."), value=value) for name, value in values.items()
        ]
        result = self.node.set_parameters_atomically(changes)
        return result.successful, result.reason


@pytest.fixture
def recorder(context) -> Iterator[Recorder]:
    recorder = Recorder(context)
    yield recorder
    recorder.node.destroy_node()


def test_every_setting_is_a_parameter_with_its_default(recorder):
    assert recorder.config == NodeConfig()
    for name, setting in settings().items():
        value = recorder.node.get_parameter(name).value
        assert value == setting.default
        assert type(value) is type(setting.default)


def test_descriptions_ranges_and_choices(recorder):
    def describe(name: str) -> ParameterDescriptor:
        return recorder.node.describe_parameter(name)

    for name, setting in settings().items():
        assert describe(name).description == setting.description
        assert describe(name).read_only == setting.read_only
    threshold = describe("inlier_threshold").floating_point_range[0]
    assert (threshold.from_value, threshold.to_value) == (0.01, 1000.0)
    seed = describe("seed").integer_range[0]
    assert (seed.from_value, seed.to_value) == (0, 2**31 - 1)
    assert describe("scan_direction").additional_constraints == (
        "one of top_to_bottom, bottom_to_top, left_to_right, right_to_left"
    )
    assert describe("autostart").read_only
    assert not describe("solver").read_only


def test_several_at_once_are_one_change(recorder):
    change = {"solver": "p3p", "seed": 4, "velocity_prior__linear": 0.5}
    assert recorder.set_all(**change) == (True, "")
    expected = NodeConfig(
        solver="p3p", seed=4, velocity_prior=VelocityPrior(VelocityPrior().angular, 0.5)
    )
    assert recorder.applied == [expected]
    assert parameters.read(recorder.node, NodeConfig) == expected


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"solver": "epnp"}, "solver must be one of .*; got 'epnp'"),
        ({"inlier_threshold": 0.0}, "inlier_threshold out of range.*0.01.*1000.0.*0.0"),
        ({"inlier_threshold": float("nan")}, "inlier_threshold"),
        ({"min_inliers": 6}, "min_inliers out of range"),
        ({"seed": 1.5}, "Wrong parameter type"),
        ({"autostart": False}, "read-only parameter: autostart"),
        ({"seed": 13}, "13 brings bad luck"),
        ({"inlier_threshold": 3.0, "seed": 13}, "13 brings bad luck"),
        ({"inlier_threshold": 3.0, "solver": "epnp"}, "solver must be one of"),
    ],
)
def test_what_is_refused_stays_as_it_was(recorder, change, reason):
    successful, text = recorder.set_all(**change)
    assert not successful
    assert re.search(reason, text)
    assert recorder.applied == []
    assert parameters.read(recorder.node, NodeConfig) == NodeConfig()


@pytest.mark.parametrize(
    ("assignment", "text"),
    [
        ("solver:=epnp", "solver must be one of"),
        ("readout_time:=0.5", r"readout_time out of range"),
        ("readout_time:=0", r"readout_time must be of type float, got 0 \(write 0\.0\)$"),
        ("inlier_threshold:=-3", r"got -3 \(write -3\.0\)$"),
        ("readout_time:=true", "readout_time must be of type float, got True$"),
        ("seed:=high", "seed must be of type int, got 'high'$"),
        ("gravity_in_map:=[0, 0, 1]", r"must be 3 numbers, as \[0.0, 0.0, -1.0\], got .*1"),
    ],
)
def test_bad_values_at_start(context, assignment, text):
    with pytest.raises(ValueError, match=text):
        Recorder(context, "-p", assignment)


def test_numbers_in_a_row(context):
    recorder = Recorder(context, "-p", "gravity_in_map:=[0.0, 1.0, 0.0]")
    assert recorder.config.gravity_in_map == (0.0, 1.0, 0.0)
    assert recorder.set_all(gravity_in_map=[0.0, -9.81, 0.0]) == (True, "")
    assert recorder.applied[-1].gravity_in_map == (0.0, -9.81, 0.0)
    assert recorder.set_all(gravity_in_map=[0.0, 1.0])[1].startswith("gravity_in_map must be 3")
    recorder.node.destroy_node()
