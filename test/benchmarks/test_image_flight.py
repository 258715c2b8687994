# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images of a quick hand into both nodes: the same poses and twists as offline, to the last bit."""

import re
import subprocess
import sys

import pytest

from benchmarks import image_flight
from rs_localizer.cli.main import main

FLIGHT = "--images --trajectory tum_vi_room5 --start 21.5 --duration 0.15 --exposure 0.002".split()


def run(*words: str) -> None:
    command = [sys.executable, "-m", "rs_localizer", *words]
    subprocess.run(command, check=True, capture_output=True)


@pytest.mark.bench
def test_nodes_and_replay_agree(tmp_path, capsys):
    images, markers, poses = (str(tmp_path / name) for name in ("images", "markers", "poses"))
    assert main(["simulate", images, *FLIGHT, "--grey-noise", "2"]) == 0
    # In processes of their own: what other tests have compiled in this one may round differently.
    run("detect", images, "--map", f"{images}/marker_map.yaml", "--out", markers)
    shutter = ["--params", f"{markers}/parameters.yaml", "-p", "pose_time:=mid_frame"]
    run("replay", markers, *shutter, "--out", poses)
    capsys.readouterr()
    assert image_flight.main([images, poses, "-p", "pose_time:=mid_frame"]) == 0
    assert capsys.readouterr().out == (
        "5 images\n"
        "/rs_localizer/pose: 5 live, 5 replayed, 5 identical\n"
        "/rs_localizer/twist: 5 live, 5 replayed, 5 identical\n"
    )
    assert image_flight.main([images, "--rate", "5"]) == 0
    assert re.match(r"[1-5] poses of 5 images at 5 Hz, from image", capsys.readouterr().out)
