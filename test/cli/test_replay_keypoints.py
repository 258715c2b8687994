# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Replay of keypoints: with a map in the recording and with a map file, and what is missing."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recorded
from recorded import SHUTTER

from rs_localizer.cli.main import main
from rs_localizer.io.bags import BagWriter, make_message, open_bag
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.maps.files import write_map_file
from rs_localizer.io.maps.landmarks import Map, map_rows
from rs_localizer.io.trajectories import read_tum
from rs_localizer.simulation.recording import write_simulated
from rs_localizer.simulation.scene import keypoint_rows, random_descriptors, room
from rs_localizer.simulation.settings import FrameSettings

FRAMES = 8
POINTS = room(np.zeros((1, 3)), np.random.default_rng(0), count=6000)
LANDMARKS = Map(
    POINTS, np.arange(6000) + 7, random_descriptors(6000, np.random.default_rng(1)), "map"
)


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Path:
    """Recordings of one flight: with correspondences, keypoints, and a map, as asked for."""
    folder = tmp_path_factory.mktemp("bags")
    seen = FrameSettings(points=80, noise=0.5, outliers=0.2)
    with BagWriter(folder / "all") as bag:
        for frame in recorded.flight(POINTS, FRAMES, seen, 10**9):
            write_simulated(bag, recorded.CAMERA, frame)
            rows = keypoint_rows(frame, LANDMARKS, np.random.default_rng(frame.stamp_ns))
            for topic, names in (
                ("/cam/keypoints", ("u", "v", "descriptor")),
                ("/ids", ("u", "v", "id")),
            ):
                part = np.empty(len(rows), [(name, rows.dtype[name]) for name in names])
                for name in names:
                    part[name] = rows[name]
                message = make_cloud(make_message, frame.stamp_ns, "camera", part)
                bag.write(topic, message, frame.stamp_ns)
            if frame.stamp_ns == 10**9 + 66_666_667:  # late: with the third frame
                message = make_cloud(make_message, 0, "map", map_rows(LANDMARKS))
                bag.write("/cam/map_points", message, frame.stamp_ns - 1)
    for name, topics in {
        "keypoints": ("/camera_info", "/cam/keypoints"),
        "with_map": ("/camera_info", "/cam/keypoints", "/cam/map_points"),
    }.items():
        with open_bag(folder / "all") as source, BagWriter(folder / name) as bag:
            for topic, stamp_ns, message in source.messages((*topics, "/truth/pose")):
                bag.write(topic, message, stamp_ns)
    write_map_file(folder / "map.npz", LANDMARKS)
    return folder


def errors(out: Path, truth: Path) -> Any:
    """Distances (m) of the poses to the true ones."""
    found = read_tum(out / "poses.txt")
    with open_bag(truth) as bag:
        poses = {
            m.header.stamp.sec * 10**9 + m.header.stamp.nanosec: m.pose.position
            for _, _, m in bag.messages(("/truth/pose",))
        }
    true = np.array([[poses[s].x, poses[s].y, poses[s].z] for s in found.stamps_ns.tolist()])
    return np.linalg.norm(found.positions - true, axis=1)


@pytest.mark.parametrize("how", ["--map", "-p"])
def test_a_map_file(flight, tmp_path, how):
    file = str(flight / "map.npz")
    given = ["--map", file] if how == "--map" else ["-p", f"map_file:={file}"]
    out = tmp_path / "out"
    assert main(["replay", str(flight / "keypoints"), "--out", str(out), *SHUTTER, *given]) == 0
    found = errors(out, flight / "keypoints")
    assert len(found) == FRAMES
    assert found.max() < 0.02


def test_a_recording_of_everything(flight, tmp_path, capsys):
    words = ["replay", str(flight / "all"), *SHUTTER]
    assert main(words) == 1
    assert "choose with --correspondences or --keypoints" in capsys.readouterr().err
    for name, given in {
        "clouds": ["--correspondences", "/correspondences"],
        "ids": ["--keypoints", "/ids", "--map-points", "/cam/map_points"],
    }.items():
        assert main([*words, *given, "--out", str(tmp_path / name)]) == 0
    assert "map_replaced" not in capsys.readouterr().out
    # By the id or by the points themselves: the frames since the map came are the same.
    one, other = (
        read_tum(tmp_path / "ids" / "poses.txt"),
        read_tum(tmp_path / "clouds" / "poses.txt"),
    )
    assert len(one) == len(other) - 2
    assert np.allclose(one.positions, other.positions[2:], atol=0.01)


def test_a_simulated_recording_and_its_map(tmp_path, monkeypatch, capsys):
    """The line that simulate prints as the next one works, and gives the true poses."""
    monkeypatch.chdir(tmp_path)
    assert main(["simulate", "flight", "--keypoints", "--duration", "0.4", "--points", "200"]) == 0
    said = capsys.readouterr().out
    following = said.splitlines()[-1].removeprefix("next: rs_localizer ").split()
    assert following[-4:] == ["--map", "flight/map.npz", "--out", "flight_poses"]
    assert main(following) == 0
    found = errors(tmp_path / "flight_poses", tmp_path / "flight")
    assert len(found) == 12
    assert np.median(found) < 0.02
    assert main(["simulate", "other", "--keypoints", "--images"]) == 2
    assert "--keypoints is for points" in capsys.readouterr().err
