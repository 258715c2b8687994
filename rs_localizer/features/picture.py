"""A picture to look at: the keypoints of an image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.features.extraction import Features

# Blue, green, red.
_COLOR = (0, 230, 255)
_LEAST_RADIUS = 2
# Digits after the point of drawn coordinates, in bits.
_SHIFT = 4


def draw_features(image: NDArray[np.uint8], features: Features) -> NDArray[np.uint8]:
    """The image (h,w,3) with a circle around what each descriptor describes."""
    picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    middles = np.rint(features.pixels * 2**_SHIFT).astype(int).tolist()
    radii = np.maximum(features.sizes / 2, _LEAST_RADIUS) * 2**_SHIFT
    for middle, radius in zip(middles, np.rint(radii).astype(int).tolist(), strict=True):
        cv2.circle(picture, middle, radius, _COLOR, 1, cv2.LINE_AA, _SHIFT)
    return picture
