# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""From images to poses by markers or a board: marker detector and localizer.

ros2 launch rs_localizer markers.launch.py marker_map:=$PWD/wall.yaml \
    camera_file:=$PWD/camera.yaml
"""

from rs_localizer.config import DetectorConfig
from rs_localizer.ros.launching import CAMERA, description, from_camera, with_board


def generate_launch_description():
    return description(
        lambda texts: from_camera(texts, DetectorConfig, with_board(texts)),
        [DetectorConfig],
        CAMERA,
    )
