# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The summary of many recordings."""

import csv
from pathlib import Path

from rs_localizer.offline.fleet.summary import CSV, DONE, FAILED, Row, write_summary


def test_no_cell_is_a_formula(tmp_path):
    rows = [
        Row(Path("=cmd|' /C calc'!A0"), "@sum", DONE, {"offset": -0.5, "why": "+1+1"}),
        Row(Path("b"), "-c", FAILED, {}, "=1+1"),
    ]
    write_summary(tmp_path, "replay", rows)
    _, first, second = csv.reader((tmp_path / CSV).read_text().splitlines())
    assert first == ["'=cmd|' /C calc'!A0", "'@sum", DONE, "-0.5", "'+1+1", ""]
    assert second == ["b", "'-c", FAILED, "", "", "'=1+1"]
