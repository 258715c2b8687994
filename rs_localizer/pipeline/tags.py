# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Tags that other detectors have found become correspondences by a map of markers."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from rs_localizer.core.arrays import IntArray
from rs_localizer.core.reasons import Notice, Reason
from rs_localizer.io.clouds import Correspondences, make_rows, point_fields
from rs_localizer.io.detections import read_detections
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
        if not detections.names:
            return Refusal(Reason.EMPTY_CLOUD, "the detector has found no tag")
        names = [f"{family} {number}" for family, number in detections.names]
        rows = self._known(detections.names, names)
        if not (rows >= 0).any():
            return Refusal(Reason.NO_MATCHES, f"the marker map has none of {listed(names)}")
        corners = detections.corners[rows >= 0]
        scores = np.repeat(np.linalg.norm(np.roll(corners, -1, 1) - corners, axis=2).min(axis=1), 4)
        ids = (rows[rows >= 0][:, None] + np.arange(4)).ravel()
        points, pixels = self._points[ids], corners.reshape(-1, 2)
        table = make_rows(point_fields("<f8"), [*points.T, *pixels.T, scores, ids])
        frame = self._map.map_frame
        return Correspondences(detections.stamp_ns, frame, points, pixels, scores, 0, table)

    def _known(self, tags: list[tuple[str, int]], names: list[str]) -> IntArray:
        """Return the first row of each tag (m,) in the map's points; -1 if it is not used."""
        keys = [(self._kinds.get(family, family), number) for family, number in tags]
        rows = np.array([self._rows.get(key, -1) for key in keys], np.int64)
        repeated = np.array([keys.count(key) > 1 for key in keys], bool)
        for name, some, text in (
            (Notice.UNKNOWN_MARKERS, rows < 0, "which the map does not have"),
            (Notice.REPEATED_MARKERS, repeated, "more than once: not used"),
        ):
            if some.any():
                found = listed([names[k] for k in np.flatnonzero(some)])
                self._notice(name, f"the detector has found {found}, {text}")
        rows[repeated] = -1
        return rows


def listed(names: Sequence[str]) -> str:
    """Return the first of some names in a sentence."""
    return ", ".join(names[:_SHOWN]) + (", ..." if len(names) > _SHOWN else "")
