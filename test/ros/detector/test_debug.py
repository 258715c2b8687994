# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Debug pictures wait for poses as long as somebody sends poses."""

from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped

from rs_localizer.config import DetectorConfig
from rs_localizer.io.images import Image
from rs_localizer.markers.detection import Detections
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.prints import Chessboard
from rs_localizer.pipeline.images import Detected
from rs_localizer.ros.detector.debug import DebugPictures

MAP = MarkerMap(boards=(Chessboard(6, 4, 0.03),))


def image(second: int) -> Detected:
    nothing: Any = np.zeros((0, 3))
    seen = Detections(nothing[:, 0].astype(int), nothing, nothing[:, :2], nothing[:, 0],
                      (), (), (), ())  # fmt: skip
    pixels = np.zeros((20, 30), np.uint8)
    return Detected(Image(second * 10**9, "camera", pixels), seen, MAP, np.dtype([]))


def test_without_a_localizer_an_image_is_shown_at_once():
    shown: list[int] = []
    debug = DebugPictures(lambda image, _: shown.append(image.stamp_ns // 10**9), lambda *_: None)
    config = DetectorConfig()
    for second in (1, 2):
        debug.add(image(second), config)
    assert shown == [1, 2]
    # Poses come: images wait for theirs, but not for ever.
    debug.take_pose(PoseStamped())
    for second in range(3, 7):
        debug.add(image(second), config)
    assert shown == [1, 2, 3]
    for second in range(7, 30):
        debug.add(image(second), config)
    assert shown == list(range(1, 30))
