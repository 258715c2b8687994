# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map`` on maps of markers, and the maps that it makes."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rs_localizer.cli.main import main
from rs_localizer.io.maps.files import read_map_file, write_map_file
from rs_localizer.markers.formats import read_any
from rs_localizer.markers.map_files import read_marker_map, write_marker_map
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.markers.poses import Pose


def refused(words: list[str], code: int, said: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The command ends with a code and a sentence, without a traceback."""
    assert main(["map", *words]) == code
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error


@pytest.fixture
def marker_file(tmp_path) -> Path:
    path = tmp_path / "wall.yaml"
    markers = wall("apriltag_36h11", (3, 2), 0.16, 0.04, pose=Pose(np.array([1.0, 2.0, 0.5])))
    write_marker_map(path, MarkerMap(markers))
    return path


def test_info_and_convert(tmp_path, marker_file, capsys):
    assert main(["map", "info", str(marker_file)]) == 0
    said = capsys.readouterr().out
    assert "markers of apriltag_36h11" in said
    assert "6, ids 0 to 5" in said
    field, back = tmp_path / "field.json", tmp_path / "back.yaml"
    assert main(["map", "convert", str(marker_file), str(field)]) == 0
    assert len(json.loads(field.read_text())["tags"]) == 6
    refused(["convert", str(field), str(back)], 1, "give --size", capsys)
    assert not back.exists()
    words = ["convert", str(field), str(back), "--size", "0.16", "--to", "apriltag_ros"]
    assert main(["map", *words]) == 0
    found, kind = read_any(back)
    assert kind == "apriltag_ros"
    np.testing.assert_allclose(found.points, read_marker_map(marker_file).points, atol=1e-9)
    corners = tmp_path / "corners.npz"
    assert main(["map", "convert", str(marker_file), str(corners)]) == 0
    landmarks = read_map_file(corners, "map")
    np.testing.assert_array_equal(landmarks.points, read_marker_map(marker_file).points)


def test_refine_and_survey_what_was_simulated(tmp_path, capsys):
    flight, out = tmp_path / "flight", tmp_path / "refined.npz"
    simulated = ["simulate", str(flight), "--duration", "1.5", "--keypoints", "--points", "120"]
    assert main([*simulated, "--trajectory", "tum_vi_room5", "--noise", "0.3"]) == 0
    true = read_map_file(flight / "map.npz", "map")
    off = np.random.default_rng(0).normal(0.0, 0.02, true.points.shape)
    write_map_file(tmp_path / "off.npz", replace(true, points=true.points + off))
    capsys.readouterr()
    words = [
        "refine", str(flight), "--params", str(flight / "parameters.yaml"),
        "--map", str(tmp_path / "off.npz"), "--out", str(out), "-p", "map_deviation:=0.02",
    ]  # fmt: skip
    assert main(["map", *words]) == 0
    said = capsys.readouterr().out
    assert "noise after" in said
    found = read_map_file(out, "map")
    assert found.covariances is not None
    known = np.isfinite(found.covariances[:, 0, 0])
    errors = np.linalg.norm(found.points - true.points, axis=1)[known]
    assert np.median(errors) < 0.7 * np.median(np.linalg.norm(off, axis=1)[known])
    assert found.descriptors is not None
    assert main(["map", "info", str(out)]) == 0
    assert "deviations known" in capsys.readouterr().out
    refused(words, 1, "exists; choose another OUT", capsys)
    again = [*words, "--overwrite"]
    refused([*again, "--hold", "1", "2", "999999"], 2, "no landmark 999999", capsys)
    refused([*again, "-p", "readout_time:=0.0", "--shutter", "given"], 2, "needs -p", capsys)
    refused(["refine", str(tmp_path), "--out", "a.obj"], 2, "--out must end in", capsys)
