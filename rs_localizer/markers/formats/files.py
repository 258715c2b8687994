# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Files of marker maps of any format: which it is, by what it holds."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rs_localizer.io.yaml_text import YamlError, check_tree, load_yaml
from rs_localizer.markers.formats import apriltag_ros, tagslam, wpilib
from rs_localizer.markers.formats.common import Unsaid
from rs_localizer.markers.map_files import read_marker_map, write_marker_map
from rs_localizer.markers.maps import MarkerMap, MarkerMapError

OWN = "rs_localizer"
_FORMATS = {"wpilib": wpilib, "tagslam": tagslam, "apriltag_ros": apriltag_ros}
FORMATS = (OWN, *_FORMATS)
SUFFIXES = (".yaml", ".yml", ".json")
# By these keys they are told apart.
_KEYS = {
    OWN: ("markers", "boards"), "wpilib": ("tags",), "tagslam": ("bodies",),
    "apriltag_ros": ("tag_bundles", "standalone_tags"),
}  # fmt: skip


def is_marker_file(path: Path) -> bool:
    """Whether a file is one of markers, by its name."""
    return path.suffix.lower() in SUFFIXES


def read_any(path: Path, unsaid: Unsaid | None = None) -> tuple[MarkerMap, str]:
    """A marker map of any format, and the name of the format.

    Raises:
        MarkerMapError: for anything that cannot be used, saying where and what was found.
    """
    tree = _tree(path)
    found = next((name for name, keys in _KEYS.items() if any(key in tree for key in keys)), None)
    if found is None:
        keys = ", ".join(map(str, tree)) or "nothing"
        raise MarkerMapError(
            f"{path} is not a marker map of a known format ({', '.join(FORMATS)}): it has {keys}"
        )
    if found == OWN:
        return read_marker_map(path), OWN
    try:
        return _FORMATS[found].read(tree, unsaid or Unsaid()), found
    except ValueError as error:
        raise MarkerMapError(f"{path} ({found}): {error}") from error


def write_any(path: Path, marker_map: MarkerMap, name: str) -> None:
    """Write a marker map in one of :data:`FORMATS`.

    Raises:
        MarkerMapError: when the format cannot hold the map.
    """
    if name == OWN:
        write_marker_map(path, marker_map)
    else:
        path.write_text(_FORMATS[name].write(marker_map), encoding="utf-8")


def _tree(path: Path) -> dict[Any, Any]:
    kind = "JSON" if path.suffix.lower() == ".json" else "YAML"
    try:
        text = path.read_text(encoding="utf-8")
        tree = json.loads(text) if kind == "JSON" else load_yaml(text)
        check_tree(tree)
    except OSError as error:
        raise MarkerMapError(f"{path} cannot be read: {error.strerror}") from error
    except (YamlError, UnicodeDecodeError, RecursionError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise MarkerMapError(f"{path} is not a {kind} file: {reason}") from error
    if not isinstance(tree, dict):
        raise MarkerMapError(f"{path} must hold a mapping, found {str(tree)[:60]!r}")
    return tree
