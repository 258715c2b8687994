# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks NAME``: what it writes and what it refuses."""

import csv
from pathlib import Path

import pytest

import benchmarks
from benchmarks.__main__ import main


def test_tables_and_summary(tmp_path, capsys):
    out = tmp_path / "new" / "folder"
    words = ["translation", "--trials", "20", "--seed", "3", "--out", str(out)]
    assert main(words) == 0
    printed, said = capsys.readouterr()
    assert printed.startswith("orientation (deg), motion:")
    assert "translation (" in said
    assert str(out / "summary.md") in said
    assert {path.name for path in out.iterdir()} == {"translation.csv", "summary.md"}
    with (out / "translation.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["method"] for row in rows} >= {"p3p", "r6p_vcwt", "r9p", "refined"}
    assert len({row["per_frame"] for row in rows}) == 11
    text = (out / "summary.md").read_text()
    assert "20 trials, seed 3" in text
    assert "ahead of all others" in text
    assert "(translation.csv)" in text


def test_the_help_names_every_tool_and_none_besides(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    table = capsys.readouterr().out.split("as python -m benchmarks.NAME:\n")[1]
    named = {name for line in table.splitlines() for name in line[2:33].strip().split(", ")} - {""}
    folder = Path(benchmarks.__file__).parent
    programs = {
        ".".join(path.relative_to(folder).with_suffix("").parts).removesuffix(".__main__")
        for path in folder.rglob("*.py")
        if 'if __name__ == "__main__"' in path.read_text()
    }
    assert named == programs - {"__main__", "load.camera"}  # the latter is started by load
