# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What the formats have in common."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.markers.entries import Entry
from rs_localizer.markers.families import FAMILIES, Family, family
from rs_localizer.markers.maps import MarkerMap, MarkerMapError
from rs_localizer.markers.prints import Marker

TAG_FAMILY = "tag_family"
"""Key of the family's name: a parameter of apriltag_ros, which reads it beside the bundles. The
other formats have no place for it, and their readers pass over keys that they do not know.
"""
USUAL_FAMILY = FAMILIES["apriltag_36h11"]
"""Of files that do not say it."""


@dataclass(frozen=True, slots=True)
class Unsaid:
    """What a file does not say of its markers."""

    family: Family | None = None  # None: as the file says, or the usual one
    size: float | None = None  # m
    map_frame: str = "map"
    part: str = ""  # name of the bundle or body to take


def family_of(file: Entry, unsaid: Unsaid) -> Family:
    """The family of a file's markers; raises ValueError for a name that is none."""
    if unsaid.family is not None:
        return unsaid.family
    return family(file.take(TAG_FAMILY, str, USUAL_FAMILY.name))


def family_name(markers: tuple[Marker, ...]) -> str:
    """What is written under :data:`TAG_FAMILY`: AprilTag's own names, where there is one."""
    largest = max((marker.family for marker in markers), key=lambda of: of.count)
    return re.sub(r"^apriltag_", "tag", largest.name)


def identifier(entry: Entry, name: str) -> int:
    """The id of a tag, which tells errors where they are."""
    number: int = entry.take(name, int)
    entry.where += f" (id {number})"
    return number


def vector(entry: Entry, names: str) -> Array:
    """Numbers under keys of one letter each; what is missing is 0."""
    kinds = (int, float)
    return np.array([float(entry.take(name, kinds, 0.0)) for name in names])


def single_markers(marker_map: MarkerMap, what: str) -> tuple[Marker, ...]:
    """The markers of a map that a format without boards can hold, all of one family.

    Raises:
        MarkerMapError: for another map.
    """
    if marker_map.boards:
        raise MarkerMapError(f"{what} cannot hold boards: {marker_map.boards[0].name}")
    kinds = sorted({marker.family.kind for marker in marker_map.markers})
    if len(kinds) > 1:
        raise MarkerMapError(f"{what} holds markers of one family, found {' and '.join(kinds)}")
    return marker_map.markers


def quaternion(rotation: Array) -> list[float]:
    """x y z w."""
    return rounded(so3.quaternion(np.ascontiguousarray(rotation)))


def rounded(values: Any) -> list[float]:
    """Without the rounding errors of a fitted pose."""
    return [round(float(value), 12) + 0.0 for value in values]
