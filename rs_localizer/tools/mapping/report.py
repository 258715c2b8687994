# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Table and advice on a map that was built."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rs_localizer.tools.mapping.build import Built
from rs_localizer.tools.mapping.map_keypoints import MapObservations
from rs_localizer.tools.mapping.seen_images import SeenImage

# Advice is given where more than this share of the images is blurred or has no pose.
_MANY = 0.1
# A walk comes back if this share of what its last images show was shown by its first ones, a tenth
# of all each. What lies between holds together by neighbours alone, whose errors add up.
_AGAIN, _ENDS = 0.1, 0.1


def rows(built: Built, images: int, views: int) -> dict[str, str]:
    """Return the table of results.

    Args:
        images: of the recording.
        views: of them that were looked at.
    """
    refined, landmarks = built.refined, built.landmarks
    assert landmarks.covariances is not None
    spread = np.sqrt(np.trace(landmarks.covariances, axis1=1, axis2=2))
    unit = "mm" if built.placement.scaled else "units of the map / 1000"
    return {
        "images": f"{images}, {views} used, {len(built.posed)} with a pose",
        "landmarks": f"{len(landmarks)} of {len(built.structure.start.points)} points",
        "deviation of a landmark": f"{1e3 * np.median(spread):.1f} {unit} (median)",
        "deviation that landmarks share": f"{_shared(built):.1f} {unit} (median)",
        "noise": f"{refined.before:.2f} px, after the refinement {refined.after:.2f} px",
        "readout time": _shutter(built),
        "scale": built.placement.basis,
        "z is up": built.placement.up,
    }


def _shared(built: Built) -> float:
    """Return the median deviation that a landmark shares with others, in 1/1000 of the map."""
    assert built.landmarks.error_modes is not None
    return 1e3 * float(np.median(np.linalg.norm(built.landmarks.error_modes, axis=(1, 2))))


def advice(built: Built, views: Sequence[SeenImage]) -> list[str]:
    """Return sentences on how to film a better map."""
    said = []
    lost = np.ones(len(views), np.bool_)
    lost[built.posed] = False
    if np.mean(lost) > _MANY:
        rows_lost = np.flatnonzero(lost)[[0, -1]].tolist()
        begin, last = (1e-9 * (views[k].stamp_ns - views[0].stamp_ns) for k in rows_lost)
        said.append(
            f"{np.mean(lost):.0%} of the images, from {begin:.1f} to {last:.1f} s, have no pose: "
            "film there more slowly"
        )
    if len(built.structure.parts) > 1:
        said.append(
            f"{sum(built.structure.parts[1:])} keyframes are not connected with the others: film "
            "what lies between, and come back to where you began"
        )
    if not comes_back(built.structure.seen):
        unit = "mm" if built.placement.scaled else "thousandths of the map's unit"
        said.append(
            f"the last images show nothing that the first ones do: landmarks share errors of "
            f"{_shared(built):.1f} {unit}, larger ones towards the ends; come back to where you "
            "began, or show markers at both ends"
        )
    shutter = built.shutter
    known = shutter.visible if shutter else not built.refined.apart
    if not known:
        said.append(
            "for the readout time, film at the camera's own rate (no time lapse, no stabilization) "
            "and rotate the camera quickly, sideways and up and down, for some seconds"
        )
    return said


def comes_back(seen: MapObservations) -> bool:
    """Return whether the last images show landmarks that the first ones show."""
    count = len(seen.stamps_ns)
    ends = max(1, round(_ENDS * count))
    first = np.unique(seen.landmarks[seen.images < ends])
    last = np.unique(seen.landmarks[seen.images >= count - ends])
    return len(np.intersect1d(first, last)) >= _AGAIN * min(len(first), len(last))


def _shutter(built: Built) -> str:
    fit, known = built.shutter, built.camera.readout_time
    if fit is None:
        if built.refined.apart:
            return "invisible: no smooth motion joins the images, each has a pose of its own"
        return f"{1e3 * known:.2f} ms (given)" if known else "unknown, or none"
    best = f"{1e3 * fit.readout_time:.2f} +- {1e3 * fit.deviation:.2f} ms, {fit.direction}"
    if fit.visible:
        return f"{best} (estimated)"
    why = "" if fit.possible else f", longer than {1e3 * fit.interval:.1f} ms between images"
    return f"invisible in these images (best fit {best}{why})"
