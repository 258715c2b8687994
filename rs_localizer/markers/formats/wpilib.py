# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""AprilTag fields of WPILib (FIRST Robotics): JSON.

    {"tags": [{"ID": 1, "pose": {"translation": {"x": 1.0, "y": 2.0, "z": 1.5},
                                 "rotation": {"quaternion": {"W": 1, "X": 0, "Y": 0, "Z": 0}}}}],
     "field": {"length": 16.54, "width": 8.02}}

Metres; z is up, x of a tag comes out of it toward the viewer, y is to the viewer's right. Sizes
are not in the file; nor is the family, which is written, and read, as ``tag_family``.
"""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from rs_localizer.markers.entries import Entry
from rs_localizer.markers.formats.common import (
    TAG_FAMILY,
    Unsaid,
    family_name,
    family_of,
    identifier,
    quaternion,
    rounded,
    single_markers,
    vector,
)
from rs_localizer.markers.maps import MarkerMap, MarkerMapError
from rs_localizer.markers.poses import Pose, rotation_of_quaternion
from rs_localizer.markers.prints import Marker

# Tag of WPILib from print: to the right is y, up z, out of the print x.
_TAG_FROM_PRINT = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])

# The file does not say sizes: all are the same to this part.
_SAME_SIZE = 1e-3


def read(tree: Any, unsaid: Unsaid) -> MarkerMap:
    """The map of a parsed file; raises ValueError for anything else."""
    if unsaid.size is None:
        raise MarkerMapError(
            "a field of WPILib does not say how large its tags are: give --size (m; 0.1651 of FRC)"
        )
    field, markers = Entry(tree, "the field"), []
    family = family_of(field, unsaid)
    for tag in field.entries("tags", "tag"):
        number = identifier(tag, "ID")
        pose = Entry(tag.take("pose", dict), f"{tag.where}: pose")
        place = vector(Entry(pose.take("translation", dict), pose.where), "xyz")
        turn = Entry(pose.take("rotation", dict), pose.where)
        x, y, z, w = vector(Entry(turn.take("quaternion", dict), pose.where), "XYZW")
        with tag.named():
            rotation = rotation_of_quaternion([x, y, z, w]) @ _TAG_FROM_PRINT
            markers.append(Marker.at(family.name, number, unsaid.size, Pose(place, rotation)))
    return MarkerMap(tuple(markers), map_frame=unsaid.map_frame)


def write(marker_map: MarkerMap) -> str:
    """The text of a file; the field is as large as its tags need, from the origin on."""
    tags = []
    markers = single_markers(marker_map, "a field of WPILib")
    sizes = sorted({rounded([marker.size])[0] for marker in markers})
    if sizes and sizes[-1] > sizes[0] * (1.0 + _SAME_SIZE):
        raise MarkerMapError(
            f"a field of WPILib holds tags of one size, found {sizes[0]:g} to {sizes[-1]:g} m"
        )
    for marker in markers:
        pose = marker.pose
        x, y, z, w = quaternion(pose.rotation @ _TAG_FROM_PRINT.T)
        place = dict(zip("xyz", rounded(pose.position), strict=True))
        turn = {"quaternion": {"W": w, "X": x, "Y": y, "Z": z}}
        tags.append({"ID": marker.id, "pose": {"translation": place, "rotation": turn}})
    length, width = np.maximum(marker_map.points.max(axis=0), 0.0)[:2]
    field = {"length": round(float(length), 6), "width": round(float(width), 6)}
    tree = {TAG_FAMILY: family_name(markers), "tags": tags, "field": field}
    return json.dumps(tree, indent=1) + "\n"
