# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Files of marker maps: our own YAML (an example is in docs/maps.md) and files of other programs.

The content of a file decides its kind. Poses are of the print's frame: origin in its middle, x to
the right, y up, z towards the viewer. Corners go clockwise from the top left one, seen from the
front.

* Bundles of apriltag_ros (ROS 1), YAML: m; axes of a tag are those of a print
  (AprilRobotics/apriltag_ros #156); what is missing of a pose is that of the origin.
* AprilGrids of Kalibr, YAML: in their frame, the lower left corner of tag 0.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.core import so3
from rs_localizer.io.reading import dump_yaml, file_faults, load_yaml, read_text
from rs_localizer.markers import prints
from rs_localizer.markers.families import FAMILIES, family
from rs_localizer.markers.maps import MarkerMap, MarkerMapError

USUAL_FAMILY = FAMILIES["apriltag_36h11"]
"""Family of files of other programs that do not say it."""
OWN, _BUNDLES, _KALIBR = "rs_localizer", "apriltag_ros", "kalibr"
FORMATS = (OWN, _BUNDLES, _KALIBR)
"""Formats that are read; our own alone is written."""
SUFFIXES = (".yaml", ".yml", ".json")
# A parameter of apriltag_ros, which reads it beside the bundles.
_TAG_FAMILY = "tag_family"
# A pose stands for corners that it gives to within this share of a side; of a size that is given
# beside the corners.
_SAME, _SIZE_TOLERANCE = 1e-9, 0.05
_CHESSBOARD, _CHARUCO = _BOARDS = "chessboard", "charuco"


def is_marker_file(path: Path) -> bool:
    """Return True if the name is that of a file of markers."""
    return path.suffix.lower() in SUFFIXES


def read_marker_map(path: Path | str) -> MarkerMap:
    """Read a map file of any format.

    Raises:
        MarkerMapError: for anything that cannot be used, saying where and what was found.
    """
    return read_any(Path(path))[0]


def read_any(path: Path) -> tuple[MarkerMap, str]:
    """Read a marker map of any format; return it with the name of the format."""
    with file_faults(path, MarkerMapError, "YAML or JSON"):
        tree = load_yaml(read_text(path))
    try:
        file = _Entry(tree, "the map")
        if any(key in file for key in ("markers", "boards", "map_frame")):
            markers = [_marker(item) for item in file.entries("markers", "marker")]
            boards = [_board(item) for item in file.entries("boards", "board")]
            frame = file.value("map_frame", str)
            file.finish()
            return MarkerMap(tuple(markers), tuple(boards), frame), OWN
        if "tag_bundles" in file or "standalone_tags" in file:
            kind = family(file.value(_TAG_FAMILY, str, USUAL_FAMILY.name))
            return MarkerMap(tuple(_bundle(file, kind.name))), _BUNDLES
        if "target_type" in file:
            return _aprilgrid(file), _KALIBR
        raise ValueError(f"its format is not known ({', '.join(FORMATS)}): it has {file.names}")
    except ValueError as error:
        raise MarkerMapError(f"{path}: {error}") from error


def _marker(entry: _Entry) -> prints.Marker:
    name, number = entry.value("family", str), entry.value("id", int)
    entry.where += f" ({name} {number})"
    with entry.named():
        known = [entry.value(f"{of}_deviation", list, None) for of in ("position", "rotation")]
        deviations = (
            None if known == [None, None] else prints.finite(known, (2, 3), "deviations").ravel()
        )
        corners = entry.value("corners", list, None)
        size = entry.value("size", _NUMBER, *(() if corners is None else (None,)))
        if corners is None:
            pose = _pose(entry)
            entry.finish()
            return replace(prints.Marker.at(name, number, size, pose), deviations=deviations)
        entry.finish()
        marker = prints.Marker(family(name), number, corners, deviations)
        if size is not None and abs(marker.size - size) > _SIZE_TOLERANCE * abs(size):
            raise ValueError(f"its corners are {marker.size:.4g} m apart, but size is {size:g}")
        return marker


def _board(entry: _Entry) -> prints.Board:
    kind = entry.value("type", str)
    entry.where += f" ({kind})"
    with entry.named():
        if kind not in _BOARDS:
            raise ValueError(f"type must be one of {', '.join(_BOARDS)}")
        counts = entry.value("columns", int), entry.value("rows", int)
        square = float(entry.value("square", _NUMBER))
        given = {
            "pose": _pose(entry),
            "shape": entry.value("shape", list, None),
            "deviation": entry.value("deviation", _NUMBER, None),
        }
        if kind == _CHARUCO:
            marker, name = float(entry.value("marker", _NUMBER)), entry.value("family", str)
            own = entry.value("first_id", int, 0), entry.value("legacy", bool, False)
            entry.finish()
            return prints.Charuco(*counts, square, marker, family(name), *own, **given)
        entry.finish()
        return prints.Chessboard(*counts, square, **given)


def _pose(entry: _Entry) -> prints.Pose:
    position, rotation = entry.value("position", list), entry.value("rotation", list, None)
    if rotation is None:
        return prints.Pose(position, prints.rotation_of_quaternion(entry.value("quaternion", list)))
    if "quaternion" in entry:
        raise ValueError("there are both a rotation and a quaternion")
    return prints.Pose(position, rotation)


def _aprilgrid(entry: _Entry) -> MarkerMap:
    if (kind := entry.value("target_type", str)) != "aprilgrid":
        raise ValueError(f"target_type must be aprilgrid, not {kind!r}; of a chessboard: --board")
    columns, rows = entry.value("tagCols", int), entry.value("tagRows", int)
    size, gap = entry.value("tagSize", _NUMBER), entry.value("tagSpacing", _NUMBER)
    name, pitch = FAMILIES["apriltag_36h11_border2"].name, size * (1.0 + gap)
    return MarkerMap(tuple(
        prints.Marker.at(name, k, size, prints.Pose(np.array([
            pitch * (k % columns) + 0.5 * size, pitch * (k // columns) + 0.5 * size, 0.0
        ])))
        for k in range(columns * rows)
    ))  # fmt: skip


def _bundle(file: _Entry, name: str) -> Iterator[prints.Marker]:
    bundles = {
        str(bundle.value("name", (str, int), f"{index}")): bundle
        for index, bundle in enumerate(file.entries("tag_bundles", "bundle"))
    }
    if not bundles:
        raise ValueError("it has no tag_bundles: standalone tags have no place")
    if len(bundles) > 1:
        raise ValueError(
            f"it has {len(bundles)} bundles, each in a frame of its own ({', '.join(bundles)}): "
            "leave one in the file"
        )
    (chosen,) = bundles.values()
    for tag in chosen.entries("layout", "tag"):
        number = tag.value("id", int)
        tag.where += f" (id {number})"
        size = float(tag.value("size", _NUMBER))
        x, y, z, qx, qy, qz = (
            float(tag.value(key, _NUMBER, 0.0)) for key in ("x", "y", "z", "qx", "qy", "qz")
        )
        turn = qx, qy, qz, float(tag.value("qw", _NUMBER, 1.0))
        with tag.named():
            pose = prints.Pose(np.array([x, y, z]), prints.rotation_of_quaternion(turn))
            yield prints.Marker.at(name, number, size, pose)


_EXPLANATION = """\
# Where prints are, in the frame map_frame; all lengths in metres (docs/maps.md).
#   size, square: sides of the black square of a marker, and of the squares of a board
#   position: middle of the print, x y z in map_frame
#   quaternion: x y z w, turns a print's axes into those of the map: x to the right, y up, z out of
#     the paper towards the viewer. [0.7071, 0, 0, 0.7071]: upright in a map whose z is up and whose
#     y points into the wall
#   corners: instead of these three: top left, top right, bottom right, bottom left, from the front
# Measure what was put up, write it here, and check it: rs_localizer map info FILE
"""


def write_marker_map(path: Path | str, marker_map: MarkerMap) -> None:
    """Write a map file of our own."""
    tree: dict[str, Any] = {"map_frame": marker_map.map_frame}
    if marker_map.markers:
        tree["markers"] = [_marker_entry(marker) for marker in marker_map.markers]
    if marker_map.boards:
        tree["boards"] = [_board_entry(board) for board in marker_map.boards]
    Path(path).write_text(_EXPLANATION + dump_yaml(tree), encoding="utf-8")


def _marker_entry(marker: prints.Marker) -> dict[str, Any]:
    entry: dict[str, Any] = {"family": marker.family.name, "id": marker.id}
    square = prints.Marker.at(marker.family.name, marker.id, marker.size, marker.pose)
    if np.abs(square.corners - marker.corners).max() > _SAME * marker.size:
        entry["corners"] = [_rounded(row) for row in marker.corners]
    else:
        entry |= {"size": _rounded([marker.size])[0]} | _pose_entry(marker.pose)
    if marker.deviations is not None:
        digits = [float(f"{value:.3g}") for value in marker.deviations]  # no more are known
        entry |= {"position_deviation": digits[:3], "rotation_deviation": digits[3:]}
    return entry


def _board_entry(board: prints.Board) -> dict[str, Any]:
    entry: dict[str, Any] = {
        "type": _CHARUCO if isinstance(board, prints.Charuco) else _CHESSBOARD,
        "columns": board.columns, "rows": board.rows, "square": float(board.square),
    }  # fmt: skip
    if isinstance(board, prints.Charuco):
        entry |= {"marker": float(board.marker), "family": board.family.name}
        entry |= {"first_id": board.first_id, "legacy": board.legacy}
    entry |= _pose_entry(board.pose)
    if board.shape is not None:
        entry["shape"] = [_rounded(row) for row in np.round(board.shape, 7)]
    if board.deviation is not None:
        entry["deviation"] = float(f"{board.deviation:.3g}")
    return entry


def _pose_entry(pose: prints.Pose) -> dict[str, Any]:
    quaternion = so3.quaternion(np.ascontiguousarray(pose.rotation))
    return {"position": _rounded(pose.position), "quaternion": _rounded(quaternion)}


def _rounded(values: Iterable[float]) -> list[float]:
    """Round the errors of a fitted pose away: 0.16 instead of 0.16000000000000003."""
    return [round(float(value), 12) + 0.0 for value in values]


_NUMBER = (int, float)


class _EntryError(ValueError):
    """An error whose message names the entry of the file."""


class _Entry:
    """A mapping of the file whose keys are taken one after the other; the rest is unknown."""

    def __init__(self, tree: Any, where: str) -> None:
        self.where = where
        if not isinstance(tree, dict):
            raise _EntryError(f"{where} must be a mapping, found {str(tree)[:60]!r}")
        self._left = dict(tree)

    def __contains__(self, name: str) -> bool:
        return name in self._left

    @property
    def names(self) -> str:
        """The keys that have not been taken yet."""
        return ", ".join(map(str, self._left)) or "nothing else"

    def value(self, name: str, kind: type | tuple[type, ...], *default: Any) -> Any:
        if name not in self._left:
            if default:
                return default[0]
            raise _EntryError(f"{self.where} has no {name}; it has {self.names}")
        value = self._left.pop(name)
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise _EntryError(f"{self.where}: {name} cannot be {value!r}")
        return value

    def entries(self, name: str, one: str) -> list[_Entry]:
        listed = self.value(name, (list, type(None)), None) or []
        return [_Entry(item, f"{one} {index + 1}") for index, item in enumerate(listed)]

    def finish(self) -> None:
        if self._left:
            raise _EntryError(f"{self.where} has the unknown {self.names}")

    @contextlib.contextmanager
    def named(self) -> Iterator[None]:
        """Name this entry in the errors that are raised within the context."""
        try:
            yield
        except _EntryError:
            raise
        except ValueError as error:
            raise _EntryError(f"{self.where}: {error}") from error
