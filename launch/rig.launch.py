# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""One localizer for the cameras of a rig, and a marker detector for each in its namespace.

ros2 launch rs_localizer rig.launch.py cameras:="front, rear" marker_map:=$PWD/wall.yaml \
    params_file:=$PWD/rig.yaml
"""

from rs_localizer.config import DetectorConfig, NodeConfig
from rs_localizer.ros.launching import description, given, node, with_board


def generate_launch_description():
    """Topics are those of each camera's namespace: /front/image, /front/camera_info."""
    return description(_nodes, [DetectorConfig])


def _nodes(texts):
    values = with_board(texts) if texts["marker_map"] else given(texts)
    if "cameras" not in values:
        raise ValueError('cameras must name the cameras: cameras:="front, rear"')
    names = values["cameras"] if texts["marker_map"] else []  # without a map, others detect
    above = f"{texts['namespace']}/" if texts["namespace"] else ""
    return [
        *(node(texts, DetectorConfig, namespace=f"{above}{name}") for name in names),
        node(texts, NodeConfig, values=values),
    ]
