# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""From photons to poses, offline: images rendered, markers detected, frames replayed; the truth."""

import numpy as np

from rs_localizer.cli.commands import main
from rs_localizer.io.trajectories import read_motions
from rs_localizer.tools.errors import errors_of
from rs_localizer.tools.simulation.simulated_recording import TRUE_POSE_TOPIC, TRUE_TWIST_TOPIC

# Two walls and the floor come by while the hand shakes the camera, at 60 deg/s and more.
FLIGHT = "--images --trajectory tum_vi_room5 --start 21 --duration 0.8 --exposure 0.002".split()


def test_poses_of_images_are_those_of_the_truth(tmp_path):
    images, markers = str(tmp_path / "images"), str(tmp_path / "markers")
    assert main(["simulate", images, *FLIGHT, "--noise", "2"]) == 0
    assert main(["detect", images, "--map", f"{images}/marker_map.yaml", "--out", markers]) == 0
    truth = read_motions(tmp_path / "images", TRUE_POSE_TOPIC, TRUE_TWIST_TOPIC)
    shutter = ["--params", f"{markers}/parameters.yaml", "-p", "pose_time:=mid_frame"]
    found = {}
    for solver in ("r6p_vcwt", "p3p"):
        out = tmp_path / solver
        assert (
            main(["replay", markers, *shutter, "-p", f"solver:={solver}", "--out", str(out)]) == 0
        )
        found[solver] = errors_of(read_motions(out), truth)["position"].values
    assert len(found["r6p_vcwt"]) == 24
    assert np.median(found["r6p_vcwt"]) < 0.02
    assert 3.0 * np.median(found["r6p_vcwt"]) < np.median(found["p3p"])
