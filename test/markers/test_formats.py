# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Marker maps of other programs: what their own files say, and there and back."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rs_localizer.core import so3
from rs_localizer.markers.families import FAMILIES
from rs_localizer.markers.map_files import FORMATS, OWN, Unsaid, read_any, write_any
from rs_localizer.markers.maps import MarkerMap, MarkerMapError
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.prints import Marker

SIZE = 0.16

# At x = 1, 2 m up: faces along -x, so that its viewer looks along +x and has y to the left.
FIELD = {
    "tags": [{
        "ID": 7,
        "pose": {"translation": {"x": 1.0, "y": 0.0, "z": 2.0},
                 "rotation": {"quaternion": {"W": 0.0, "X": 0.0, "Y": 0.0, "Z": 1.0}}},
    }],
    "field": {"length": 16.0, "width": 8.0},
}  # fmt: skip
BUNDLES = """
standalone_tags: []
tag_bundles:
  [
    {name: 'wall', layout: [
      {id: 0, size: 0.16, x: 0.0, y: 0.0, z: 0.0, qw: 1.0, qx: 0.0, qy: 0.0, qz: 0.0},
      {id: 3, size: 0.08, x: 0.5, qw: 0.7071068, qz: 0.7071068}]},
  ]
"""


def written(folder: Path, text: str, name: str = "map.yaml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def test_a_field_of_wpilib(tmp_path):
    path = written(tmp_path, json.dumps(FIELD), "field.json")
    found, kind = read_any(path, Unsaid(size=SIZE))
    (marker,) = found.markers
    assert (kind, marker.id, marker.family.name) == ("wpilib", 7, "apriltag_36h11")
    half = 0.5 * SIZE
    top_left, top_right = [1.0, half, 2.0 + half], [1.0, -half, 2.0 + half]
    np.testing.assert_allclose(marker.corners[:2], [top_left, top_right], atol=1e-12)
    with pytest.raises(MarkerMapError, match="does not say how large its tags are: give --size"):
        read_any(path)


def test_bundles_of_apriltag_ros(tmp_path):
    found, kind = read_any(written(tmp_path, BUNDLES))
    assert (kind, [marker.id for marker in found.markers]) == ("apriltag_ros", [0, 3])
    # x to the right, y up: turned by a quarter, up is to the left.
    np.testing.assert_allclose(found.markers[1].corners[0], [0.46, -0.04, 0.0], atol=1e-7)
    two = BUNDLES.replace("  ]\n", "    {name: floor, layout: []},\n  ]\n")
    with pytest.raises(MarkerMapError, match="2 bundles, each in a frame of its own"):
        read_any(written(tmp_path, two))
    assert len(read_any(written(tmp_path, two), Unsaid(part="wall"))[0].markers) == 2


def some_map(family: str = "apriltag_36h11") -> MarkerMap:
    rng = np.random.default_rng(0)
    markers = []
    for number in range(5):
        pose = Pose(rng.uniform(0.0, 3.0, 3), so3.exp(rng.normal(0.0, 1.0, 3)))
        markers.append(Marker.at(family, number, SIZE, pose))
    return MarkerMap(tuple(markers))


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("family", ["apriltag_25h9", "4x4_50"])
def test_there_and_back(tmp_path, name, family):
    path = tmp_path / ("map.json" if name == "wpilib" else "map.yaml")
    write_any(path, some_map(family), name)
    found, kind = read_any(path, Unsaid(size=SIZE))
    assert kind == name
    np.testing.assert_allclose(found.points, some_map(family).points, atol=1e-9)
    assert {marker.family.name for marker in found.markers} == {family}
    if name != OWN:  # what the user says goes first
        found, _ = read_any(path, Unsaid(FAMILIES["5x5_100"], SIZE))
        assert found.markers[0].family.name == "5x5_100"
        path.write_text(path.read_text().replace("tag25h9", "tag9h9").replace("4x4_50", "4x4_5"))
        with pytest.raises(MarkerMapError, match=r"unknown family '(tag9h9|4x4_5)'"):
            read_any(path, Unsaid(size=SIZE))


def test_deviations_of_a_survey_are_kept(tmp_path):
    known = np.array([0.001, 0.002, 0.0031, 0.01, 0.02, 0.03])
    marker = replace(some_map().markers[0], deviations=known)
    path = tmp_path / "map.yaml"
    write_any(path, MarkerMap((marker,)), OWN)
    (found,) = read_any(path)[0].markers
    np.testing.assert_allclose(found.deviations, known)
    broken = path.read_text().replace("rotation_deviation: [0.01", "rotation_deviation: [-0.01")
    with pytest.raises(MarkerMapError, match="deviations must not be negative"):
        read_any(written(tmp_path, broken))


FAR = json.dumps(FIELD).replace("7", "900")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "is not a YAML or JSON file"),
        ("[" * 90 + "]" * 90, "nests deeper than 50"),
        ('{"tags": [{"ID": 3}]}', r"tag 1 \(id 3\) has no pose"),
        (FAR, "has the ids 0 to 586, found 900"),
    ],
)
def test_broken_json(tmp_path, text, said):
    with pytest.raises(MarkerMapError, match=said):
        read_any(written(tmp_path, text, "a.json"), Unsaid(size=SIZE))
