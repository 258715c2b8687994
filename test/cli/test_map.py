# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map``: what it says and writes."""

import json
from pathlib import Path

import numpy as np
import pytest

from rs_localizer.cli.main import main
from rs_localizer.io.maps.files import read_map_file, write_map_file
from rs_localizer.io.maps.landmarks import Map

COLMAP = Path(__file__).parents[1] / "io" / "maps" / "colmap"


def test_info(tmp_path, capsys):
    points = np.array([[0.0, -1.0, 2.0], [1.0, 1.0, 3.5], [5.0, 0.0, 100.0]])
    path = tmp_path / "map.npz"
    write_map_file(path, Map(points, np.array([7, -3, 5]), np.zeros((3, 32), np.uint8), "map"))
    assert main(["map", "info", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == str(path)
    assert dict(line.strip().split(maxsplit=1) for line in lines[1:4]) == {
        "landmarks": "3",
        "ids": "-3 to 7",
        "descriptors": "32 x uint8, compared by Hamming distance",
    }
    assert lines[4].split() == "x (m) 0.000 to 5.000, median 1.000".split()
    write_map_file(path, Map(points, None, None, "map"))
    assert main(["map", "info", str(path)]) == 0
    assert capsys.readouterr().out.count("none") == 2


@pytest.mark.parametrize("form", ["map.npz", "map.ply"])
def test_a_model_of_colmap_becomes_a_file(tmp_path, capsys, form):
    out = tmp_path / form
    words = ["map", "convert", str(COLMAP / "text"), str(out)]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert "128 x float32, compared by L2 distance" in said
    assert f"written to {out}" in said
    assert read_map_file(out, "map").equals(read_map_file(COLMAP / "binary", "map"))
    assert main(words) == 1
    assert "exists; choose another OUT, or --overwrite" in capsys.readouterr().err
    assert main([*words, "--overwrite", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)["result"]
    assert result["landmarks"] == str(len(read_map_file(out, "map")))
    assert result["written to"] == str(out)
