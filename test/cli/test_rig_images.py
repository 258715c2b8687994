# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rendered images of a pair: through a detector of each camera to poses."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from rs_localizer.cli.main import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import open_bag
from rs_localizer.io.maps.files import read_map_file, write_map_file
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.recording import MARKER_MAP
from rs_localizer.io.rigs import RigParts, write_camchain
from rs_localizer.io.trajectories import read_motions
from rs_localizer.markers.map_files import read_marker_map

K = np.array([[260.0, 0.0, 159.5], [0.0, 260.0, 119.5], [0.0, 0.0, 1.0]])
# The second camera is upside down, 10 cm beside the first.
OVER, CENTRE = np.diag([-1.0, -1.0, 1.0]), np.array([0.1, 0.0, 0.0])


@pytest.fixture(scope="module")
def pair(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("pair")
    camera = Camera(width=320, height=240, K=K, readout_time=0.03)
    mounts = {"up": (np.eye(3), np.zeros(3)), "down": (OVER, -OVER @ CENTRE)}
    parts = RigParts({"up": camera, "down": camera}, mounts, {"down": 0.2})
    write_camchain(folder / "chain.yaml", parts)
    words = ["--images", "--trajectory", "tum_vi_room5", "--start", "20", "--duration", "0.8"]
    rig = ["--rig", str(folder / "chain.yaml"), "--exposure", "0.002", "--grey-noise", "2"]
    assert main(["simulate", str(folder / "images"), *rig, *words]) == 0
    return folder


def test_poses_of_a_detector_of_each_camera(pair, tmp_path, capsys):
    images, seen, out = str(pair / "images"), str(tmp_path / "seen"), tmp_path / "poses"
    assert main(["detect", images, "--map", f"{images}/marker_map.yaml", "--out", seen]) == 0
    said = capsys.readouterr().out
    assert "up: " in said
    assert "down: " in said
    assert "kept for replay: /tf_static (1)" in said
    assert main(["replay", seen, "--params", f"{seen}/parameters.yaml", "--out", str(out)]) == 0
    truth = read_motions(pair / "images", "/truth/pose", "/truth/twist").poses
    rows = {stamp: k for k, stamp in enumerate(truth.stamps_ns.tolist())}
    inside, count = [], 0
    with open_bag(out / "result") as bag:
        topic = next(topic for topic, kind in bag.topics.items() if "PoseWithCovariance" in kind)
        for _, _, message in bag.messages([topic]):
            k, pose = rows[stamp_ns(message)], message.pose.pose
            at, turned = pose.position, pose.orientation
            off = np.array([at.x, at.y, at.z]) - truth.positions[k]
            turn = Rotation.from_quat([turned.x, turned.y, turned.z, turned.w])
            turn *= Rotation.from_quat(truth.quaternions[k]).inv()
            errors = np.r_[off, turn.as_rotvec()]
            covariance = np.reshape(message.pose.covariance, (6, 6))
            inside.append(errors @ np.linalg.solve(covariance, errors) < chi2.isf(0.01, 6))
            count += 1
    assert count > 20
    # Of the 99 % that a region claims, nine in ten at least: frames share errors of the detector.
    assert np.mean(inside) > 0.9


def off_the_truth(points: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Distances (n,) of points (n,3) that are laid over the true ones as one body."""
    ours, theirs = points - points.mean(axis=0), true - true.mean(axis=0)
    return np.linalg.norm(Rotation.align_vectors(theirs, ours)[0].apply(ours) - theirs, axis=1)


def test_markers_surveyed_with_both_cameras(pair, tmp_path, capsys):
    images, wall = str(pair / "images"), tmp_path / "wall.yaml"
    truth = {marker.id: marker for marker in read_marker_map(Path(images, MARKER_MAP)).markers}
    size = truth[0].size
    sizes = [word for marker in truth.values() for word in ("--size", f"{marker.id}:{marker.size}")]
    words = ["--family", truth[0].family.name, "--size", str(size), *sizes]
    words += ["--params", f"{images}/parameters.yaml", "--out", str(wall)]
    assert main(["map", "survey", images, *words]) == 0
    said = capsys.readouterr().out
    assert "up: images with a marker" in said
    assert "down <- up" in said
    found = read_marker_map(wall).markers
    assert len(found) > 10
    ours, true = (np.concatenate([of.corners for of in each])
                  for each in (found, [truth[marker.id] for marker in found]))  # fmt: skip
    assert np.sqrt(np.mean(off_the_truth(ours, true) ** 2)) < 0.05 * size


def test_a_map_refined_with_both_cameras(pair, tmp_path, capsys):
    flight, out = tmp_path / "flight", tmp_path / "refined.npz"
    words = ["--trajectory", "tum_vi_room5", "--duration", "1", "--points", "60"]
    rig = ["--rig", str(pair / "chain.yaml"), "--keypoints", "--noise", "0.3"]
    assert main(["simulate", str(flight), *rig, *words]) == 0
    true = read_map_file(flight / "map.npz", "map")
    off = np.random.default_rng(0).normal(0.0, 0.02, true.points.shape)
    write_map_file(tmp_path / "off.npz", replace(true, points=true.points + off))
    capsys.readouterr()
    words = ["--params", str(flight / "parameters.yaml"), "--map", str(tmp_path / "off.npz")]
    more = ["--out", str(out), "-p", "map_deviation:=0.02"]
    assert main(["map", "refine", str(flight), *words, *more]) == 0
    said = capsys.readouterr().out
    assert "down <- up" in said
    found = read_map_file(out, "map")
    known = np.isfinite(found.covariances[:, 0, 0])
    assert np.count_nonzero(known) > 30
    errors = off_the_truth(found.points[known], true.points[known])
    assert np.median(errors) < 0.7 * np.median(np.linalg.norm(off, axis=1)[known])


def test_a_rig_that_nobody_mounted(pair, tmp_path, capsys):
    words = ["map", "survey", "a.mp4", "b.mp4", "--family", "4x4_50", "--size", "0.1"]
    for name in ("a.mp4", "b.mp4"):
        (tmp_path / name).touch()
        words[words.index(name)] = str(tmp_path / name)
    assert main([*words, "--out", str(tmp_path / "wall.yaml")]) == 2
    assert "it is not known where a, b of the rig is mounted" in capsys.readouterr().err
