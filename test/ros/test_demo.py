# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The demo as a user starts it, with a few frames."""

import re
import subprocess
import sys

import cv2

DEMO = [sys.executable, "-m", "rs_localizer", "demo", "--quick"]


def medians(text: str, label: str) -> list[float]:
    """Of each recording, ours and then P3P's where it has any."""
    lines = [line for line in text.splitlines() if f": {label} (" in line]
    return [float(word) for line in lines for word in line.rpartition(")")[2].split()]


def test_quick_demo(tmp_path):
    out = tmp_path / "out"
    demo = subprocess.run([*DEMO, "--all", "--out", str(out)], capture_output=True, text=True)
    assert demo.returncode == 0, demo.stderr
    # Global shutter may miss a frame or two; rolling shutter must not.
    assert medians(demo.stdout, "localized")[::2] == [100.0, 100.0, 100.0]
    flight, _, webcam, of_p3p, walls, _ = medians(demo.stdout, "residual")
    assert webcam < of_p3p < 0.2
    assert flight < 2.0
    assert walls < 0.5
    flight, of_p3p, walls, of_p3p_there = medians(demo.stdout, "position")
    assert flight < 0.5 * of_p3p
    assert walls < 0.5 * of_p3p_there
    assert medians(demo.stdout, "angular velocity")[0] < 40.0
    assert cv2.imread(str(out / "flight_errors.png")).std() > 5.0
    assert [file.name for file in out.iterdir()] == ["flight_errors.png"]
    assert "has answered 12 of 12 frames as above to the last bit" in demo.stdout
    assert re.match("next: .*markers make board --help", demo.stdout.splitlines()[-1])
