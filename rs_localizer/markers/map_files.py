# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Files of marker maps, in YAML; an example of all that they may hold is in docs/maps.md.

A pose is that of the print's frame: origin in its middle, x to the right, y up, z toward the
viewer (the identity is a print that lies on the floor of a map whose z points up). Corners go from
the top left one clockwise, as seen from the front.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rs_localizer.core.arrays import Array
from rs_localizer.io.yaml_text import file_faults, load_yaml
from rs_localizer.markers.families import FAMILIES, family
from rs_localizer.markers.maps import MarkerMap, MarkerMapError
from rs_localizer.markers.poses import Pose, finite, quaternion_of_rotation
from rs_localizer.markers.poses import rotation_of_quaternion as _rotation
from rs_localizer.markers.prints import Board, Charuco, Chessboard, CircleGrid, Marker

# A pose stands for corners that it gives to within this share of a side.
_SAME = 1e-9
# Of a size that is given beside the corners.
_SIZE_TOLERANCE = 0.05


_CHESSBOARD, _CIRCLES, _ASYMMETRIC, _CHARUCO = _BOARDS = (
    "chessboard",
    "circles",
    "asymmetric_circles",
    "charuco",
)


def read_marker_map(path: Path | str) -> MarkerMap:
    """Read a map file.

    Raises:
        MarkerMapError: for anything that cannot be used, saying where and what was found.
    """
    path = Path(path)
    with file_faults(path, MarkerMapError):
        tree = load_yaml(path.read_text(encoding="utf-8"))
    try:
        return _map(tree)
    except ValueError as error:
        raise MarkerMapError(f"{path}: {error}") from error


def _map(tree: Any) -> MarkerMap:
    entry = Entry(tree, "the map")
    if _KALIBR in entry:
        return _kalibr_target(entry)
    markers = [_marker(item) for item in entry.entries("markers", "marker")]
    boards = [_board(item) for item in entry.entries("boards", "board")]
    frame = entry.take("map_frame", str)
    entry.finish()
    return MarkerMap(tuple(markers), tuple(boards), frame)


_KALIBR = "target_type"


def _kalibr_target(entry: Entry) -> MarkerMap:
    """A target file of Kalibr; of an AprilGrid in its frame, the lower left corner of tag 0."""
    kind = entry.take(_KALIBR, str)
    if kind == "aprilgrid":
        columns, rows = entry.take("tagCols", int), entry.take("tagRows", int)
        size, gap = entry.number("tagSize"), entry.number("tagSpacing")
        name = FAMILIES["apriltag_36h11_border2"].name
        places = [
            (c * (1.0 + gap) + 0.5, r * (1.0 + gap) + 0.5)
            for r in range(rows)
            for c in range(columns)
        ]
        with entry.named():
            return MarkerMap(tuple(
                Marker.at(name, k, size, Pose(np.array([size * x, size * y, 0.0])))
                for k, (x, y) in enumerate(places)
            ))  # fmt: skip
    if kind not in ("checkerboard", "circlegrid"):
        raise EntryError(f"target_type must be aprilgrid, checkerboard or circlegrid, not {kind!r}")
    columns, rows = entry.take("targetCols", int), entry.take("targetRows", int)
    with entry.named():
        if kind == "circlegrid":
            asymmetric = entry.take("asymmetricGrid", bool, False)
            spacing = entry.number("spacingMeters")
            return MarkerMap(boards=(CircleGrid(columns, rows, spacing, asymmetric),))
        square, other = entry.number("rowSpacingMeters"), entry.number("colSpacingMeters")
        if square != other:
            raise ValueError(f"squares must be as high as wide, found {square:g} and {other:g} m")
        return MarkerMap(boards=(Chessboard(columns, rows, square),))


def _marker(entry: Entry) -> Marker:
    name, number = entry.take("family", str), entry.take("id", int)
    entry.where += f" ({name} {number})"
    deviations = _deviations(entry)
    if "corners" not in entry:
        size, pose = entry.number("size"), _pose(entry)
        entry.finish()
        with entry.named():
            return replace(Marker.at(name, number, size, pose), deviations=deviations)
    corners = entry.take("corners", list)
    stated = entry.number("size") if "size" in entry else None
    entry.finish()
    with entry.named():
        marker = Marker(family(name), number, corners, deviations)
        if stated is not None and abs(marker.size - stated) > _SIZE_TOLERANCE * abs(stated):
            raise ValueError(f"its corners are {marker.size:.4g} m apart, but size is {stated:g}")
        return marker


def _deviations(entry: Entry) -> Array | None:
    """Of a surveyed marker: place (m) and turn (rad)."""
    if "position_deviation" not in entry and "rotation_deviation" not in entry:
        return None
    with entry.named():
        return np.concatenate([
            finite(entry.take(name, list), (3,), name)
            for name in ("position_deviation", "rotation_deviation")
        ])  # fmt: skip


def _board(entry: Entry) -> Board:
    kind = entry.take("type", str)
    entry.where += f" ({kind})"
    if kind not in _BOARDS:
        raise EntryError(f"{entry.where}: type must be one of {', '.join(_BOARDS)}")
    counts = entry.take("columns", int), entry.take("rows", int)
    spacing = entry.number("spacing" if "circles" in kind else "square")
    given: dict[str, Any] = {"pose": _pose(entry)}
    if "shape" in entry:
        given["shape"] = entry.take("shape", list)
    if "deviation" in entry:
        given["deviation"] = entry.number("deviation")
    if kind == _CHARUCO:
        marker, name = entry.number("marker"), entry.take("family", str)
        given["first_id"] = entry.take("first_id", int, 0)
        given["legacy"] = entry.take("legacy", bool, False)
    else:
        given["inverted"] = entry.take("inverted", bool, False)
    entry.finish()
    with entry.named():
        if kind == _CHARUCO:
            return Charuco(*counts, spacing, marker, family(name), **given)
        if kind == _CHESSBOARD:
            return Chessboard(*counts, spacing, **given)
        return CircleGrid(*counts, spacing, kind == _ASYMMETRIC, **given)


def _pose(entry: Entry) -> Pose:
    position = entry.take("position", list)
    with entry.named():
        if "rotation" not in entry:
            return Pose(position, _rotation(entry.take("quaternion", list)))
        if "quaternion" in entry:
            raise ValueError("there are both a rotation and a quaternion")
        return Pose(position, entry.take("rotation", list))


_EXPLANATION = """\
# Where prints are, in the frame map_frame; all lengths in metres.
#   size: side of the black square of a marker, without the white rim around it
#   square, spacing: of a board: side of its squares; from row to row of its circles
#   position: of the middle of the print, x y z in map_frame
#   quaternion: x y z w (not w x y z), of length 1; turns the print's axes into those of the map.
#     Axes of a print: x to the right, y up, z out of the paper toward who looks at it.
#     [0, 0, 0, 1]: the same axes as the map. [0.7071, 0, 0, 0.7071]: upright in a map whose z is up
#     and whose y points into the wall.
#   shape: of a board: how far from flat each of its points is, x y z along its axes, as calibrate
#     finds it
#   deviation: of a board: how well its points are known, m; not given: as those of paper
#   corners: instead of these three: top left, top right, bottom right, bottom left, from the front
#   position_deviation, rotation_deviation: standard deviations of a survey along the axes of
#     map_frame, m and rad
# Measure what was put up, write it here, and check it: rs_localizer map info FILE;
# rs_localizer detect names a marker that is not where this file has it.
"""


def write_marker_map(path: Path | str, marker_map: MarkerMap) -> None:
    """Write a map file that :func:`read_marker_map` reads."""
    tree: dict[str, Any] = {"map_frame": marker_map.map_frame}
    if marker_map.markers:
        tree["markers"] = [_marker_entry(marker) for marker in marker_map.markers]
    if marker_map.boards:
        tree["boards"] = [_board_entry(board) for board in marker_map.boards]
    text = yaml.safe_dump(tree, sort_keys=False, default_flow_style=None, width=100)
    Path(path).write_text(f"{_EXPLANATION}{text}", encoding="utf-8")


def _marker_entry(marker: Marker) -> dict[str, Any]:
    entry: dict[str, Any] = {"family": marker.family.name, "id": marker.id}
    deviations: dict[str, Any] = {}
    if marker.deviations is not None:
        deviations["position_deviation"] = _significant(marker.deviations[:3])
        deviations["rotation_deviation"] = _significant(marker.deviations[3:])
    square = Marker.at(marker.family.name, marker.id, marker.size, marker.pose)
    if np.abs(square.corners - marker.corners).max() > _SAME * marker.size:
        return entry | {"corners": [rounded(row) for row in marker.corners]} | deviations
    return entry | {"size": rounded([marker.size])[0]} | _pose_entry(marker.pose) | deviations


def _board_entry(board: Board) -> dict[str, Any]:
    if isinstance(board, Charuco):
        kind, own = _CHARUCO, {
            "square": float(board.square),
            "marker": float(board.marker),
            "family": board.family.name,
            "first_id": board.first_id,
            "legacy": board.legacy,
        }  # fmt: skip
    elif isinstance(board, Chessboard):
        kind, own = _CHESSBOARD, {"square": float(board.square)}
    else:
        kind = _ASYMMETRIC if board.asymmetric else _CIRCLES
        own = {"spacing": float(board.spacing)}
    entry: dict[str, Any] = {"type": kind, "columns": board.columns, "rows": board.rows}
    entry |= own | _pose_entry(board.pose)
    if not isinstance(board, Charuco) and board.inverted:
        entry["inverted"] = True
    if board.shape is not None:
        entry["shape"] = [rounded(row) for row in np.round(board.shape, 7)]
    if board.deviation is not None:
        entry["deviation"] = float(f"{board.deviation:.3g}")
    return entry


def _pose_entry(pose: Pose) -> dict[str, Any]:
    quaternion = quaternion_of_rotation(pose.rotation)
    return {"position": rounded(pose.position), "quaternion": rounded(quaternion)}


def rounded(values: Iterable[float]) -> list[float]:
    """Without the rounding errors of a fitted pose: 0.16 and not 0.16000000000000003."""
    return [round(float(value), 12) + 0.0 for value in values]


def _significant(values: Array) -> list[float]:
    """Three digits: more are not known of a deviation."""
    return [float(f"{value:.3g}") for value in values]


class EntryError(ValueError):
    """Says already which entry it is about."""


class Entry:
    """A mapping of the file whose keys are taken one after the other; the rest is unknown."""

    def __init__(self, tree: Any, where: str) -> None:
        self.where = where
        if not isinstance(tree, dict):
            raise EntryError(f"{where} must be a mapping, found {tree!r}")
        self._left = dict(tree)

    def __contains__(self, name: str) -> bool:
        return name in self._left

    def names(self) -> list[str]:
        """The keys that are left."""
        return [str(name) for name in self._left]

    def take(self, name: str, kind: type | tuple[type, ...], *default: Any) -> Any:
        if name not in self._left and default:
            return default[0]
        if name not in self._left:
            names = ", ".join(map(str, self._left)) or "nothing else"
            raise EntryError(f"{self.where} has no {name}; it has {names}")
        value = self._left.pop(name)
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise EntryError(f"{self.where}: {name} cannot be {value!r}")
        return value

    def number(self, name: str) -> float:
        return float(self.take(name, (int, float)))

    def entries(self, name: str, one: str) -> list[Entry]:
        listed = self.take(name, (list, type(None)), None) or []
        return [Entry(item, f"{one} {index + 1}") for index, item in enumerate(listed)]

    def finish(self) -> None:
        if self._left:
            raise EntryError(f"{self.where} has the unknown {', '.join(map(str, self._left))}")

    @contextlib.contextmanager
    def named(self) -> Iterator[None]:
        """Faults within are about this entry."""
        try:
            yield
        except EntryError:
            raise
        except ValueError as error:
            raise EntryError(f"{self.where}: {error}") from error
