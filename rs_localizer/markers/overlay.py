# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pictures of detections."""

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.markers.detection import Detections
from rs_localizer.markers.dictionaries import Gray

# Blue, green, red: of markers that the map has, and of others.
_KNOWN, _FOREIGN = (230, 120, 0), (0, 150, 255)


def draw_detections(image: Gray, detections: Detections) -> NDArray[np.uint8]:
    """Return the image (h,w,3) with outlines and numbers of markers; those of the map are blue."""
    picture = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    for item in detections.markers:
        for own, color in ((item.mapped, _KNOWN), (~item.mapped, _FOREIGN)):
            quads = list(item.quads[own].astype(np.float32)[:, None])
            if quads:
                cv2.aruco.drawDetectedMarkers(picture, quads, item.ids[own, None], color)
    return picture
