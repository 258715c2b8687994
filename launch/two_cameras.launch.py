# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Start the nodes of two cameras, each in its own namespace.

ros2 launch rs_localizer two_cameras.launch.py left:=front right:=rear left_params_file:=front.yaml
"""

from launch.actions import IncludeLaunchDescription, OpaqueFunction
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

from launch import LaunchDescription
from rs_localizer.ros.launching import argument, need_files, share


def generate_launch_description() -> LaunchDescription:
    """localizer.launch.py twice; each node has the topics of its namespace: /left/camera_info.

    Settings that are given, as use_sim_time:=true or base_frame:=base_link, are those of both.
    """
    actions: list = []
    for camera in ("left", "right"):
        actions += [
            argument(camera, camera, f"namespace of the {camera} camera"),
            argument(
                f"{camera}_params_file",
                share("config", "rs_localizer.yaml"),
                f"parameters of the {camera} camera's node",
            ),
        ]
    # Before the first node starts, the files of the second are checked, too.
    actions.append(
        OpaqueFunction(function=lambda context: need_files(context.launch_configurations))
    )
    actions += [
        IncludeLaunchDescription(
            # Each its own: what has been launched is not launched again.
            PythonLaunchDescriptionSource(share("launch", "localizer.launch.py")),
            launch_arguments={
                "namespace": LaunchConfiguration(camera),
                "params_file": LaunchConfiguration(f"{camera}_params_file"),
            }.items(),
        )
        for camera in ("left", "right")
    ]
    return LaunchDescription(actions)
