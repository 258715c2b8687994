# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Start the node of one camera; every topic and setting is an argument.

ros2 launch rs_localizer localizer.launch.py namespace:=front params_file:=front.yaml
ros2 launch rs_localizer localizer.launch.py readout_time:=0.02 base_frame:=base_link rviz:=true
"""

from rs_localizer.config import NodeConfig
from rs_localizer.io.topics import GIVEN_POSES
from rs_localizer.pipeline.inputs import INPUTS
from rs_localizer.ros.launching import description, node


def generate_launch_description():
    topics = {name: item.about for name, item in INPUTS.items()}
    topics |= {name: "a pose that others know" for name in GIVEN_POSES if name[0] != "~"}
    return description(
        lambda texts: [node(texts, NodeConfig, {name: texts[name] for name in topics})],
        others={name: (name, f"topic: {about}") for name, about in topics.items()},
    )
