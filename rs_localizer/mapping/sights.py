"""Which keypoints show which landmarks, all over a recording, and which of them an adjustment
needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.mapping.following import Followed
from rs_localizer.mapping.sightings import Sightings, Start
from rs_localizer.mapping.structure import Structure
from rs_localizer.mapping.views import View

# Of a landmark: fewer hold it on one ray, nearly.
_LEAST_SIGHTS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Keypoints of landmarks in posed views; rows of ``Followed.views``."""

    images: IntArray  # (n,)
    landmarks: IntArray  # (n,)
    pixels: Array  # (n,2) raw


def all_seen(views: Sequence[View], structure: Structure, followed: Followed) -> Seen:
    """What the views were found to show, and what COLMAP's matches say beside."""
    row = np.full(len(views), -1, np.int64)
    row[followed.views] = np.arange(len(followed.views))
    count = len(structure.points)
    known = followed.seen_views * count + followed.seen_points
    new = ~np.isin(structure.seen_views * count + structure.seen_points, known)
    new &= row[structure.seen_views] >= 0
    at, features = structure.seen_views[new], structure.seen_features[new]
    pixels = [
        views[v].features.pixels[f] for v, f in zip(at.tolist(), features.tolist(), strict=True)
    ]
    images = np.concatenate([row[followed.seen_views], row[at]])
    order = np.argsort(images, kind="stable")
    return Seen(
        images[order],
        np.concatenate([followed.seen_points, structure.seen_points[new]])[order],
        np.concatenate([followed.pixels, np.reshape(pixels, (-1, 2))])[order],
    )


def for_adjustment(
    stamps_ns: IntArray, followed: Followed, seen: Seen, points: Array, wanted: int
) -> tuple[Sightings, Start, IntArray]:
    """The landmarks that are seen most often, as many as the views need.

    Args:
        stamps_ns: of all views.
        wanted: keypoints of each view.

    Returns:
        what is adjusted, and which rows of ``followed.views`` take part.
    """
    chosen = _chosen(seen, len(points), len(followed.views), wanted)
    kept = chosen[seen.landmarks]
    used, images = np.unique(seen.images[kept], return_inverse=True)
    return (
        Sightings(stamps_ns[followed.views[used]], images, seen.landmarks[kept], seen.pixels[kept]),
        Start(points, followed.rotations[used], followed.positions[used]),
        used,
    )


def _chosen(seen: Seen, landmarks: int, images: int, wanted: int) -> BoolArray:
    """Landmarks by how often they are seen, each if half of its views need more."""
    order = np.argsort(seen.landmarks, kind="stable")
    starts = np.searchsorted(seen.landmarks[order], np.arange(landmarks + 1))
    counts, chosen = np.zeros(images, np.int64), np.zeros(landmarks, np.bool_)
    for landmark in np.argsort(-np.diff(starts), kind="stable").tolist():
        at = seen.images[order[starts[landmark] : starts[landmark + 1]]]
        if len(at) < _LEAST_SIGHTS:
            break
        if np.mean(counts[at] < wanted) >= 0.5:
            chosen[landmark] = True
            counts[at] += 1
    return chosen
