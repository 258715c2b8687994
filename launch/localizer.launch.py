# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Start the node of one camera.

ros2 launch rs_localizer localizer.launch.py namespace:=front params_file:=front.yaml
ros2 launch rs_localizer localizer.launch.py readout_time:=0.02 base_frame:=base_link
"""

from launch.substitutions import LaunchConfiguration

from launch import LaunchContext, LaunchDescription
from rs_localizer.pipeline.inputs import INPUTS
from rs_localizer.ros.launching import argument, common_arguments, localizer, starting, views


def generate_launch_description() -> LaunchDescription:
    """A node with its settings, its namespace and the topics of its camera as arguments."""
    topics = [
        argument(name, name, f"topic: {item.about} ({item.type.replace('/msg', '')})")
        for name, item in INPUTS.items()
    ]
    return LaunchDescription(starting([*common_arguments(), *topics], _nodes))


def _nodes(context: LaunchContext) -> list:
    chosen = context.launch_configurations
    remappings = [(name, LaunchConfiguration(name)) for name in INPUTS]
    return [*views(chosen), localizer(chosen, remappings)]
