"""Every setting of the package and its default; nothing else in the package repeats one.

The node declares its ROS parameters by walking these classes, so the names, descriptions and
ranges here are what users see in ``ros2 param describe``.
"""

from rs_localizer.config.declared import (
    type_of,
)
from rs_localizer.config.method import (
    Acceleration,
    CalibrationErrors,
    LocalizerConfig,
    VelocityPrior,
    localizer_config,
)
from rs_localizer.config.nodes import (
    LONGEST_READOUT_TIME,
    DetectorConfig,
    FeatureConfig,
    FeatureKind,
    ImageTransport,
    Imu,
    ImuUse,
    MatchBy,
    Matching,
    NodeConfig,
    OrientationCovariance,
    PoseTime,
    PublishTf,
    Px4Odometry,
)

__all__ = [
    "LONGEST_READOUT_TIME",
    "Acceleration",
    "CalibrationErrors",
    "DetectorConfig",
    "FeatureConfig",
    "FeatureKind",
    "ImageTransport",
    "Imu",
    "ImuUse",
    "LocalizerConfig",
    "MatchBy",
    "Matching",
    "NodeConfig",
    "OrientationCovariance",
    "PoseTime",
    "PublishTf",
    "Px4Odometry",
    "VelocityPrior",
    "localizer_config",
    "type_of",
]
