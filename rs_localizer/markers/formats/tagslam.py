# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""TagSLAM's ``tagslam.yaml``: the tags of its static bodies.

    bodies:
      - lab:
          is_static: true
          default_tag_size: 0.16
          pose: {position: {x: 0, y: 0, z: 0}, rotation: {x: 0, y: 0, z: 0}}
          tags:
            - id: 0
              size: 0.16
              pose: {position: {x: 0, y: 0, z: 0}, rotation: {x: 0, y: 0, z: 0}}

Metres; ``rotation`` is a rotation vector (rad). x of a tag is to the right, y up, z toward the
viewer. The family is not of the format: it is written, and read, as ``tag_family``. Tags without a
pose, which TagSLAM is to find, are left out.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.markers.entries import Entry
from rs_localizer.markers.families import Family
from rs_localizer.markers.formats.common import (
    TAG_FAMILY,
    Unsaid,
    family_name,
    family_of,
    identifier,
    rounded,
    single_markers,
    vector,
)
from rs_localizer.markers.maps import MarkerMap, MarkerMapError
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.prints import Marker

# What is written for a tag whose errors are not known: m, rad.
_POSITION_NOISE, _ROTATION_NOISE = 0.001, 0.001
# Of the body itself, which is the map.
_AT_REST = 1e-6


def read(tree: Any, unsaid: Unsaid) -> MarkerMap:
    """The map of a parsed file; raises ValueError for anything else."""
    file, markers, names = Entry(tree, "the file"), list[Marker](), []
    family = family_of(file, unsaid)
    for item in file.entries("bodies", "body"):
        for name, body in _named(item):
            names.append(name)
            if (unsaid.part or name) == name and body.take("is_static", bool, True):
                markers += _markers(body, family)
    if unsaid.part and unsaid.part not in names:
        raise MarkerMapError(f"it has no body {unsaid.part}; it has {', '.join(names) or 'none'}")
    if not markers:
        raise MarkerMapError("none of its static bodies has tags with a pose")
    return MarkerMap(tuple(markers), map_frame=unsaid.map_frame)


def _named(item: Entry) -> list[tuple[str, Entry]]:
    """The bodies of an entry of the list: one, under its name."""
    return [(name, Entry(item.take(name, dict), f"body {name}")) for name in item.names()]


def _markers(body: Entry, family: Family) -> list[Marker]:
    size = body.take("default_tag_size", (int, float), None)
    place, turn = _pose(body) if "pose" in body else (np.zeros(3), np.eye(3))
    markers = []
    for tag in body.entries("tags", "tag"):
        tag.where = f"{body.where}: {tag.where}"
        number = identifier(tag, "id")
        side = float(tag.take("size", (int, float), *([] if size is None else [size])))
        if "pose" not in tag:
            continue
        own_place, own_turn = _pose(tag)
        with tag.named():
            pose = Pose(turn @ own_place + place, turn @ own_turn)
            markers.append(Marker.at(family.name, number, side, pose))
    return markers


def _pose(entry: Entry) -> tuple[Array, Array]:
    pose = Entry(entry.take("pose", dict), f"{entry.where}: pose")
    place = vector(Entry(pose.take("position", dict), f"{pose.where}: position"), "xyz")
    turn = vector(Entry(pose.take("rotation", dict), f"{pose.where}: rotation"), "xyz")
    return place, so3.exp(turn)


def write(marker_map: MarkerMap) -> str:
    """The text of a file with one static body."""
    tags, markers = [], single_markers(marker_map, "TagSLAM")
    for marker in markers:
        known = marker.deviations
        if known is None:
            known = np.repeat([_POSITION_NOISE, _ROTATION_NOISE], 3)
        turn = Rotation.from_matrix(marker.pose.rotation).as_rotvec()
        pose = {
            "position": _xyz(marker.pose.position),
            "rotation": _xyz(turn),
            "position_noise": _xyz(known[:3]),
            "rotation_noise": _xyz(known[3:]),
        }
        tags.append({"id": marker.id, "size": rounded([marker.size])[0], "pose": pose})
    # Each of its own: YAML would refer from one to the other.
    at_rest = {"position": _xyz(np.zeros(3)), "rotation": _xyz(np.zeros(3))}
    at_rest |= {f"{name}_noise": _xyz(np.full(3, _AT_REST)) for name in ("position", "rotation")}
    body = {"is_static": True, "type": "simple", "pose": at_rest, "tags": tags}
    tree = {
        TAG_FAMILY: family_name(markers),
        "default_body": marker_map.map_frame,
        "bodies": [{marker_map.map_frame: body}],
    }
    return str(yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=160))


def _xyz(values: Array) -> dict[str, float]:
    return dict(zip("xyz", rounded(values), strict=True))
