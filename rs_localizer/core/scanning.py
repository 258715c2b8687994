# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Directions of the shutter over the image; settings name them without a camera model."""

from __future__ import annotations

from enum import StrEnum


class ScanDirection(StrEnum):
    """The direction in which the shutter moves over the raw image."""

    TOP_TO_BOTTOM = "top_to_bottom"
    BOTTOM_TO_TOP = "bottom_to_top"
    LEFT_TO_RIGHT = "left_to_right"
    RIGHT_TO_LEFT = "right_to_left"


VERTICAL = ScanDirection.TOP_TO_BOTTOM, ScanDirection.BOTTOM_TO_TOP
"""Directions along the columns of the image."""

REVERSED = {
    ScanDirection.TOP_TO_BOTTOM: ScanDirection.BOTTOM_TO_TOP,
    ScanDirection.BOTTOM_TO_TOP: ScanDirection.TOP_TO_BOTTOM,
    ScanDirection.LEFT_TO_RIGHT: ScanDirection.RIGHT_TO_LEFT,
    ScanDirection.RIGHT_TO_LEFT: ScanDirection.LEFT_TO_RIGHT,
}
"""The opposite of each direction."""

ACROSS = {
    ScanDirection.TOP_TO_BOTTOM: ScanDirection.LEFT_TO_RIGHT,
    ScanDirection.BOTTOM_TO_TOP: ScanDirection.RIGHT_TO_LEFT,
    ScanDirection.LEFT_TO_RIGHT: ScanDirection.TOP_TO_BOTTOM,
    ScanDirection.RIGHT_TO_LEFT: ScanDirection.BOTTOM_TO_TOP,
}
"""One along the other axis, as drivers that turn images make of each direction."""
