# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Correspondences as messages."""

from typing import Any

import numpy as np

from rs_localizer.io.bags import make_message
from rs_localizer.io.clouds import make_cloud


def cloud_of(stamp_ns: int, points: np.ndarray, pixels: np.ndarray) -> Any:
    """A PointCloud2 of points (n,3) of the map and their pixels (n,2)."""
    rows = np.zeros(len(points), [(name, "<f8") for name in "xyzuv"])
    for name, column in zip("xyzuv", [*points.T, *pixels.T], strict=True):
        rows[name] = column
    return make_cloud(make_message, stamp_ns, "map", rows)
