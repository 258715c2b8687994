# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""From photons to poses, offline: images rendered, markers detected, frames replayed; the truth."""

from pathlib import Path

import numpy as np
import pytest

from benchmarks.marker_flight import load_flight, quality
from rs_localizer.cli.main import main

# Two walls and the floor come by while the hand shakes the camera.
FLIGHT = "--images --trajectory tum_vi_room5 --start 21 --duration 0.8 --exposure 0.002".split()


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """images, markers, ours and p3p: what the four commands write."""
    made = tmp_path_factory.mktemp("flight")
    images, markers = str(made / "images"), str(made / "markers")
    assert main(["simulate", images, *FLIGHT, "--grey-noise", "2"]) == 0
    assert main(["detect", images, "--map", f"{images}/marker_map.yaml", "--out", markers]) == 0
    shutter = ["--params", f"{markers}/parameters.yaml", "-p", "pose_time:=mid_frame"]
    for name, solver in (("ours", "r6p_vcwt"), ("p3p", "p3p")):
        solved = ["-p", f"solver:={solver}", "--out", str(made / name)]
        assert main(["replay", markers, *shutter, *solved]) == 0
    return made


def test_poses_of_images_are_those_of_the_truth(folder):
    flight = load_flight(folder / "images", folder / "markers")
    assert flight.frames == 24
    assert len(flight.middles_ns) == 24
    assert np.median(flight.speeds) > 60.0
    ours, p3p = (quality(flight, folder / name) for name in ("ours", "p3p"))
    assert ours.localized == 1.0
    assert ours.reprojection < 0.5 < p3p.reprojection
    assert 3.0 * ours.position_fast < p3p.position_fast
    assert ours.position_fast < 0.02
