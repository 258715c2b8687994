# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""From a camera to poses by markers or a board: camera driver, marker detector, localizer.

ros2 launch rs_localizer markers.launch.py camera:=v4l2_camera marker_map:=$PWD/wall.yaml \
    readout_time:=0.02 calibration:=file://$PWD/camera.yaml
"""

from contextlib import suppress
from pathlib import Path
from typing import Any

from launch.substitutions import LaunchConfiguration

from launch import LaunchContext, LaunchDescription
from rs_localizer.config import DetectorConfig, NodeConfig
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.markers.maps import MarkerMapError
from rs_localizer.ros.launching import (
    camera_driver,
    chosen_parameters,
    detector,
    from_camera,
    localizer,
    read_params,
    views,
)
from rs_localizer.settings import DETECTOR_NAME, settings


def generate_launch_description() -> LaunchDescription:
    """The nodes share a namespace, in which they find each other."""
    return LaunchDescription(from_camera(DetectorConfig, "detector_params_file", _nodes))


def _nodes(context: LaunchContext) -> list:
    chosen = context.launch_configurations
    file = chosen["marker_map"] or read_params(chosen["detector_params_file"], DetectorConfig).get(
        "marker_map"
    )
    if not file:
        raise RuntimeError("marker_map must name a file: rs_localizer markers make writes one")
    shutter = _shutter(chosen["params_file"])
    return [
        *camera_driver(chosen),
        *views(chosen),
        detector(
            chosen,
            DETECTOR_NAME,
            "detector_params_file",
            shutter | chosen_parameters(chosen, DetectorConfig),
        ),
        localizer(
            {name: text for name, text in chosen.items() if name != "marker_map"},
            [("camera_info", LaunchConfiguration("camera_info"))],
            _map_settings(file, chosen["params_file"]),
        ),
    ]


def _map_settings(file: str, params_file: str) -> dict[str, Any]:
    """How well the boards of the map are known, unless the localizer's params file says it."""
    if read_params(params_file, NodeConfig).get("map_deviation"):
        return {}
    with suppress(MarkerMapError):  # the detector says what is wrong with it
        return dict(read_marker_map(Path(file).expanduser()).settings)
    return {}


def _shutter(params_file: str) -> dict[str, Any]:
    """What the localizer's params file says of the shutter, for the detector's debug image."""
    values = read_params(params_file, NodeConfig)
    shared = set(settings(DetectorConfig)) - {"marker_map"}  # the localizer's is of other detectors
    return {name: values[name] for name in values if name in shared}
