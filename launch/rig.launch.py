# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""One localizer for the cameras of a rig, and a detector for each in its namespace.

ros2 launch rs_localizer rig.launch.py cameras:="front, rear" detector:=marker_detector \
    marker_map:=$PWD/wall.yaml params_file:=$PWD/rig.yaml
"""

from typing import Any

from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription
from rs_localizer.config import DetectorConfig
from rs_localizer.ros.launching import (
    argument,
    chosen_parameters,
    common_arguments,
    localizer,
    own_node,
    share,
    starting,
    views,
)
from rs_localizer.settings import DETECTOR_NAME, FEATURES_NAME


def generate_launch_description() -> LaunchDescription:
    """Topics are those of each camera's namespace: /front/image, /front/camera_info."""
    detectors = (DETECTOR_NAME, FEATURES_NAME)
    arguments = [
        argument(
            "detector", "none", f"of each camera: {' or '.join(detectors)}; none: others do that"
        ),
        argument(
            "detector_params_file",
            share("config", f"{DETECTOR_NAME}.yaml"),
            "parameters of the detectors",
        ),
        *common_arguments(),
    ]
    return LaunchDescription(starting(arguments, _nodes))


def _nodes(context: LaunchContext) -> list:
    chosen = context.launch_configurations
    names = [name for name in chosen_parameters(chosen).get("cameras", []) if name]
    if not names:
        raise RuntimeError('cameras must name the cameras: cameras:="front, rear"')
    kind = chosen["detector"]
    if kind not in ("none", DETECTOR_NAME, FEATURES_NAME):
        raise RuntimeError(f"detector must be {DETECTOR_NAME}, {FEATURES_NAME} or none; got {kind}")
    nodes = [] if kind == "none" else [_detector(chosen, kind, name) for name in names]
    own = {name: text for name, text in chosen.items() if name != "marker_map"}
    return [*views(chosen), *nodes, localizer(own, [])]


def _detector(chosen: dict[str, str], kind: str, name: str) -> Node:
    """The detector of one camera."""
    own: dict[str, Any] = {}
    if kind == DETECTOR_NAME:
        given = chosen_parameters(chosen, DetectorConfig)
        own = {key: given[key] for key in given if key in ("marker_map", "use_sim_time")}
    namespace = "/".join(part for part in (chosen["namespace"].strip("/"), name) if part)
    parameters = [chosen["detector_params_file"], own]
    return own_node(chosen, kind, kind, parameters, namespace=namespace)
