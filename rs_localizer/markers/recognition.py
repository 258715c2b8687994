# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What an image shows of markers and boards, whichever they are: for those whose map is wrong."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.markers.dictionaries import DictionaryError, Gray, MarkerFinder
from rs_localizer.markers.edges import refine
from rs_localizer.markers.families import FAMILIES, Family

# Smaller ones (px) may be anything.
_LEAST_SIDE = 12.0
# Quadrilaterals are the same whose middles are nearer than this, in sides.
_SAME = 0.5
# Noise looks like a board of 3x3.
_LEAST_CORNERS = 12
_MOST_IDS = 6


def recognized(image: Gray) -> list[str]:
    """The markers, by family, and the chessboard that an image shows; most certain first.

    Takes seconds in a large image: all families are tried. Of several that read the same
    quadrilateral, that with the most bits counts, for it is the least likely to be chance.
    """
    taken: list[Array] = []
    said = []
    for finder in _finders():
        ids, quads = finder.find(image)
        good = [
            (id_, quad)
            for id_, quad in zip(ids.tolist(), quads, strict=True)
            if _side(quad) >= _LEAST_SIDE
        ]
        if not good:
            continue
        corners = np.array([quad for _, quad in good])
        exact = np.all(refine(image, corners, np.full(len(good), finder.family.cells)), axis=1)
        found = []
        for (id_, quad), certain in zip(good, exact, strict=True):
            if certain and not any(_same(quad, other) for other in taken):
                taken.append(quad)
                found.append(id_)
        if found:
            listed = ", ".join(map(str, sorted(set(found))[:_MOST_IDS]))
            more = ", ..." if len(set(found)) > _MOST_IDS else ""
            said.append(f"{_smallest(finder.family, max(found)).name} {listed}{more}")
    board = chessboard_size(image)
    if board is not None:
        said.append(f"a chessboard of {board[0]}x{board[1]} inner corners")
    return said


def chessboard_size(image: Gray) -> tuple[int, int] | None:
    """Inner corners, the larger number first, of a chessboard that an image shows."""
    try:
        found, corners, meta = cv2.findChessboardCornersSBWithMeta(
            image, (3, 3), cv2.CALIB_CB_LARGER
        )
    except cv2.error:
        return None
    if not found or len(corners) < _LEAST_CORNERS:
        return None
    rows, columns = sorted(np.asarray(meta).shape[:2])
    return columns, rows


@lru_cache(maxsize=1)
def _finders() -> tuple[MarkerFinder, ...]:
    """One of each kind of family that this OpenCV knows: its largest; most bits first."""
    largest: dict[str, Family] = {}
    for family in FAMILIES.values():
        if family.kind not in largest or family.count > largest[family.kind].count:
            largest[family.kind] = family
    finders = []
    for family in sorted(largest.values(), key=lambda family: -family.bits):
        try:
            finders.append(MarkerFinder(family))
        except DictionaryError:
            continue
    return tuple(finders)


def _smallest(family: Family, last_id: int) -> Family:
    """The smallest family of the same kind that has an id."""
    alike = (f for f in FAMILIES.values() if f.kind == family.kind and f.count > last_id)
    return min(alike, key=lambda f: f.count)


def _side(quad: Array) -> float:
    return float(np.linalg.norm(np.roll(quad, -1, axis=0) - quad, axis=1).min())


def _same(quad: Array, other: Array) -> bool:
    apart = np.linalg.norm(quad.mean(axis=0) - other.mean(axis=0))
    return bool(apart < _SAME * _side(other))
