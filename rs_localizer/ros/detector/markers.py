# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The node ``marker_detector``: images in; correspondences with a marker map out."""

import cv2
import numpy as np

from rs_localizer.config import DetectorConfig
from rs_localizer.core.reasons import Notice
from rs_localizer.io.topics import CORRESPONDENCES
from rs_localizer.pipeline.marker_detector import Detected, FrameDetector, correspondences
from rs_localizer.ros.detector.image_node import ImageNode, Picture
from rs_localizer.ros.node.diagnostics import State
from rs_localizer.ros.node.statistics import Told
from rs_localizer.ros.node.views import MapView
from rs_localizer.settings import DETECTOR_NAME


def tell(detected: Detected) -> tuple[int, Told]:
    """Return the stamp of an image (ns), and what the statistics keep of it."""
    detections = detected.detections
    markers = sum(int(item.mapped.sum()) for item in detections.markers)
    boards, corners = len(detections.boards), len(detections.ids)
    text = "the last image shows no part of the map"
    if corners:
        text = f"{corners} corners of {markers} markers"
        text += f" and {boards} boards" if boards else ""
    values = {
        "Markers": str(markers),
        "Boards": str(boards),
        "Corners": str(corners),
        "Markers not in the map": str(len(detections.unknown)),
    }
    return detected.image.stamp_ns, Told(State.DETECTING, text, values)


# Blue, green, red: of markers that the map has, and of others.
_KNOWN, _FOREIGN = (230, 120, 0), (0, 150, 255)


def draw(detected: Detected) -> Picture:
    """Return the image (h,w,3) with outlines and numbers of markers; those of the map are blue."""
    picture = np.asarray(cv2.cvtColor(detected.image.pixels, cv2.COLOR_GRAY2BGR), np.uint8)
    for item in detected.detections.markers:
        for own, color in ((item.mapped, _KNOWN), (~item.mapped, _FOREIGN)):
            quads = list(item.quads[own].astype(np.float32)[:, None])
            if quads:
                cv2.aruco.drawDetectedMarkers(picture, quads, item.ids[own, None], color)
    return picture


class MarkerDetectorNode(ImageNode[DetectorConfig, Detected]):
    """Looks for markers."""

    node_name = task = DETECTOR_NAME
    kind, output = DetectorConfig, CORRESPONDENCES
    tell, make_cloud, draw = staticmethod(tell), staticmethod(correspondences), staticmethod(draw)
    odd = (
        Notice.OTHER_BOARD, Notice.REPEATED_MARKERS, Notice.TWO_PUBLISHERS, Notice.WOULD_FIT,
    )  # fmt: skip
    checked_at_start = False  # the map may come later: on_configure tells

    def check(self, config: DetectorConfig) -> None:
        # Before it is configured, the map may still be missing.
        if config.marker_map or self.worker is not None:
            super().check(config)

    def make_finder(self, config: DetectorConfig) -> FrameDetector:
        return FrameDetector(config, self.refusals.notice)

    def open(self, config: DetectorConfig) -> None:
        self._map_view = MapView(self)
        super().open(config)

    def use_finder(self, finder: FrameDetector) -> None:
        super().use_finder(finder)
        corners = [marker.corners for marker, _ in finder.map.all_markers()]
        if corners:
            self._map_view.show(finder.map.map_frame, np.array(corners))
