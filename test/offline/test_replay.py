# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What replay takes first."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from rs_localizer.config import NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.recording import make_camera_info, make_correspondences
from rs_localizer.offline.replay import Topics, replay

CAMERA = Camera(640, 480, [[500.0, 0, 319.5], [0, 500, 239.5], [0, 0, 1]])


class Localizer(SimpleNamespace):
    """Notes what it is given."""

    def __init__(self) -> None:
        super().__init__(config=NodeConfig(), taken=[])

    def calibrate(self, calibration: Any) -> None:
        self.taken.append("camera_info")

    def localize(self, message: Any) -> None:
        self.taken.append("frame")

    def awaits_imu(self, *_: object) -> bool:
        return False

    def flush(self) -> list[Any]:
        return []


def test_a_camera_info_at_the_end_of_a_recording_is_found_first(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag") as bag:
        for stamp in (1, 2):
            frame = make_correspondences(stamp, np.ones((1, 3)), np.ones((1, 2)), np.array([0]))
            bag.write("/correspondences", frame, stamp)
        bag.write("/camera_info", make_camera_info(CAMERA, 3), 3)
    topics = Topics({"camera_info": "/camera_info", "correspondences": "/correspondences"})
    localizer: Any = Localizer()
    with open_bag(tmp_path / "bag") as opened:
        list(replay(opened, topics, localizer))
    assert localizer.taken == ["camera_info", "frame", "frame", "camera_info"]
