# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings that come with the package; each folder has an ATTRIBUTION.md."""

from importlib.resources import files
from pathlib import Path

WEBCAM = "webcam_chessboard/recording"
"""Rosbag2 of a hand-held rolling-shutter webcam over a chessboard; see its parameters.yaml."""
HAND_MOTION = "motion/tum_vi_room5.txt.gz"
"""TUM trajectory at 120 Hz of a hand-held rig, z up."""


def path(name: str) -> Path:
    """Return the path of a bundled recording.

    Raises:
        FileNotFoundError: when the package was installed without it.
    """
    file = Path(str(files(__name__) / name))
    if not file.exists():
        raise FileNotFoundError(f"{file} is missing: rs_localizer was installed without its data")
    return file
