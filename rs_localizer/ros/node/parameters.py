# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""ROS parameters, declared by walking the settings of :mod:`rs_localizer.config`."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.node import Node
from rclpy.parameter import Parameter

from rs_localizer.config import NodeConfig, type_of
from rs_localizer.settings import (
    Config,
    Kind,
    Setting,
    as_tuple,
    build,
    camera_settings,
    camera_values,
    settings,
    unknown,
)

_UNCONFIGURED = "unconfigured"


class Started(Node):
    """A node that knows the values that it was started with.

    rclpy declares them all at once, without descriptions and for good, and offers no other way to
    learn their names. Here they are kept, and declared with their types and descriptions.
    """

    given: Mapping[str, Any] = MappingProxyType({})
    """Values by name."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, automatically_declare_parameters_from_overrides=True, **options)

    def declare_parameters(
        self, namespace: str, parameters: list[Any], ignore_override: bool = False
    ) -> Any:
        """Declare parameters, but for those that the node was started with."""
        if ignore_override and "given" not in vars(self):
            self.given = {name: value for name, value, _ in parameters}
            return []
        return super().declare_parameters(namespace, parameters, ignore_override)


def declare(node: Started, kind: type[Config]) -> Config:
    """Declare every setting as a parameter and return those that the node was started with.

    Args:
        node: whose parameters they become: :class:`Started`.
        kind: the class of its settings.

    Raises:
        ValueError: for a value of a wrong type or out of range, saying what was found.
    """
    own = _of_camera_file(node.given, kind)
    _declare(node, settings(kind), own)
    _declare(node, _of_cameras(node, kind), own)
    return read(node, kind)


def _of_camera_file(given: Mapping[str, Any], kind: Kind) -> dict[str, Any]:
    """Return values of ``camera_file``, which a file of defaults does not override."""
    file, known = given.get("camera_file"), settings(kind)
    if kind is not NodeConfig or not file:
        return {}
    return {
        name: value
        for name, value in camera_values(Path(str(file))).items()
        if name not in given or (name in known and as_tuple(given[name]) == known[name].default)
    }


def _of_cameras(node: Node, kind: Kind) -> dict[str, Setting]:
    """Return settings of the cameras of a rig, which the parameters so far name."""
    if kind is not NodeConfig:
        return {}
    return camera_settings({name: node.get_parameter(name).value for name in settings(kind)})


def _declare(node: Any, names: Mapping[str, Setting], own: Mapping[str, Any]) -> None:
    for name, setting in names.items():
        try:
            default = own.get(name, setting.default)
            node.declare_parameter(name, default, _descriptor(setting), ignore_override=name in own)
        except InvalidParameterTypeException as error:
            value, hint = node.given[name], ""
            if isinstance(setting.default, float) and type(value) is int:
                hint = f" (write {float(value)!r})"
            raise ValueError(
                f"{name} must be {type_of(setting.default)}, got {value!r}{hint}"
            ) from error
        except InvalidParameterValueException as error:
            raise ValueError(str(error)) from error


def unknown_names(node: Started, kind: Kind) -> list[str]:
    """Return sentences on given parameters that the node does not have.

    No reason to refuse the start: a params file for ``/**`` speaks to several nodes.
    """
    return [text for name in sorted(node.given) if (text := unknown(name, kind))]


def _names(node: Node, kind: Kind) -> list[str]:
    return [*settings(kind), *_of_cameras(node, kind)]


def read(node: Node, kind: type[Config], changes: Sequence[Parameter] = ()) -> Config:
    """Read the settings of the node's parameters, with these changes.

    Raises:
        ValueError: for values that the settings refuse.
    """
    values = {name: node.get_parameter(name).value for name in _names(node, kind)}
    for parameter in changes:
        if parameter.name in values:  # there are also use_sim_time and the QoS overrides
            values[parameter.name] = parameter.value
    return build(values, kind)


def on_change(
    node: Node,
    kind: type[Config],
    check: Callable[[Config], None],
    apply: Callable[[Config], None],
    state: Callable[[], str] = lambda: _UNCONFIGURED,
) -> None:
    """Check, then apply, changes of parameters; several set at once are one change.

    Args:
        node: with declared parameters.
        kind: the class of the node's settings.
        check: raises ``ValueError`` for settings that are refused: then all stay as they were.
        apply: takes settings that were accepted.
        state: label of the node's, for settings that are fixed once it is configured.
    """

    def on_set(parameters: list[Parameter]) -> SetParametersResult:
        try:
            _check_fixed(node, parameters, kind, state())
            check(read(node, kind, parameters))
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def after_set(parameters: list[Parameter]) -> None:
        names = _names(node, kind)
        if any(parameter.name in names for parameter in parameters):
            apply(read(node, kind))

    node.add_on_set_parameters_callback(on_set)
    node.add_post_set_parameters_callback(after_set)


def _check_fixed(node: Node, parameters: list[Parameter], kind: Kind, state: str) -> None:
    if state == _UNCONFIGURED:
        return
    fixed = {name for name, setting in settings(kind).items() if setting.fixed}
    for item in parameters:
        if item.name in fixed and item.value != node.get_parameter(item.name).value:
            raise ValueError(
                f"{item.name} cannot be changed while the node is {state}: clean it up first"
            )


def _descriptor(setting: Setting) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        description=setting.description,
        read_only=setting.read_only,
        additional_constraints="; ".join(_constraints(setting)),
    )
    if setting.minimum is None or setting.maximum is None:
        return descriptor
    if isinstance(setting.default, int):
        descriptor.integer_range = [
            IntegerRange(from_value=int(setting.minimum), to_value=int(setting.maximum), step=1)
        ]
    else:
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(setting.minimum), to_value=float(setting.maximum))
        ]
    return descriptor


def _constraints(setting: Setting) -> list[str]:
    """Return constraints that ranges cannot express."""
    constraints = [f"one of {', '.join(setting.choices)}"] if setting.choices else []
    return constraints + (
        ["can be changed while the node is unconfigured"] if setting.fixed else []
    )
