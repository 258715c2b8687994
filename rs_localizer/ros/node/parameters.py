# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A node whose parameters are settings, declared by walking :mod:`rs_localizer.config`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Generic

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException
from rclpy.lifecycle import LifecycleNode
from rclpy.parameter import Parameter

from rs_localizer.config import NodeConfig, Setting, type_of
from rs_localizer.settings import (
    Config,
    as_tuple,
    build,
    camera_settings,
    camera_values,
    settings,
    unknown,
)

_UNCONFIGURED = "unconfigured"


class SettingsNode(LifecycleNode, Generic[Config]):
    """Checks, then applies changes of its parameters; several set at once are one change.

    A node judges settings by overriding :meth:`check`, and takes them by :meth:`change`.

    Args:
        name: of the node.
        kind: class of its settings.
        options: of rclpy's node.

    Raises:
        ValueError: when it is started with parameters that are refused, saying what was found.
    """

    checked_at_start: ClassVar[bool] = True

    def __init__(self, name: str, kind: type[Config], **options: Any) -> None:
        self._kind: Any = kind
        self._given: dict[str, Any] = {}  # values that it is started with
        self._starts = True
        self.state = _UNCONFIGURED
        """Label of the state in which the last transition has ended."""
        super().__init__(name, automatically_declare_parameters_from_overrides=True, **options)
        self._starts = False
        try:
            own = self._of_camera_file()
            self._declare(settings(kind), own)
            self._declare(self._of_cameras(), own)
            if self.checked_at_start:
                self.check(self.config)
        except ValueError:
            super().destroy_node()  # of Kilted on, the context would end what was never made
            raise
        # No reason to refuse the start: a params file for /** speaks to several nodes.
        for text in filter(None, (unknown(name, kind) for name in sorted(self._given))):
            self.warn(f"a parameter is ignored: {text}")
        self.add_on_set_parameters_callback(self._judge)
        self.add_post_set_parameters_callback(self._apply)

    def declare_parameters(
        self, namespace: str, parameters: list[Any], ignore_override: bool = False
    ) -> Any:
        """Declare parameters, but for those that the node was started with.

        rclpy declares them all at once, without descriptions and for good, and offers no other way
        to learn their names. Here they are kept, and declared with their types and descriptions.
        """
        if ignore_override and self._starts:
            self._given = {name: value for name, value, _ in parameters}
            return []
        return super().declare_parameters(namespace, parameters, ignore_override)

    def check(self, config: Config) -> None:
        """Raise ``ValueError`` for settings that cannot be used."""
        raise NotImplementedError

    def change(self, config: Config) -> None:
        """Take settings that were accepted while the node runs."""
        raise NotImplementedError

    def warn(self, text: str) -> None:
        self.get_logger().warning(text)

    @property
    def config(self) -> Config:
        """The settings as the parameters are now."""
        return self._with(())

    def _with(self, changes: Sequence[Parameter]) -> Config:
        """Return the settings with these changes; ValueError for values that they refuse."""
        names = [*settings(self._kind), *self._of_cameras()]
        values = {name: self.get_parameter(name).value for name in names}
        # There are also use_sim_time and the QoS overrides.
        values |= {item.name: item.value for item in changes if item.name in values}
        config: Config = build(values, self._kind)
        return config

    def _of_camera_file(self) -> dict[str, Any]:
        """Return values of ``camera_file``, which a file of defaults does not override."""
        given, known = self._given, settings(self._kind)
        if self._kind is not NodeConfig or not (file := given.get("camera_file")):
            return {}
        return {
            name: value
            for name, value in camera_values(Path(str(file))).items()
            if name not in given or (name in known and as_tuple(given[name]) == known[name].default)
        }

    def _of_cameras(self) -> dict[str, Setting]:
        """Return settings of the cameras of a rig, which the parameters so far name."""
        if self._kind is not NodeConfig:
            return {}
        return camera_settings({name: self.get_parameter(name).value for name in settings()})

    def _declare(self, names: Mapping[str, Setting], own: Mapping[str, Any]) -> None:
        for name, setting in names.items():
            default: Any = own.get(name, setting.default)
            try:
                described = _descriptor(setting)
                self.declare_parameter(name, default, described, ignore_override=name in own)
            except InvalidParameterTypeException as error:
                value, hint = self._given[name], ""
                if isinstance(setting.default, float) and type(value) is int:
                    hint = f" (write {float(value)!r})"
                text = f"{name} must be {type_of(setting.default)}, got {value!r}{hint}"
                raise ValueError(text) from error
            except InvalidParameterValueException as error:
                raise ValueError(str(error)) from error

    def _judge(self, parameters: list[Parameter]) -> SetParametersResult:
        known = settings(self._kind)
        for item in parameters:
            fixed = self.state != _UNCONFIGURED and item.name in known and known[item.name].fixed
            if fixed and item.value != self.get_parameter(item.name).value:
                text = f"{item.name} cannot be changed while the node is {self.state}: clean it up"
                return SetParametersResult(successful=False, reason=f"{text} first")
        try:
            self.check(self._with(parameters))
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _apply(self, parameters: list[Parameter]) -> None:
        names = {*settings(self._kind), *self._of_cameras()}
        if any(parameter.name in names for parameter in parameters):
            self.change(self.config)


def _descriptor(setting: Setting) -> ParameterDescriptor:
    # Constraints that ranges cannot express.
    constraints = [f"one of {', '.join(setting.choices)}"] if setting.choices else []
    constraints += ["can be changed while the node is unconfigured"] if setting.fixed else []
    descriptor = ParameterDescriptor(
        description=setting.description,
        read_only=setting.read_only,
        additional_constraints="; ".join(constraints),
    )
    if setting.minimum is None or setting.maximum is None:
        return descriptor
    low, high = setting.minimum, setting.maximum
    if isinstance(setting.default, int):
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    else:
        span = FloatingPointRange(from_value=float(low), to_value=float(high))
        descriptor.floating_point_range = [span]
    return descriptor
