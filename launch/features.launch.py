# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""From a camera to poses in a map of landmarks: camera driver, feature detector, localizer.

ros2 launch rs_localizer features.launch.py camera:=v4l2_camera map_file:=$PWD/map.npz \
    features:=sift readout_time:=0.02 calibration:=file://$PWD/camera.yaml
"""

from launch.substitutions import LaunchConfiguration

from launch import LaunchContext, LaunchDescription
from rs_localizer.config import FeatureConfig
from rs_localizer.ros.launching import (
    camera_driver,
    chosen_parameters,
    detector,
    from_camera,
    localizer,
    views,
)
from rs_localizer.settings import FEATURES_NAME


def generate_launch_description() -> LaunchDescription:
    """The nodes share a namespace, in which they find each other."""
    return LaunchDescription(from_camera(FeatureConfig, "features_params_file", _nodes))


def _nodes(context: LaunchContext) -> list:
    chosen = context.launch_configurations
    return [
        *camera_driver(chosen),
        *views(chosen),
        detector(
            chosen, FEATURES_NAME, "features_params_file", chosen_parameters(chosen, FeatureConfig)
        ),
        localizer(chosen, [("camera_info", LaunchConfiguration("camera_info"))]),
    ]
