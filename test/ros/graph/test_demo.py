# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The demo as a user starts it, with a few frames; and what Ctrl-C and a node's death leave."""

import os
import re
import signal
import subprocess
import sys
import time

import cv2
import PIL.Image
import pytest

from rs_localizer.ros.graph import live

DEMO = [sys.executable, "-m", "rs_localizer", "demo", "--quick"]


def medians(text: str, label: str) -> list[float]:
    """Of each table that has this row."""
    lines = [line for line in text.splitlines() if line.startswith(f"{label}, ")]
    return [float(line.removeprefix(label).split()[-4]) for line in lines]


def test_quick_demo(tmp_path):
    out = tmp_path / "out"
    demo = subprocess.run([*DEMO, "--out", str(out)], capture_output=True, text=True)
    assert demo.returncode == 0, demo.stderr
    # Global shutter may miss a frame or two; rolling shutter must not.
    counts = re.findall(r"^residual .*r6p_vcwt +(\d+) ", demo.stdout, re.MULTILINE)
    assert counts == ["12", "12", "22"]
    flight, _, webcam, of_p3p, cube, _ = medians(demo.stdout, "residual (px rms)")
    assert webcam < of_p3p < 0.2
    assert flight < 2.0
    assert cube < 0.5
    flight, of_p3p, cube, of_p3p_there = medians(demo.stdout, "position (m)")
    assert flight < 0.5 * of_p3p
    assert cube < 0.5 * of_p3p_there
    assert medians(demo.stdout, "angular velocity (deg/s)")[0] < 40.0
    said = re.search(r"cube's farthest corner is off by (\S+) px .* by (\S+) px", demo.stdout)
    assert said is not None
    assert float(said[1]) < 1.0 < float(said[2])
    with PIL.Image.open(out / "cube.gif") as animation:
        assert animation.n_frames == 12
    assert cv2.imread(str(out / "flight_errors.png")).std() > 5.0
    assert {file.name for file in out.iterdir()} == {"flight_errors.png", "cube.gif"}
    # Offline first, the node last: it says the same, bit for bit.
    assert demo.stdout.index("flight_errors.png") < demo.stdout.index("Starting a live node")
    assert "has answered 12 of 12 frames, 12 as above to the last bit" in demo.stdout
    # What it takes is said before, and what to do with an own camera at the end.
    first, *_, last = demo.stdout.strip().splitlines()
    assert re.match(r"about \d+ min; .* of memory, .* in .*out", first)
    assert "localizer --ros-args" in last


def children(pid: int) -> list[int]:
    found = subprocess.run(["ps", "-o", "pid=", "--ppid", str(pid)], capture_output=True, text=True)
    return [int(word) for word in found.stdout.split()]


def test_a_signal_leaves_no_process_behind(tmp_path):
    with (tmp_path / "log").open("w") as log:
        demo = subprocess.Popen(
            [*DEMO, "--out", str(tmp_path / "out")], stdout=log, stderr=log, start_new_session=True
        )
    while "Starting a live node" not in (tmp_path / "log").read_text():
        assert demo.poll() is None, (tmp_path / "log").read_text()
        time.sleep(0.02)
    while not (nodes := children(demo.pid)):
        time.sleep(0.02)
    demo.send_signal(signal.SIGINT)
    assert demo.wait() == 130
    assert (tmp_path / "log").read_text().endswith("rs_localizer demo: interrupted\n")
    for node in nodes:
        with pytest.raises(ProcessLookupError):
            os.kill(node, 0)


def test_a_node_that_dies_is_told_with_its_last_words(tmp_path):
    settings = {"solver": "r6p_vcwt", "readout_time": -1.0}
    with (
        pytest.raises(live.LiveError, match=r"(?s)ended with 1; the last lines .*readout_time"),
        live.LiveNode(settings, tmp_path / "log", 0) as node,
    ):
        node.wait(lambda line: None)
