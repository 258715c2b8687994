# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Debug pictures wait for inliers as long as somebody localizes."""

from typing import Any

import numpy as np

from rs_localizer.io.bags import make_message
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.images import Image
from rs_localizer.ros.detector.debug import DebugPictures, Drawn

PIXELS = np.array([[10.0, 20.0], [40.0, 20.0]])
KIND = np.dtype([(name, "<f4") for name in "xyzuv"])


def draw(second: int) -> Drawn:
    gray = np.zeros((40, 60), np.uint8)
    return Image(second * 10**9, "camera", gray), np.zeros((40, 60, 3), np.uint8), PIXELS


def inliers(second: int) -> Any:
    """Of both points, the first was kept."""
    rows = np.array([(1.0, 2.0, 3.0, *PIXELS[0])], KIND)
    return make_cloud(make_message, second * 10**9, "map", rows)


def test_pictures_wait_for_their_inliers_and_not_for_ever():
    shown: list[int] = []
    debug = DebugPictures(draw, lambda image, _: shown.append(image.stamp_ns // 10**9))
    for second in (1, 2):  # nobody localizes
        debug.add(second)
    assert shown == [1, 2]
    debug.take_inliers(inliers(2))
    for second in range(3, 7):
        debug.add(second)
    assert shown == [1, 2, 3]
    debug.take_inliers(inliers(5))
    assert shown == [1, 2, 3, 4, 5]
    for second in range(7, 30):
        debug.add(second)
    assert shown == list(range(1, 30))


def test_kept_points_are_green_and_others_red():
    pictures: list[Any] = []
    debug = DebugPictures(draw, lambda _, picture: pictures.append(picture))
    debug.take_inliers(inliers(0))
    debug.add(1)
    debug.take_inliers(inliers(1))
    (picture,) = pictures
    (left, right) = (picture[20, 10].astype(int), picture[20, 40].astype(int))
    assert left[1] > left[2] + 100
    assert right[2] > right[1] + 100
