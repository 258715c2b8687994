# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The table of readout times."""

import json
import re
import runpy
from pathlib import Path

import pytest

from rs_localizer.cli.commands import main
from rs_localizer.readout import COMMON, find_readout, known_cameras


def test_every_row_of_the_table_makes_sense():
    for known in known_cameras():
        assert 0.0 < known.low <= known.median <= known.high < 0.2
        assert known.number >= (3 if known.source == "gyroflow" else 1)
        assert known.name
        assert known.mode


def test_of_common_cameras_the_command_that_measures_is_told(capsys):
    table = {entry.name.lower() for entry in known_cameras()}
    assert len(COMMON) == 10
    for name in COMMON:
        assert name.lower() not in table
        with pytest.raises(ValueError, match=f"of {name} .* rs_localizer calibrate VIDEO --board"):
            find_readout(name)
    assert main(["readout"]) == 0
    said = capsys.readouterr().out
    assert all(entry.name in said for entry in known_cameras())
    assert "Not known of Logitech C920" in said
    assert main(["readout", "nobody's camera"]) == 1
    assert "rs_localizer calibrate VIDEO --board 9x6" in capsys.readouterr().err


def test_a_camera_is_found_by_words_and_all_of_its_modes_are_told():
    modes = find_readout("raspberry IMX219")
    assert [known.mode for known in modes] == ["1640x1232", "1920x1080", "3280x2464"]
    (one,) = find_readout("imx219", "1920x1080")
    # The line time of the driver's own numbers.
    assert one.median == pytest.approx(1079 * 3448 / 182.4e6, rel=2e-3)
    for words, there_is in ((("Sonny a7sIII",), "Sony a7sIII"), (("imx219", "8x4"), "1640x1232")):
        with pytest.raises(ValueError, match=there_is):
            find_readout(*words)


def test_every_camera_has_a_page_and_the_json_the_whole_table(tmp_path):
    docs = Path(__file__).parents[1] / "docs"
    made = runpy.run_path(str(docs / "make_cameras.py"))
    made["write"](tmp_path)
    table = known_cameras()
    told = json.loads((tmp_path / made["JSON"]).read_text())
    times = {"median_s", "low_s", "high_s"}
    assert {*told[0]} == times | {"name", "mode", "number", "source", "upper_bound"}
    medians = {(row["name"], row["mode"]): row["median_s"] for row in told}
    assert medians == pytest.approx({(known.name, known.mode): known.median for known in table})
    index = (tmp_path / "index.md").read_text()
    pages = {path.stem: path.read_text() for path in tmp_path.glob("*.md")}
    assert set(re.findall(r"\((\S+)\.md\) \|", index)) == {*pages} - {"index"}
    for known in table:
        page = pages[re.sub(r"[^a-z0-9]+", "-", known.name.lower())]
        assert f"| {known.mode} | {1e3 * known.median:.2f}" in page
    for text in pages.values():  # every link leads somewhere, from docs/cameras
        for link in re.findall(r"\]\((?!http)([^)#]+)", text):
            place = docs / link[3:] if link.startswith("../") else tmp_path / link
            assert place.exists(), link
