# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Advice on how to film a map."""

import numpy as np
import pytest

from rs_localizer.tools.mapping.map_keypoints import MapObservations
from rs_localizer.tools.mapping.report import comes_back


@pytest.mark.parametrize(("way", "back"), [("on", False), ("there and back", True)])
def test_a_walk_comes_back_if_its_ends_show_the_same(way, back):
    """Along a wall of landmarks, 40 of which an image shows."""
    places = np.arange(60) if way == "on" else np.r_[np.arange(30), np.arange(30)[::-1]]
    landmarks = (10 * places[:, None] + np.arange(40)).ravel()
    images = np.repeat(np.arange(60), 40)
    seen = MapObservations(10**9 * np.arange(60), images, landmarks, np.zeros((2400, 2)))
    assert comes_back(seen) == back
