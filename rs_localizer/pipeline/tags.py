# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Tags that other detectors have found become correspondences by a map of markers."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.core.arrays import IntArray
from rs_localizer.core.reasons import Notice, Reason
from rs_localizer.io.clouds import Correspondences, make_rows, point_fields
from rs_localizer.io.detections import TagDetections, read_detections
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.pipeline.refusal import Notify, Refusal, read_or_refuse

_SHOWN = 8  # names in a sentence


class Tags:
    """The markers that detections may be of.

    Args:
        marker_map: the map; only its single markers count.
        notice: called with oddities.
    """

    def __init__(self, marker_map: MarkerMap, notice: Notify) -> None:
        self._map = marker_map
        self._notice = notice
        self._points = marker_map.points
        self._rows = {(m.family.kind, m.id): 4 * k for k, m in enumerate(marker_map.markers)}
        self._kinds = {
            m.family.kind.replace("apriltag_", "tag"): m.family.kind for m in marker_map.markers
        }
        self.names = [f"{m.family.kind} {m.id}" for m in marker_map.markers for _ in range(4)]
        """Names of the corners; the ids of correspondences are their places."""
        self.corners = np.array([marker.corners for marker in marker_map.markers])  # (n,4,3)

    def match(self, message: Any) -> Correspondences | Refusal:
        """Match an AprilTagDetectionArray with the map; a bad one is refused, never raised."""
        detections = read_or_refuse(read_detections, message, Reason.BAD_DETECTIONS)
        if isinstance(detections, Refusal):
            return detections
        if len(detections.ids) == 0:
            return Refusal(Reason.EMPTY_CLOUD, "the detector has found no tag")
        rows = self._known(detections)
        if not (rows >= 0).any():
            names = _listed(detections, np.arange(len(rows)))
            return Refusal(Reason.NO_MATCHES, f"the marker map has none of {names}")
        detections = replace(detections, ids=rows[rows >= 0], corners=detections.corners[rows >= 0])
        return self._correspondences(detections)

    def _known(self, detections: TagDetections) -> IntArray:
        """Return the first row of each tag (m,) in the map's points; -1 if it is not used."""
        keys = [
            (self._kinds.get(name, name), number)
            for name, number in zip(detections.families, detections.ids.tolist(), strict=True)
        ]
        rows = np.array([self._rows.get(key, -1) for key in keys], np.int64)
        repeated = np.array([keys.count(key) > 1 for key in keys], bool)
        for name, some, text in (
            (Notice.UNKNOWN_MARKERS, rows < 0, "which the map does not have"),
            (Notice.REPEATED_MARKERS, repeated, "more than once: not used"),
        ):
            if some.any():
                listed = _listed(detections, np.flatnonzero(some))
                self._notice(name, f"the detector has found {listed}, {text}")
        rows[repeated] = -1
        return rows

    def _correspondences(self, detections: TagDetections) -> Correspondences:
        sides = np.linalg.norm(np.roll(detections.corners, -1, axis=1) - detections.corners, axis=2)
        scores = np.repeat(sides.min(axis=1), 4)
        ids = (detections.ids[:, None] + np.arange(4)).ravel()
        points, pixels = self._points[ids], detections.corners.reshape(-1, 2)
        table = make_rows(point_fields("<f8"), [*points.T, *pixels.T, scores, ids])
        return Correspondences(
            detections.stamp_ns, self._map.map_frame, points, pixels, scores, 0, table
        )


def read_tags(file: str, notice: Notify) -> Tags:
    """Read the tags of a map file; ``~`` is the user's home.

    Raises:
        MarkerMapError: for a file that cannot be used.
    """
    return Tags(read_marker_map(Path(file).expanduser()), notice)


def _listed(detections: TagDetections, some: IntArray) -> str:
    names = [f"{detections.families[k]} {detections.ids[k]}" for k in some.tolist()]
    return ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
