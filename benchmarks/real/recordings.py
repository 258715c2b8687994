# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings with correspondences, whoever made them, and settings, as the judges take them."""

import argparse
from dataclasses import dataclass
from pathlib import Path

from rs_localizer.config import NodeConfig
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_info import Calibration, read_camera_info
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.pipeline.pose_at_time import middle_row_ns

_INFO, _CLOUD = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2"


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One image."""

    middle_ns: int  # when its middle row was exposed
    points: Array  # (n,3) m
    pixels: Array  # (n,2) raw


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """The images of one rolling-shutter camera."""

    name: str
    camera: Camera
    frames: list[Frame]


def read_bag(path: Path, config: NodeConfig) -> Recording:
    """A recording with one ``camera_info`` and one topic of correspondences.

    Args:
        config: of which the readout time, scan direction and stamp offset are used.

    Raises:
        ValueError: for a recording without these, or without a readout time.
    """
    if not config.readout_time > 0.0:
        raise ValueError("a turn rate needs the readout time: -p readout_time:=0.03")
    calibration: Calibration | None = None
    clouds = []
    with open_bag(path) as bag:
        topics = [name for name, kind in bag.topics.items() if kind in (_INFO, _CLOUD)]
        if len({bag.topics[name] for name in topics}) < 2:
            raise ValueError(f"{path} needs camera_info and correspondences; it has {bag.topics}")
        for topic, _, message in bag.messages(topics):
            if bag.topics[topic] == _CLOUD:
                clouds.append(read_correspondences(message))
            elif calibration is None:
                calibration = read_camera_info(message)
    assert calibration is not None
    camera = calibration.camera(config.readout_time, config.scan_direction)
    frames = [
        Frame(middle_row_ns(config, camera, cloud.stamp_ns), cloud.points, cloud.pixels)
        for cloud in clouds
    ]
    return Recording(path.name, camera, frames)


def add_settings(parser: argparse.ArgumentParser) -> None:
    """``--params FILE``, ``-p NAME:=VALUE``, for ``given_settings``."""
    parser.add_argument("--params", type=Path, metavar="FILE", help="settings: a ROS 2 params file")
    parser.add_argument(
        "-p", dest="assignments", action="append", default=[], metavar="NAME:=VALUE",
        help="one setting; may be repeated",
    )  # fmt: skip
