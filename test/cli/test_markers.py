# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Prints with their maps, and what is said of maps that cannot be right."""

import json
from pathlib import Path

import pytest

from rs_localizer.cli.main import main
from rs_localizer.markers.map_files import read_marker_map


def make(out: Path, *words: str) -> int:
    return main(["markers", "make", str(out), *words])


def test_make_and_check(tmp_path, capsys):
    out = tmp_path / "wall.v2"
    assert make(out) == 0
    said = capsys.readouterr().out
    assert f"{out}.pdf: 1 page of a4; print at 100 %" in said
    assert (tmp_path / "wall.v2.pdf").read_bytes().startswith(b"%PDF")
    made = read_marker_map(tmp_path / "wall.v2.yaml")
    assert [marker.name for marker in made.markers] == [f"marker 4x4_50 {k}" for k in range(6)]
    assert main(["markers", "check", f"{out}.yaml"]) == 0
    said = capsys.readouterr().out
    assert "6 markers and 0 boards of 4x4_50 in map; no problem found" in said
    # Nothing is overwritten.
    assert make(out, "--size", "0.05") == 1
    assert "exists already" in capsys.readouterr().err
    assert make(out, "--size", "0.05", "--overwrite", "--json") == 0
    pages = {"pages": [f"{out}.pdf"], "map": f"{out}.yaml", "corners": 24}
    assert json.loads(capsys.readouterr().out)["result"] == pages
    assert read_marker_map(f"{out}.yaml").markers[0].size == pytest.approx(0.05)


def test_problems_of_a_map_are_named(tmp_path, capsys):
    assert make(tmp_path / "wall", "--grid", "2x1", "--size", "0.05", "--gap", "0.03") == 0
    path = tmp_path / "wall.yaml"
    text = path.read_text()
    path.write_text(text.replace("[0.04, 0.0, 0.0]", "[0.0, 0.0, 0.0]"))
    capsys.readouterr()
    assert main(["markers", "check", str(path)]) == 1
    said = capsys.readouterr()
    assert said.out == "marker 4x4_50 0 and marker 4x4_50 1 overlap by 0.01 m\n"
    assert said.err == f"rs_localizer markers: {path} has a problem\n"
    path.write_text(text.replace("id: 1", "id: 0"))
    assert main(["markers", "check", str(path)]) == 1
    assert "marker 4x4_50 0 is there twice" in capsys.readouterr().err
