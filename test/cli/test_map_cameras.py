# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What a camera has seen becomes a map; and poses of a detector of each camera of a pair."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recorded import record
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from rs_localizer.cli.commands import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_files import write_calibration
from rs_localizer.io.maps.files import read_map_file, write_npz
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.recording import MARKER_MAP
from rs_localizer.io.rigs import RigParts, mounted_lenses, node_parameters
from rs_localizer.io.trajectories import read_motions
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.settings import write_parameters

K = np.array([[260.0, 0.0, 159.5], [0.0, 260.0, 119.5], [0.0, 0.0, 1.0]])
# The second camera is upside down, 10 cm beside the first.
OVER, CENTRE = np.diag([-1.0, -1.0, 1.0]), np.array([0.1, 0.0, 0.0])


SCENE = {
    "alone": ("--readout-time", "0.03", "--camera", "camera.yaml"),
    "pair": ("--rig", "chain.yaml"),
}
ROOM = ("--trajectory", "tum_vi_room5")


@pytest.fixture(scope="module")
def film(tmp_path_factory):
    """Simulates with one camera or with both."""
    folder = tmp_path_factory.mktemp("film")
    camera = Camera(width=320, height=240, K=K, readout_time=0.03)
    write_calibration(folder / "camera.yaml", camera)
    mounts = {"up": (np.eye(3), np.zeros(3)), "down": (OVER, -OVER @ CENTRE)}
    parts = RigParts({"up": camera, "down": camera}, mounts, {"down": 0.2})
    write_parameters(folder / "chain.yaml", node_parameters(parts), mounted_lenses(parts))

    def film(which: str, name: str, *words: str) -> Path:
        out = folder / f"{which}_{name}"
        *options, file = SCENE[which]
        scene = (*options, str(folder / file))
        if not out.exists():
            record(out, *ROOM, *scene, *words)
        return out

    return film


@pytest.fixture(scope="module")
def images(film):
    """Of the walls."""
    words = ("--images", "--start", "20", "--duration", "0.8", "--exposure", "0.002")
    return lambda which: film(which, "images", *words, "--noise", "2")


def test_poses_of_a_detector_of_each_camera(images, tmp_path, ran):
    bag, seen, out = images("pair"), str(tmp_path / "seen"), tmp_path / "poses"
    words = ["--map", str(bag / MARKER_MAP), "--out", seen]
    said = ran("detect", bag, *words).out
    assert "up: " in said
    assert "down: " in said
    assert "kept for replay: /tf_static (1)" in said
    assert main(["replay", seen, "--params", f"{seen}/parameters.yaml", "--out", str(out)]) == 0
    truth = read_motions(bag, "/truth/pose", "/truth/twist").poses
    rows = {stamp: k for k, stamp in enumerate(truth.stamps_ns.tolist())}
    inside, count = [], 0
    with open_bag(out / "result") as result:
        for _, _, message in result.messages(["/rs_localizer/pose_with_covariance"]):
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


def survey(bag: Path, out: Path, *more: str) -> int:
    marker, *others = read_marker_map(bag / MARKER_MAP).markers
    sizes = [word for other in others for word in ("--size", f"{other.id}:{other.size}")]
    words = ["--family", marker.family.name, "--size", str(marker.size), *sizes]
    return main(["map", "survey", str(bag), *words, "--out", str(out), *more])


def test_markers_are_surveyed(images, tmp_path, capsys):
    bag, wall = images("alone"), tmp_path / "wall.yaml"
    truth = {marker.id: marker for marker in read_marker_map(bag / MARKER_MAP).markers}
    params = ["--params", str(bag / "parameters.yaml")]
    assert survey(bag, wall, *params) == 0
    said = capsys.readouterr().out
    assert "images with a marker" in said
    found = read_marker_map(wall).markers
    assert len(found) > 10
    ours, true = (np.concatenate([of.corners for of in each])
                  for each in (found, [truth[marker.id] for marker in found]))  # fmt: skip
    assert np.sqrt(np.mean(off_the_truth(ours, true) ** 2)) < 0.05 * truth[0].size
    assert all(np.all(marker.deviations > 0.0) for marker in found)


def test_a_readout_time_that_the_images_contradict_is_refused(images, tmp_path, capsys):
    bag, wall, wrong = images("alone"), tmp_path / "wall.yaml", ("-p", "readout_time:=0.025")
    assert survey(bag, wall, *wrong) == 1
    error = capsys.readouterr().err
    assert "25.0 ms was given" in error
    assert "-p readout_time:=0.0 estimates it" in error
    assert not wall.exists()


def test_a_map_is_refined(film, tmp_path, ran):
    words = ("--keypoints", "--duration", "1", "--points", "80", "--noise", "0.3")
    flight, out = film("alone", "flight", *words), tmp_path / "refined.npz"
    true = read_map_file(flight / "map.npz", "map")
    off = np.random.default_rng(0).normal(0.0, 0.02, true.points.shape)
    write_npz(tmp_path / "off.npz", replace(true, points=true.points + off))
    words = ["--params", str(flight / "parameters.yaml"), "--map", str(tmp_path / "off.npz")]
    words = ["map", "refine", str(flight), *words, "-p", "map_deviation:=0.02", "--out", str(out)]
    said = ran(*words).out
    assert "noise after" in said
    found = read_map_file(out, "map")
    assert found.covariances is not None
    known = np.isfinite(found.covariances[:, 0, 0])
    assert np.count_nonzero(known) > 30
    errors = off_the_truth(found.points[known], true.points[known])
    assert np.median(errors) < 0.7 * np.median(np.linalg.norm(off, axis=1)[known])
    assert found.descriptors is not None
    assert "exists; choose another OUT" in ran(*words, code=1).err
