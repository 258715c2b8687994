# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""From images to poses in a map of landmarks: feature detector and localizer.

ros2 launch rs_localizer features.launch.py map_file:=$PWD/map.npz features:=sift \
    camera_file:=$PWD/camera.yaml
"""

from rs_localizer.config import FeatureConfig
from rs_localizer.ros.launching import CAMERA, description, from_camera


def generate_launch_description():
    return description(lambda texts: from_camera(texts, FeatureConfig), [FeatureConfig], CAMERA)
