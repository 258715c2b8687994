# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Settings of simulations. Imports nothing that takes time: commands show it as help."""

from dataclasses import dataclass

import numpy as np

BODY_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Camera axes (x right, y down, z forward) in those of REP-103's body, x forward and z up."""


@dataclass(frozen=True, slots=True)
class FrameSettings:
    """Points of each frame, and how badly they are seen."""

    points: int = 150  # at most; fewer where the map shows fewer
    noise: float = 1.0  # standard deviation of u and of v, raw pixels
    outliers: float = 0.3  # share of the points whose pixel is uniform in the image
    rate: float = 30.0  # frames per second


@dataclass(frozen=True, slots=True)
class ImageSettings:
    """Faults of the sensor."""

    exposure: float = 0.0  # s that each row is exposed, around its row time; 0: an instant
    noise: float = 0.0  # standard deviation of a grey level (of 255)
