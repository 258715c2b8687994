# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Messages of images -> correspondences: all of the marker detector but ROS.

The node and the offline ``rs_localizer detect`` run this one class.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rs_localizer.config import DetectorConfig
from rs_localizer.core.reasons import Notice
from rs_localizer.io.clouds import make_cloud, make_rows, point_fields
from rs_localizer.io.images import Image
from rs_localizer.io.messages import Make
from rs_localizer.markers.detection import Detections, MarkerDetector
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.markers.maps import MarkerMap, MarkerMapError
from rs_localizer.pipeline.refusal import Notify, unheard
from rs_localizer.pipeline.tags import listed
from rs_localizer.pipeline.what_fits import Mistakes

# Single precision is what RViz shows: 3e-5 px at the rim of an image, and 0.1 mm at the end of a
# map of a kilometre. Larger ones (georeferenced) need more.
_LARGE_MAP = 1000.0  # m
# Fewer corners than those of three markers may be what is left of a mirrored map: some markers,
# mirrored, are others. Mirrored back there are twice as many, and two markers more.
_LITTLE, _TIMES, _MORE = 12, 2, 8
# px; in smaller markers a cell has less than two pixels, and corners are off by more than noise.
_LEAST_SIDE = 10.0


class Detected(NamedTuple):
    """An image in which markers were looked for."""

    image: Image
    detections: Detections
    map: MarkerMap


def correspondences(detected: Detected, make: Make) -> Any:
    """Make the sensor_msgs/PointCloud2 of an image, for node and bag alike."""
    detections = detected.detections
    kind = "<f8" if np.abs(detected.map.points).max() > _LARGE_MAP else "<f4"
    columns = [*detections.points.T, *detections.pixels.T, detections.scores, detections.ids]
    rows = make_rows(point_fields(kind), columns)
    return make_cloud(make, detected.image.stamp_ns, detected.map.map_frame, rows)


class FrameDetector:
    """Finds the markers of a map in images.

    Args:
        config: its settings.
        notice: called with faults that stop nothing.
        marker_map: instead of the file of the settings.

    Raises:
        MarkerMapError: without a map, or with one that cannot be used.
    """

    def __init__(
        self, config: DetectorConfig, notice: Notify = unheard, marker_map: MarkerMap | None = None
    ) -> None:
        if marker_map is None:
            if not config.marker_map:
                raise MarkerMapError("marker_map is not set; it must name the file of the map")
            marker_map = read_marker_map(Path(config.marker_map).expanduser())
        self.map, markers, boards = marker_map, len(marker_map.markers), len(marker_map.boards)
        self.described = f"{markers} markers and {boards} boards in {marker_map.map_frame}"
        self._notice = notice
        self._detector = MarkerDetector(marker_map, _LEAST_SIDE)

        # Fault of all images, as a sentence; empty: unknown.
        self.mistake = ""
        self._mistakes = Mistakes()

    def detect(self, image: Image) -> Detected:
        """Look for markers in an image."""
        detections = self._detector.detect(image.pixels, image.stamp_ns)
        for name, markers, text in (
            (Notice.UNKNOWN_MARKERS, detections.unknown, "which the map does not have"),
            (Notice.REPEATED_MARKERS, detections.repeated, "more than once: not used"),
        ):
            if markers:
                self._notice(name, f"the image shows {listed(markers)}, {text}")
        for fault in detections.faults:
            self._notice(Notice.OTHER_BOARD, fault)
        if len(detections.ids) < _LITTLE or detections.unknown:
            corners = len(detections.ids)
            self.mistake = self._mistakes.explain_frame(lambda: self._mirrored(image, corners))
            if self.mistake:
                self._notice(Notice.WOULD_FIT, self.mistake)
        return Detected(image, detections, self.map)

    def _mirrored(self, image: Image, shown: int) -> str:
        """Return a warning if the mirrored image shows more corners than this one, or ``""``."""
        detector = MarkerDetector(self.map)  # whose boards lie otherwise
        corners = len(detector.detect(image.pixels[:, ::-1], image.stamp_ns).ids)
        if corners < _TIMES * shown + _MORE:
            return ""
        return (
            "the images are mirrored: mirrored back, they show more of the map; take them as the "
            "sensor reads them"
        )
