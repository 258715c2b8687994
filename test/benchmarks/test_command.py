# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks NAME``: what it writes and what it refuses."""

from pathlib import Path

import pytest

import benchmarks
from benchmarks.__main__ import main


def test_notes_verdicts_and_the_figure_of_the_docs(tmp_path, capsys):
    out = tmp_path / "new" / "folder"
    assert main(["translation", "motion", "--trials", "20", "--seed", "3", "--out", str(out)]) == 0
    printed, said = capsys.readouterr()
    assert printed.startswith("orientation (deg), motion:")
    assert printed.count("\nr6p_vcwt ") == 2
    assert "translation (" in said
    assert "ahead of all others" in said
    assert [path.name for path in out.iterdir()] == ["choosing_motion.png"]


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
