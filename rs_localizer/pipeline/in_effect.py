# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The settings that frames are localized with, and those that estimates depend on."""

from dataclasses import fields, replace

from rs_localizer.config import Imu, ImuUse, NodeConfig, PublishTf, RefinementKind, RigSettings

# Settings that change what is made of an estimate, or which points come to it, and not how it is
# made. All others start the track afresh.
_BESIDE = frozenset({
    "readout_time_deviation", "pose_time", "max_points", "base_frame",
    "odom_frame", "publish_tf", "tf_rate", "hold", "two_d_mode",
    "transform_tolerance", "map_file", "map_frame", "marker_map",
    "autostart", "output_rate", "camera_file",
})  # fmt: skip


def in_effect(config: NodeConfig) -> NodeConfig:
    """Return the settings without what ``refinement`` turns off.

    That is what knows more than a frame's points, and TF where no covariance says how good a pose
    is.
    """
    if config.refinement == RefinementKind.FULL:
        return config
    config = replace(config, imu=replace(config.imu, use=ImuUse.NONE), tracking=False)
    if config.refinement == RefinementKind.NONE:
        config = replace(config, publish_tf=PublishTf.NONE)
    return config


def of_estimates(config: NodeConfig) -> tuple[object, ...]:
    """Return what estimates depend on: of a rig's window and an IMU, only where there are any."""
    unused = config.of_cameras or config.imu.use == ImuUse.NONE
    imu = Imu(use=ImuUse.NONE) if unused else replace(config.imu, wait=0.0)
    config = replace(config, imu=imu, rig=config.rig if config.of_cameras else RigSettings())
    return tuple(getattr(config, it.name) for it in fields(config) if it.name not in _BESIDE)
