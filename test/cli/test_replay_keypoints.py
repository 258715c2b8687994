# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Replay of keypoints: with a map in the recording and with a map file, and what is missing."""

import numpy as np
import recorded
from numpy.lib.recfunctions import repack_fields
from recorded import SHUTTER, record

from benchmarks.fuzzing import map_rows
from rs_localizer.cli.commands import main
from rs_localizer.io.bags import BagWriter, make_message
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.trajectories import read_motions, read_tum
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import FrameSettings
from rs_localizer.tools.simulation.simulated_recording import (
    keypoint_rows,
    random_descriptors,
    write_simulated,
)

FRAMES = 8
POINTS = room(np.zeros((1, 3)), np.random.default_rng(0), count=6000)
LANDMARKS = Map(
    POINTS, np.arange(6000) + 7, random_descriptors(6000, np.random.default_rng(1)), "map"
)


def test_a_recording_of_everything(tmp_path, capsys, ran):
    """By the id or by the points themselves: the frames since the map came are the same."""
    seen = FrameSettings(points=80, noise=0.5, outliers=0.2)
    with BagWriter(tmp_path / "all") as bag:
        for frame in recorded.flight(POINTS, FRAMES, seen, 10**9):
            write_simulated(bag, recorded.CAMERA, frame)
            rows = keypoint_rows(frame, LANDMARKS, np.random.default_rng(frame.stamp_ns))
            for topic, names in {
                "/cam/keypoints": ["u", "v", "descriptor"], "/ids": ["u", "v", "id"],
            }.items():  # fmt: skip
                message = make_cloud(
                    make_message, frame.stamp_ns, "camera", repack_fields(rows[names])
                )
                bag.write(topic, message, frame.stamp_ns)
            if frame.stamp_ns == 10**9 + 66_666_667:  # late: with the third frame
                message = make_cloud(make_message, 0, "map", map_rows(LANDMARKS))
                bag.write("/cam/map_points", message, frame.stamp_ns - 1)
    words = ["replay", str(tmp_path / "all"), *SHUTTER]
    assert "choose with -r correspondences:=TOPIC or -r keypoints:=TOPIC" in ran(*words, code=1).err
    found = {}
    for name, given in {
        "clouds": ["-r", "correspondences:=/correspondences"],
        "ids": ["-r", "keypoints:=/ids", "-r", "map_points:=/cam/map_points"],
        "descriptors": ["-r", "keypoints:=cam/keypoints"],
    }.items():
        assert main([*words, *given, "--out", str(tmp_path / name)]) == 0
        found[name] = read_tum(tmp_path / name / "poses.txt").positions
    assert "map_replaced" not in capsys.readouterr().out
    assert len(found["clouds"]) == FRAMES
    for name in ("ids", "descriptors"):
        np.testing.assert_allclose(found[name], found["clouds"][2:], atol=0.01)


def test_a_recording_beside_its_map(tmp_path, ran):
    flight, out = tmp_path / "flight", tmp_path / "poses"
    record(flight, "--keypoints", "--duration", "0.4", "--points", "200")
    words = ["--params", f"{flight}/parameters.yaml", "--map", f"{flight}/map.npz"]
    assert "and no map; give one with --map" in ran("replay", flight, *words[:2], code=1).err
    assert main(["replay", str(flight), *words, "--out", str(out)]) == 0
    found = read_tum(out / "poses.txt")
    truth = read_motions(flight, "/truth/pose", "/truth/twist").poses
    assert len(found) == 12
    off = found.positions - truth.positions[np.isin(truth.stamps_ns, found.stamps_ns)]
    assert np.median(np.linalg.norm(off, axis=1)) < 0.02
