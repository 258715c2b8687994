# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether the versions that are installed are of use: a recording there and back, and a kernel."""

import tempfile
from importlib.metadata import version
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import StoragePlugin

import rs_localizer.localizer
import rs_localizer.tracking
from rs_localizer.core import so3
from rs_localizer.io.bags import BagWriter, make_message, open_bag


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        for storage in StoragePlugin:
            path = Path(folder) / storage.name.lower()
            with BagWriter(path, storage) as bag:
                bag.write("/a", make_message("std_msgs/msg/String", data="b"), 1)
            (lone,) = (file for file in path.iterdir() if file.suffix != ".yaml")
            for place in (path, lone):
                with open_bag(place) as bag:
                    assert [message.data for _, _, message in bag.messages(["/a"])] == ["b"]
    assert abs(so3.exp(np.array([0.0, 0.0, np.pi / 2]))[1, 0] - 1.0) < 1e-12
    names = ("numpy", "opencv-python-headless", "rosbags")
    print("  " + ", ".join(f"{name} {version(name)}" for name in names))
    assert rs_localizer.localizer.Localizer
    assert rs_localizer.tracking.Tracker


if __name__ == "__main__":
    main()
