# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What is kept of images, and which of them COLMAP gets."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from rs_localizer.features.extraction import Features
from rs_localizer.io.images import Image
from rs_localizer.tools.mapping import MappingError
from rs_localizer.tools.mapping.seen_images import (
    Looker,
    SeenImage,
    blurred,
    check_views,
    choose_keyframes,
    sharpness,
)
from rs_localizer.tools.simulation.walls import collage

PICTURE = collage(900, 700, np.random.default_rng(0))


def views_of(sharpnesses: list[float], rate: float = 15.0) -> list[SeenImage]:
    nothing = Features(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros((0, 128), np.uint8))
    none = np.zeros(0, np.int64)
    return [
        SeenImage(round(k * 1e9 / rate), Path(), nothing, value, np.zeros((0, 2)), none)
        for k, value in enumerate(sharpnesses)
    ]


def chosen(views: list[SeenImage]) -> list[int]:
    rows: list[int] = choose_keyframes(views).tolist()
    return rows


def test_blur_is_less_sharp():
    unsharp = np.asarray(cv2.blur(PICTURE, (9, 1)), np.uint8)
    assert sharpness(unsharp) < 0.6 * sharpness(PICTURE)
    values = [10.0] * 20 + [5.0] + [10.0] * 20
    assert np.flatnonzero(blurred(views_of(values))).tolist() == [20]


def test_of_a_long_one_the_sharpest_four_a_second_are():
    values = np.random.default_rng(0).uniform(1.0, 2.0, 900).tolist()
    rows = chosen(views_of(values))
    assert len(rows) == 240
    assert max(np.diff(rows)) <= 8
    assert np.mean([values[row] for row in rows]) > np.mean(values) + 0.2


def test_a_camera_that_stands_still_is_refused_early(tmp_path):
    looker = Looker(300, tmp_path)
    images = [np.asarray(PICTURE[20:500, x : x + 640]) for x in (0, 1, 2, 1, 0)]
    with pytest.raises(MappingError, match="the camera hardly moves"):
        check_views([looker.detect_in(Image(k, "camera", image)) for k, image in enumerate(images)])
    moving = [np.asarray(PICTURE[20:500, x : x + 640]) for x in (0, 40, 80, 120, 160)]
    check_views([looker.detect_in(Image(k, "camera", image)) for k, image in enumerate(moving)])
