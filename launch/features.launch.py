"""From a camera to poses in a map of landmarks: camera driver, feature detector, localizer.

ros2 launch rs_localizer features.launch.py camera:=v4l2_camera map_file:=$PWD/map.npz \
    features:=sift readout_time:=0.02 calibration:=file://$PWD/camera.yaml
"""

from launch.actions import OpaqueFunction
from launch.substitutions import LaunchConfiguration

from launch import LaunchContext, LaunchDescription
from rs_localizer.config import FeatureConfig
from rs_localizer.ros.launching import (
    argument,
    camera_arguments,
    camera_driver,
    common_arguments,
    detector,
    given,
    localizer,
    setting_arguments,
    share,
    views,
)
from rs_localizer.settings import FEATURES_NAME


def generate_launch_description() -> LaunchDescription:
    """The nodes share a namespace, in which they find each other."""
    common = common_arguments()
    known = {item.name for item in common}
    return LaunchDescription(
        [
            *camera_arguments(),
            argument(
                "features_params_file",
                share("config", "feature_detector.yaml"),
                "parameters of feature_detector",
            ),
            *common,
            *(item for item in setting_arguments(FeatureConfig) if item.name not in known),
            OpaqueFunction(function=_nodes),
        ]
    )


def _nodes(context: LaunchContext) -> list:
    chosen = context.launch_configurations
    return [
        *camera_driver(chosen),
        *views(chosen),
        detector(FEATURES_NAME, "features_params_file", given(chosen, FeatureConfig)),
        localizer(chosen, [("camera_info", LaunchConfiguration("camera_info"))]),
    ]
