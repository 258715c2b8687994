# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The demo as a user starts it, with a few frames; and Ctrl-C."""

import re
import signal
import subprocess
import sys
import time

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


def test_a_signal_ends_it_in_a_line(tmp_path):
    with (tmp_path / "log").open("w") as log:
        demo = subprocess.Popen(
            [*DEMO, "--all", "--out", str(tmp_path / "out")],
            stdout=log, stderr=log, start_new_session=True,
        )  # fmt: skip
    while "Walls of markers, 12 frames: linear velocity" not in (tmp_path / "log").read_text():
        assert demo.poll() is None, (tmp_path / "log").read_text()
        time.sleep(0.02)
    demo.send_signal(signal.SIGINT)
    assert demo.wait() == 130
    assert (tmp_path / "log").read_text().endswith("rs_localizer demo: interrupted\n")
