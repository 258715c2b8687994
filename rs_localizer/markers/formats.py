# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Marker maps of other programs, read and written; which it is, what a file holds tells.

AprilTag fields of WPILib (FIRST Robotics), JSON. Metres; z is up, x of a tag comes out of it toward
the viewer, y is to the viewer's right. Sizes are not in the file::

    {"tags": [{"ID": 1, "pose": {"translation": {"x": 1.0, "y": 2.0, "z": 1.5},
                                 "rotation": {"quaternion": {"W": 1, "X": 0, "Y": 0, "Z": 0}}}}],
     "field": {"length": 16.54, "width": 8.02}}

Bundles of apriltag_ros (ROS 1), YAML. Metres; x of a tag is to the right, y up, z toward the viewer
(AprilRobotics/apriltag_ros #156).
What is missing of a pose is that of the origin. Standalone tags have no place::

    tag_family: tag36h11
    tag_bundles: [{name: wall, layout: [{id: 0, size: 0.16, x: 0, y: 0, z: 0, qw: 1, qx: 0, ...}]}]
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rs_localizer.core.arrays import Array
from rs_localizer.io.yaml_text import YamlError, check_tree, file_faults, load_yaml
from rs_localizer.markers.families import FAMILIES, Family, family
from rs_localizer.markers.map_files import Entry, read_marker_map, rounded, write_marker_map
from rs_localizer.markers.maps import MarkerMap, MarkerMapError
from rs_localizer.markers.poses import Pose, quaternion_of_rotation, rotation_of_quaternion
from rs_localizer.markers.prints import Marker

# Key of the family's name: a parameter of apriltag_ros, which reads it beside the bundles. The
# other formats have no place for it, and their readers pass over keys that they do not know.
_TAG_FAMILY = "tag_family"
USUAL_FAMILY = FAMILIES["apriltag_36h11"]
"""Of files that do not say it."""
_NUMBER = (int, float)
# Tag of WPILib from print: to the right is y, up z, out of the print x.
_TAG_FROM_PRINT = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
# A field of WPILib does not say sizes: all are the same to this part.
_SAME_SIZE = 1e-3


@dataclass(frozen=True, slots=True)
class Unsaid:
    """What a file does not say of its markers."""

    family: Family | None = None  # None: as the file says, or the usual one
    size: float | None = None  # m
    map_frame: str = "map"
    part: str = ""  # name of the bundle to take


def _read_wpilib(file: Entry, family: Family, unsaid: Unsaid) -> list[Marker]:
    if unsaid.size is None:
        raise MarkerMapError(
            "a field of WPILib does not say how large its tags are: give --size (m; 0.1651 of FRC)"
        )
    markers = []
    for tag in file.entries("tags", "tag"):
        number = _identifier(tag, "ID")
        pose = _below(tag, "pose", ": pose")
        place = _vector(_below(pose, "translation"), "xyz")
        x, y, z, w = _vector(_below(_below(pose, "rotation"), "quaternion"), "XYZW")
        with tag.named():
            rotation = rotation_of_quaternion([x, y, z, w]) @ _TAG_FROM_PRINT
            markers.append(Marker.at(family.name, number, unsaid.size, Pose(place, rotation)))
    return markers


def _write_wpilib(marker_map: MarkerMap, family: str) -> str:
    """The field is as large as its tags need, from the origin on."""
    tags, markers = [], marker_map.markers
    sizes = sorted({rounded([marker.size])[0] for marker in markers})
    if sizes and sizes[-1] > sizes[0] * (1.0 + _SAME_SIZE):
        raise MarkerMapError(
            f"a field of WPILib holds tags of one size, found {sizes[0]:g} to {sizes[-1]:g} m"
        )
    for marker in markers:
        pose = marker.pose
        x, y, z, w = _quaternion(pose.rotation @ _TAG_FROM_PRINT.T)
        turn = {"quaternion": {"W": w, "X": x, "Y": y, "Z": z}}
        tags.append(
            {"ID": marker.id, "pose": {"translation": _xyz(pose.position), "rotation": turn}}
        )
    length, width = np.maximum(marker_map.points.max(axis=0), 0.0)[:2]
    field = {"length": round(float(length), 6), "width": round(float(width), 6)}
    return json.dumps({_TAG_FAMILY: family, "tags": tags, "field": field}, indent=1) + "\n"


def _read_apriltag_ros(file: Entry, family: Family, unsaid: Unsaid) -> list[Marker]:
    bundles = {
        str(bundle.take("name", (str, int), f"{index}")): bundle
        for index, bundle in enumerate(file.entries("tag_bundles", "bundle"))
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
    markers = []
    for tag in chosen.entries("layout", "tag"):
        number, size = _identifier(tag, "id"), tag.number("size")
        place = _vector(tag, "xyz")
        turn = [float(tag.take(f"q{name}", _NUMBER, float(name == "w"))) for name in "xyzw"]
        with tag.named():
            pose = Pose(place, rotation_of_quaternion(turn))
            markers.append(Marker.at(family.name, number, size, pose))
    return markers


def _write_apriltag_ros(marker_map: MarkerMap, family: str) -> str:
    """One bundle."""
    layout = []
    for marker in marker_map.markers:
        tag: dict[str, Any] = {"id": marker.id, "size": rounded([marker.size])[0]}
        tag |= _xyz(marker.pose.position)
        quaternion = _quaternion(marker.pose.rotation)
        layout.append(tag | dict(zip(("qx", "qy", "qz", "qw"), quaternion, strict=True)))
    bundle = {"name": marker_map.map_frame, "layout": layout}
    return _yaml({_TAG_FAMILY: family, "standalone_tags": [], "tag_bundles": [bundle]})


OWN = "rs_localizer"
# By its keys a file is recognized; its reader, its writer, and what messages call it.
_KEYS = {
    OWN: ("markers", "boards", "target_type"), "wpilib": ("tags",),
    "apriltag_ros": ("tag_bundles", "standalone_tags"),
}  # fmt: skip
_FOREIGN = {
    "wpilib": (_read_wpilib, _write_wpilib, "a field of WPILib"),
    "apriltag_ros": (_read_apriltag_ros, _write_apriltag_ros, "apriltag_ros"),
}
FORMATS = (OWN, *_FOREIGN)
SUFFIXES = (".yaml", ".yml", ".json")


def is_marker_file(path: Path) -> bool:
    """Whether a file is one of markers, by its name."""
    return path.suffix.lower() in SUFFIXES


def read_any(path: Path, unsaid: Unsaid | None = None) -> tuple[MarkerMap, str]:
    """A marker map of any format, and the name of the format.

    Raises:
        MarkerMapError: for anything that cannot be used, saying where and what was found.
    """
    tree, unsaid = _tree(path), unsaid or Unsaid()
    name = next((name for name, keys in _KEYS.items() if any(key in tree for key in keys)), None)
    if name is None:
        keys = ", ".join(map(str, tree)) or "nothing"
        raise MarkerMapError(
            f"{path} is not a marker map of a known format ({', '.join(FORMATS)}): it has {keys}"
        )
    if name == OWN:
        return read_marker_map(path), OWN
    try:
        file = Entry(tree, "the field" if name == "wpilib" else "the file")
        said = unsaid.family or family(file.take(_TAG_FAMILY, str, USUAL_FAMILY.name))
        markers = _FOREIGN[name][0](file, said, unsaid)
        return MarkerMap(tuple(markers), map_frame=unsaid.map_frame), name
    except ValueError as error:
        raise MarkerMapError(f"{path} ({name}): {error}") from error


def write_any(path: Path, marker_map: MarkerMap, name: str) -> None:
    """Write a marker map in one of :data:`FORMATS`.

    Raises:
        MarkerMapError: when the format cannot hold the map.
    """
    if name == OWN:
        write_marker_map(path, marker_map)
        return
    _, write, what = _FOREIGN[name]
    if marker_map.boards:
        raise MarkerMapError(f"{what} cannot hold boards: {marker_map.boards[0].name}")
    kinds = sorted({marker.family.kind for marker in marker_map.markers})
    if len(kinds) > 1:
        raise MarkerMapError(f"{what} holds markers of one family, found {' and '.join(kinds)}")
    largest = max((marker.family for marker in marker_map.markers), key=lambda of: of.count)
    # AprilTag's own names, where there is one.
    text = write(marker_map, re.sub(r"^apriltag_", "tag", largest.name))
    path.write_text(text, encoding="utf-8")


def _tree(path: Path) -> dict[Any, Any]:
    kind = "JSON" if path.suffix.lower() == ".json" else "YAML"
    with file_faults(path, MarkerMapError, kind):
        text = path.read_text(encoding="utf-8")
        try:
            tree = json.loads(text) if kind == "JSON" else load_yaml(text)
        except (RecursionError, ValueError) as error:
            raise YamlError(str(error)) from error
        check_tree(tree)
    if not isinstance(tree, dict):
        raise MarkerMapError(f"{path} must hold a mapping, found {str(tree)[:60]!r}")
    return tree


def _below(entry: Entry, name: str, where: str = "") -> Entry:
    return Entry(entry.take(name, dict), f"{entry.where}{where}")


def _identifier(entry: Entry, name: str) -> int:
    """The id of a tag, which tells errors where they are."""
    number: int = entry.take(name, int)
    entry.where += f" (id {number})"
    return number


def _vector(entry: Entry, names: str) -> Array:
    """Numbers under keys of one letter each; what is missing is 0."""
    return np.array([float(entry.take(name, _NUMBER, 0.0)) for name in names])


def _quaternion(rotation: Array) -> list[float]:
    """x y z w."""
    return rounded(quaternion_of_rotation(rotation))


def _xyz(values: Array) -> dict[str, float]:
    return dict(zip("xyz", rounded(values), strict=True))


def _yaml(tree: dict[str, Any]) -> str:
    return str(yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=160))
