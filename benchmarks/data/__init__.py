# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings that benchmarks use; each folder beside this has an ATTRIBUTION.md."""

from pathlib import Path

from rs_localizer import data

_FOLDER = Path(__file__).parent

HAND_MOTION = data.path(data.HAND_MOTION)
"""Of the package: a trajectory of a hand."""
SLOW_HAND_MOTION = _FOLDER / "motion" / "tum_rgbd_fr1_xyz.txt.gz"
"""TUM trajectory at 100 Hz of a hand-held camera that moves slowly; optical axes."""
GLOBAL_SHUTTER_TAGS = _FOLDER / "global_shutter_tags" / "recording"
"""Rosbag2 of a real global-shutter camera before surveyed AprilTags."""
PHONE = _FOLDER / "phone_gyro" / "recording"
"""Rosbag2 of a real rolling-shutter phone in a car; see its parameters.yaml."""
PHONE_GYROSCOPE = _FOLDER / "phone_gyro" / "gyroscope.txt"
"""Lines t wx wy wz of that phone: s by the clock of the stamps, rad/s in the camera's axes."""
