# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The settings of :mod:`rs_localizer.config` by their dotted names, as ROS parameters have them.

The node declares them, and a params file or ``-p name:=value`` of a command sets them.
"""

from __future__ import annotations

import contextlib
import json
from array import array
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar, overload

from rs_localizer.config import (
    NO_NAMES,
    CameraSettings,
    DetectorConfig,
    FeatureConfig,
    Imu,
    ImuUse,
    NodeConfig,
    PublishTf,
    RefinementKind,
    RigSettings,
    Setting,
    meant,
)
from rs_localizer.io.reading import (
    LENS,
    YamlError,
    file_faults,
    flat,
    load_yaml,
    parameter_blocks,
    read_text,
)

NODE_NAME = "rs_localizer"
DETECTOR_NAME = "marker_detector"
FEATURES_NAME = "feature_detector"
NODES: dict[Kind, str] = {
    NodeConfig: NODE_NAME,
    DetectorConfig: DETECTOR_NAME,
    FeatureConfig: FEATURES_NAME,
}
# Parameters that every ROS 2 node may have, and the lens in a camera's file: no settings.
_FOREIGN = ("use_sim_time", "qos_overrides", "start_type_description_service", LENS)


FIRST = (
    "readout_time", "scan_direction", "stamp_offset", "base_frame", "publish_tf", "map_deviation",
)  # fmt: skip
"""The settings that everybody sets, first in the help, as in README."""
Kind = type[NodeConfig] | type[DetectorConfig] | type[FeatureConfig]
Config = TypeVar("Config", NodeConfig, DetectorConfig, FeatureConfig)
_cached: dict[Kind, dict[str, Setting]] = {}


class SettingsError(ValueError):
    """A params file or an assignment that cannot be used; the text says what was found."""


# What each camera of a rig has of its own, below its name.
_OF_CAMERA = tuple(item.name for item in fields(CameraSettings))


def camera_settings(values: Mapping[str, Any]) -> dict[str, Setting]:
    """Return settings that cameras of ``values`` have of their own, by ``NAME.setting``."""
    shared = settings()
    return {
        f"{camera}.{name}": replace(shared[name], default=values.get(name, shared[name].default))
        for camera in _cameras(values)
        for name in _OF_CAMERA
    }


def _cameras(values: Mapping[str, Any]) -> list[str]:
    """Return the names of cameras; none if they are no names, which is refused elsewhere."""
    given = as_tuple(values.get("cameras", NO_NAMES))
    names = given if isinstance(given, tuple) else ()
    return [name for name in names if isinstance(name, str) and name]


def settings(kind: Kind = NodeConfig) -> dict[str, Setting]:
    """Return all settings of a node, by dotted name."""
    if kind not in _cached:
        found = dict(_walk(kind(), ""))
        _cached[kind] = {name: found[name] for name in (*FIRST, *found) if name in found}
    return _cached[kind]


def _walk(config: Any, prefix: str) -> Iterator[tuple[str, Setting]]:
    for item in fields(config):
        value = getattr(config, item.name)
        if is_dataclass(value):
            yield from _walk(value, f"{prefix}{item.name}.")
        elif item.metadata:
            yield prefix + item.name, item.metadata["setting"]


def unknown(name: str, kind: Kind = NodeConfig) -> str | None:
    """Return the fault of an unknown name; None for settings and what every node may have."""
    names = settings(kind)
    if name in names or name.split(".")[0] in _FOREIGN or _of_camera(name, kind):
        return None
    return f"{name!r} is not a setting{meant(name, list(names), 'there are')}"


def _of_camera(name: str, kind: Kind) -> str:
    """Return the setting of a rig's camera that ``NAME.setting`` means; empty if there is none."""
    group, _, last = name.rpartition(".")
    own = kind is NodeConfig and last in _OF_CAMERA and group and "." not in group
    return last if own and name not in settings(kind) else ""


@overload
def build(values: Mapping[str, Any]) -> NodeConfig: ...
@overload
def build(values: Mapping[str, Any], kind: type[Config]) -> Config: ...
def build(values: Mapping[str, Any], kind: Any = NodeConfig) -> Any:
    """Return the settings with values by dotted name; missing ones have their defaults.

    Raises:
        ValueError: for a wrong value.
    """
    if kind is NodeConfig:
        values = {**values, "of_cameras": _of_cameras(values)}
    return _build(kind(), values, "")


def _of_cameras(values: Mapping[str, Any]) -> dict[str, CameraSettings]:
    """Return settings by camera; ValueError for a camera that does not exist."""
    own = camera_settings(values)
    for name in values:
        if _of_camera(name, NodeConfig) and name not in own:
            named = ", ".join(_cameras(values)) or "none"
            raise ValueError(f"{name}: no such camera; cameras names {named}")
    chosen = {name: values.get(name, setting.default) for name, setting in own.items()}
    return {
        camera: CameraSettings(*(chosen[f"{camera}.{name}"] for name in _OF_CAMERA))
        for camera in _cameras(values)
    }


def _build(config: Any, values: Mapping[str, Any], prefix: str) -> Any:
    chosen = {}
    for item in fields(config):
        default = getattr(config, item.name)
        if is_dataclass(default):
            chosen[item.name] = _build(default, values, f"{prefix}{item.name}.")
        else:
            value = values.get(prefix + item.name, default)
            chosen[item.name] = as_tuple(value) if isinstance(default, tuple) else value
    return type(config)(**chosen)


def as_tuple(value: Any) -> Any:
    """Convert a list or array of ROS and YAML to a tuple; return anything else as it is."""
    return tuple(value) if isinstance(value, (list, array)) else value


def load_params_file(path: Path, kind: Kind = NodeConfig) -> dict[str, Any]:
    """Return values by dotted name of a ROS 2 params file, as far as it addresses the node.

    Args:
        path: the file.
        kind: which node's settings.

    Raises:
        SettingsError: for a file that cannot be read, a name that is not a setting, or a file
            without parameters for the node.
    """
    with file_faults(path, SettingsError):
        tree = load_yaml(read_text(path))
    values: dict[str, Any] = {}
    node = NODES[kind]
    blocks = list(parameter_blocks(tree, node))
    for name, parameters in blocks:
        if not isinstance(parameters, dict):
            raise SettingsError(f"{path}: ros__parameters of {name} must be a mapping")
        values.update(flat(parameters))
    if not blocks:
        raise SettingsError(f"{path} has no ros__parameters for /{node} (or /**)")
    return {
        name: _checked(name, value, str(path), kind)
        for name, value in values.items()
        if name.split(".")[0] not in _FOREIGN
    }


def camera_values(path: Path) -> dict[str, Any]:
    """Return values by dotted name of a file of calibrate; none if it has a lens only.

    Raises:
        SettingsError: for parameters that cannot be used.
    """
    with contextlib.suppress(OSError, UnicodeDecodeError, YamlError):  # told by who reads the lens
        if "ros__parameters" in read_text(path):
            return load_params_file(path)
    return {}


def parse_assignment(text: str) -> tuple[str, Any]:
    """Name and value of ``name:=value``, the value read as YAML as in ROS 2.

    Raises:
        SettingsError: for another form or a name that is not a setting.
    """
    name, separator, value = text.partition(":=")
    if not separator or not name:
        raise SettingsError(f"expected name:=value, got {text!r}")
    try:
        return name, _checked(name, load_yaml(value), text, NodeConfig)
    except YamlError as error:
        raise SettingsError(f"the value of {text!r} cannot be read") from error


def _checked(name: str, value: Any, where: str, kind: Kind) -> Any:
    known = _of_camera(name, kind) or name
    if known not in settings(kind):
        raise SettingsError(f"{where}: {unknown(name, kind) or f'{name!r} is not a setting'}")
    default = settings(kind)[known].default
    if isinstance(default, tuple):
        return as_tuple(value)
    if isinstance(value, str) and isinstance(default, float):
        # ROS reads 1e-3 as a number, PyYAML as text.
        with contextlib.suppress(ValueError):
            return float(value)
    return value


def write_parameters(
    path: Path,
    values: Mapping[str, Any],
    lens: Mapping[str, Any] | None = None,
    remarks: Sequence[str] = (),
) -> None:
    """Write values by dotted name as a params file, for ``replay --params`` and nodes.

    Args:
        lens: of the file of a camera or a rig, for ``--camera`` and ``camera_file``; as
            ``io.camera_files.lens_parameters`` or ``io.rigs.mounted_lenses`` have it.
        remarks: lines of comment.
    """
    build(values)  # refuses wrong ones
    # In any namespace; for a node of any name if it is a camera's.
    nodes = f"/**/{NODE_NAME}" if lens is None else "/**"
    lines = [*(f"# {text}" for text in remarks), f"{nodes}:", "  ros__parameters:"]
    lines += _lines({**values, **({LENS: lens} if lens else {})}, "    ")
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def _lines(values: Mapping[str, Any], indent: str) -> Iterator[str]:
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield f"{indent}{name}:"
            yield from _lines(value, f"{indent}  ")
        else:
            plain = value.value if isinstance(value, Enum) else value
            yield f"{indent}{name}: {json.dumps(plain)}"


# Settings that change what is made of an estimate, or which points come to it, and not how it is
# made. All others start the track afresh.
_BESIDE = frozenset({
    "readout_time_deviation", "pose_time", "max_points", "base_frame",
    "odom_frame", "publish_tf", "tf_rate", "hold", "two_d_mode",
    "transform_tolerance", "map_file", "map_frame", "marker_map",
    "autostart", "output_rate", "camera_file",
})  # fmt: skip


def in_effect(config: NodeConfig) -> NodeConfig:
    """Return the settings without what ``refinement`` turns off.

    That is what knows more than a frame's points, and TF where no covariance says how good a pose
    is.
    """
    if config.refinement == RefinementKind.FULL:
        return config
    config = replace(config, imu=replace(config.imu, use=ImuUse.NONE), tracking=False)
    if config.refinement == RefinementKind.NONE:
        config = replace(config, publish_tf=PublishTf.NONE)
    return config


def of_estimates(config: NodeConfig) -> tuple[object, ...]:
    """Return what estimates depend on: of a rig's window and an IMU, only where there are any."""
    unused = config.of_cameras or config.imu.use == ImuUse.NONE
    imu = Imu(use=ImuUse.NONE) if unused else replace(config.imu, wait=0.0)
    config = replace(config, imu=imu, rig=config.rig if config.of_cameras else RigSettings())
    return tuple(getattr(config, it.name) for it in fields(config) if it.name not in _BESIDE)
