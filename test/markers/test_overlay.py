# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Outlines of markers: blue those of the map, orange others."""

import numpy as np

from rs_localizer.markers.detection import Detections, MarkerQuads
from rs_localizer.markers.maps import wall
from rs_localizer.markers.overlay import draw_detections


def test_outlines_say_which_markers_the_map_has():
    quads = np.array([[[10, 10], [60, 10], [60, 60], [10, 60]]], float) + np.array(
        [[[0, 0]], [[100, 0]]]
    )
    mapped = np.array([True, False])
    seen = MarkerQuads(wall("4x4_50", (1, 1), 0.1, 0.1)[0].family, np.array([0, 7]), quads,
                       np.repeat(mapped[:, None], 4, axis=1), mapped)  # fmt: skip
    nothing = np.zeros((0, 3))
    found = Detections(np.zeros(0, int), nothing, nothing[:, :2], np.zeros(0), (seen,), (), (), ())
    picture = draw_detections(np.full((80, 180), 128, np.uint8), found).astype(int)
    known, foreign = picture[60, 35], picture[60, 135]
    assert known[0] > known[2] + 100
    assert foreign[2] > foreign[0] + 100
