# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map``: what it says and writes."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from rs_localizer.cli.commands import main
from rs_localizer.io.maps.files import read_map_file, write_npz
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.markers.map_files import read_marker_map, write_marker_map
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.markers.prints import Pose

COLMAP = Path(__file__).parents[1] / "io" / "maps" / "colmap"


def test_info(tmp_path, ran):
    points = np.array([[0.0, -1.0, 2.0], [1.0, 1.0, 3.5], [5.0, 0.0, 100.0]])
    path = tmp_path / "map.npz"
    write_npz(path, Map(points, np.array([7, -3, 5]), np.zeros((3, 32), np.uint8), "map"))
    lines = ran("map", "info", path).out.splitlines()
    assert lines[0] == str(path)
    told = dict(line.strip().split(maxsplit=1) for line in lines[1:])
    assert (told["landmarks"], told["first_id"], told["last_id"]) == ("3", "-3", "7")
    assert (told["descriptor_length"], told["descriptor_type"]) == ("32", "uint8")
    assert [told[f"x_{name}_m"] for name in ("min", "median", "max")] == ["0.000", "1.000", "5.000"]
    write_npz(path, Map(points, None, None, "map"))
    assert "_id" not in ran("map", "info", path).out


def test_a_model_of_colmap_becomes_a_file(tmp_path, ran):
    out = tmp_path / "map.npz"
    words = ["map", "align", str(COLMAP / "text"), str(out)]
    said = ran(*words).out
    assert f"written: {out}" in said
    assert read_map_file(out, "map").equals(read_map_file(COLMAP / "binary", "map"))
    result = json.loads(ran(*words, "--overwrite", "--json").out)["result"]
    assert result["landmarks"] == len(read_map_file(out, "map"))
    assert (result["descriptor_length"], result["descriptor_type"]) == (128, "float32")
    assert result["written_to"] == str(out)


@pytest.fixture
def marker_file(tmp_path) -> Path:
    path = tmp_path / "wall.yaml"
    markers = wall("apriltag_36h11", (3, 2), 0.16, 0.04, pose=Pose(np.array([1.0, 2.0, 0.5])))
    write_marker_map(path, MarkerMap(markers))
    return path


def test_markers_become_landmarks(tmp_path, marker_file):
    corners = tmp_path / "corners.npz"
    assert main(["map", "align", str(marker_file), str(corners)]) == 0
    landmarks = read_map_file(corners, "map")
    np.testing.assert_array_equal(landmarks.points, read_marker_map(marker_file).points)


def make(out: Path, *words: str) -> int:
    return main(["markers", "make", str(out), *words])


def test_make_and_check(tmp_path, capsys, ran):
    out = tmp_path / "wall.v2"
    assert make(out) == 0
    said = capsys.readouterr().out
    assert f"{out}.pdf: 1 page of a4; print at 100 %" in said
    assert (tmp_path / "wall.v2.pdf").read_bytes().startswith(b"%PDF")
    made = read_marker_map(tmp_path / "wall.v2.yaml")
    assert [marker.name for marker in made.markers] == [f"marker 4x4_50 {k}" for k in range(6)]
    said = ran("map", "info", f"{out}.yaml").out
    assert re.search(r"ids_4x4_50 +\[0, 1, 2, 3, 4, 5\]\n", said)
    assert make(out, "--size", "0.05", "--overwrite", "--json") == 0
    pages = {"pages": [f"{out}.pdf"], "map": f"{out}.yaml", "corners": 24}
    assert json.loads(capsys.readouterr().out)["result"] == pages
    assert read_marker_map(f"{out}.yaml").markers[0].size == pytest.approx(0.05)
