# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map``: what it says, writes and refuses; and a pair's poses of a detector."""

import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
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
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.recording import MARKER_MAP
from rs_localizer.io.rigs import RigParts, mounted_lenses, node_parameters
from rs_localizer.io.trajectories import read_motions
from rs_localizer.markers.map_files import read_marker_map, write_marker_map
from rs_localizer.markers.maps import MarkerMap, wall
from rs_localizer.markers.prints import Pose
from rs_localizer.settings import write_parameters
from rs_localizer.tools.simulation.walls import collage

COLMAP = Path(__file__).parents[1] / "io" / "maps" / "colmap"


def test_info(tmp_path, ran):
    points = np.array([[0.0, -1.0, 2.0], [1.0, 1.0, 3.5], [5.0, 0.0, 100.0]])
    path = tmp_path / "map.npz"
    write_npz(path, Map(points, np.array([7, -3, 5]), np.zeros((3, 32), np.uint8), "map"))
    lines = ran("map", "info", path).out.splitlines()
    assert lines[0] == str(path)
    told = dict(line.strip().split(maxsplit=1) for line in lines[1:])
    assert (told["landmarks"], told["first_id"], told["last_id"]) == ("3", "-3", "7")
    assert (told["descriptor_length"], told["descriptor_type"]) == ("32", "uint8")
    assert [told[f"x_{name}_m"] for name in ("min", "median", "max")] == ["0.000", "1.000", "5.000"]
    write_npz(path, Map(points, None, None, "map"))
    assert "_id" not in ran("map", "info", path).out


def test_a_model_of_colmap_becomes_a_file(tmp_path, ran):
    out = tmp_path / "map.npz"
    words = ["map", "align", str(COLMAP / "text"), str(out)]
    said = ran(*words).out
    assert f"written: {out}" in said
    assert read_map_file(out, "map").equals(read_map_file(COLMAP / "binary", "map"))
    result = json.loads(ran(*words, "--overwrite", "--json").out)["result"]
    assert result["landmarks"] == len(read_map_file(out, "map"))
    assert (result["descriptor_length"], result["descriptor_type"]) == (128, "float32")
    assert result["written_to"] == str(out)


@pytest.fixture
def marker_file(tmp_path) -> Path:
    path = tmp_path / "wall.yaml"
    markers = wall("apriltag_36h11", (3, 2), 0.16, 0.04, pose=Pose(np.array([1.0, 2.0, 0.5])))
    write_marker_map(path, MarkerMap(markers))
    return path


def test_markers_become_landmarks(tmp_path, marker_file):
    corners = tmp_path / "corners.npz"
    assert main(["map", "align", str(marker_file), str(corners)]) == 0
    landmarks = read_map_file(corners, "map")
    np.testing.assert_array_equal(landmarks.points, read_marker_map(marker_file).points)


def make(out: Path, *words: str) -> int:
    return main(["markers", "make", str(out), *words])


def test_make_and_check(tmp_path, capsys, ran):
    out = tmp_path / "wall.v2"
    assert make(out) == 0
    said = capsys.readouterr().out
    assert f"{out}.pdf: 1 page of a4; print at 100 %" in said
    assert (tmp_path / "wall.v2.pdf").read_bytes().startswith(b"%PDF")
    made = read_marker_map(tmp_path / "wall.v2.yaml")
    assert [marker.name for marker in made.markers] == [f"marker 4x4_50 {k}" for k in range(6)]
    said = ran("map", "info", f"{out}.yaml").out
    assert re.search(r"ids_4x4_50 +\[0, 1, 2, 3, 4, 5\]\n", said)
    assert make(out, "--size", "0.05", "--overwrite", "--json") == 0
    pages = {"pages": [f"{out}.pdf"], "map": f"{out}.yaml", "corners": 24}
    assert json.loads(capsys.readouterr().out)["result"] == pages
    assert read_marker_map(f"{out}.yaml").markers[0].size == pytest.approx(0.05)


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


SIZE = (320, 240)


def picture(seed: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    return collage(*size, np.random.default_rng(seed))


TILES = np.tile(picture(0, (64, 64)), (9, 9))


@pytest.mark.parametrize(
    ("images", "text"),
    [
        (5 * [np.full(SIZE[::-1], 90, np.uint8)], "the images show 0 features each (median)"),
        ([picture(k) for k in range(6)], "no two of the 6 keyframes determine a structure"),
        (
            [TILES[4 * k : 4 * k + SIZE[1], 11 * k : 11 * k + SIZE[0]] for k in range(16)],
            "texture that does not repeat",
        ),
        ([], "no image that can be read"),
    ],
    ids=["blank walls", "no overlap", "repeated texture", "broken files"],
)
def test_what_makes_no_map_is_said_and_leaves_nothing(tmp_path, images, text, capsys):
    pytest.importorskip("pycolmap")
    write_calibration(tmp_path / "camera.yaml", Camera(*SIZE, K))
    (tmp_path / "images").mkdir()
    for number, image in enumerate(images):
        cv2.imwrite(str(tmp_path / "images" / f"{number}.png"), image)
    if not images:
        (tmp_path / "images" / "0.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    given = ["--calibration", str(tmp_path / "camera.yaml"), "--rate", "15"]
    words = ["map", "build", str(tmp_path / "images"), *given, "-p", "readout_time:=0.03"]
    assert main([*words, "--out", str(tmp_path / "map")]) == 1
    assert not (tmp_path / "map").exists()
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert text in line
