# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Bundles of apriltag_ros (ROS 1): YAML.

    tag_family: tag36h11
    tag_bundles:
      - name: wall
        layout:
          - {id: 0, size: 0.16, x: 0, y: 0, z: 0, qw: 1, qx: 0, qy: 0, qz: 0}

Metres; x of a tag is to the right, y up, z toward the viewer (AprilRobotics/apriltag_ros #156).
What is missing of a pose is that of the origin. The family may be in another file of parameters;
standalone tags have no place.
"""

from __future__ import annotations

from typing import Any

import yaml

from rs_localizer.markers.entries import Entry
from rs_localizer.markers.families import Family
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


def read(tree: Any, unsaid: Unsaid) -> MarkerMap:
    """The map of a parsed file; raises ValueError for anything else."""
    file = Entry(tree, "the file")
    family, found = family_of(file, unsaid), file.entries("tag_bundles", "bundle")
    bundles = {
        str(bundle.take("name", (str, int), f"{index}")): bundle
        for index, bundle in enumerate(found)
    }
    if not bundles:
        raise MarkerMapError("it has no tag_bundles: standalone tags have no place")
    if not unsaid.part and len(bundles) > 1:
        raise MarkerMapError(
            f"it has {len(bundles)} bundles, each in a frame of its own: choose one of "
            f"{', '.join(bundles)} with --part"
        )
    if unsaid.part and unsaid.part not in bundles:
        raise MarkerMapError(f"it has no bundle {unsaid.part}; it has {', '.join(bundles)}")
    chosen = bundles[unsaid.part] if unsaid.part else next(iter(bundles.values()))
    markers = tuple(_marker(tag, family) for tag in chosen.entries("layout", "tag"))
    return MarkerMap(markers, map_frame=unsaid.map_frame)


def _marker(tag: Entry, family: Family) -> Marker:
    number, size = identifier(tag, "id"), tag.number("size")
    place = vector(tag, "xyz")
    turn = [float(tag.take(f"q{name}", (int, float), float(name == "w"))) for name in "xyzw"]
    with tag.named():
        pose = Pose(place, rotation_of_quaternion(turn))
        return Marker.at(family.name, number, size, pose)


def write(marker_map: MarkerMap) -> str:
    """The text of a file with one bundle."""
    layout, markers = [], single_markers(marker_map, "apriltag_ros")
    for marker in markers:
        pose = marker.pose
        tag: dict[str, Any] = {"id": marker.id, "size": rounded([marker.size])[0]}
        tag |= dict(zip("xyz", rounded(pose.position), strict=True))
        tag |= dict(zip(("qx", "qy", "qz", "qw"), quaternion(pose.rotation), strict=True))
        layout.append(tag)
    tree = {
        TAG_FAMILY: family_name(markers),
        "standalone_tags": [],
        "tag_bundles": [{"name": marker_map.map_frame, "layout": layout}],
    }
    return str(yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=160))
