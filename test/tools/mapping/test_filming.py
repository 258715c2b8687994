# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Which images COLMAP gets, and advice on how to film a map."""

from pathlib import Path

import numpy as np
import pytest

from rs_localizer.features.extraction import Features
from rs_localizer.tools.mapping.build import comes_back
from rs_localizer.tools.mapping.map_keypoints import MapObservations
from rs_localizer.tools.mapping.structure import SeenImage, choose_keyframes


def views_of(sharpnesses: list[float]) -> list[SeenImage]:
    nothing = Features(np.zeros((0, 2)), np.zeros(0), np.zeros(0), np.zeros((0, 128), np.uint8))
    none = np.zeros(0, np.int64)
    return [
        SeenImage(round(k * 1e9 / 15.0), Path(), nothing, value, np.zeros((0, 2)), none)
        for k, value in enumerate(sharpnesses)
    ]


def test_of_a_long_one_the_sharpest_four_a_second_are():
    values = np.random.default_rng(0).uniform(1.0, 2.0, 900).tolist()
    rows = choose_keyframes(views_of(values)).tolist()
    assert len(rows) == 240
    assert max(np.diff(rows)) <= 8
    assert np.mean([values[row] for row in rows]) > np.mean(values) + 0.2


@pytest.mark.parametrize(("way", "back"), [("on", False), ("there and back", True)])
def test_a_walk_comes_back_if_its_ends_show_the_same(way, back):
    """Along a wall of landmarks, 40 of which an image shows."""
    places = np.arange(60) if way == "on" else np.r_[np.arange(30), np.arange(30)[::-1]]
    landmarks = (10 * places[:, None] + np.arange(40)).ravel()
    images = np.repeat(np.arange(60), 40)
    seen = MapObservations(10**9 * np.arange(60), images, landmarks, np.zeros((2400, 2)))
    assert comes_back(seen) == back
