# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What hloc has matched becomes poses; its files are made here, by a small projector."""

import json
import shutil
import struct
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.cli.main import main

h5py = pytest.importorskip("h5py")

WIDTH, HEIGHT, FOCAL, READOUT = 640, 480, 500.0, 0.03
LENS = f"SIMPLE_PINHOLE {WIDTH} {HEIGHT} {FOCAL} 320 240"  # COLMAP: the corner of the image is 0, 0
NOISE = 0.5  # px
DB = [f"db/{k}.jpg" for k in range(3)]


class Pose:
    """camera_from_map at the middle row, moving."""

    def __init__(self, turn: Any, centre: Any, angular: Any = (0, 0, 0), linear: Any = (0, 0, 0)):
        self.rotation = Rotation.from_euler("XYZ", turn).as_matrix()
        self.centre = np.array(centre, float)
        self.angular, self.linear = np.array(angular, float), np.array(linear, float)

    def at(self, tau: float) -> tuple[Any, Any]:
        """Rotation and translation at a row time; velocities are rad/s and m/s, camera axes."""
        seconds = tau * READOUT
        rotation = cv2.Rodrigues(-seconds * self.angular)[0] @ self.rotation
        return rotation, -rotation @ (self.centre + seconds * self.rotation.T @ self.linear)

    def see(self, points: Any) -> Any:
        """Raw pixels (n,2), the centre of the first one at 0, 0; each at the time of its row."""
        pixels = np.zeros((len(points), 2))
        for _ in range(8 if self.angular.any() or self.linear.any() else 1):
            taus = pixels[:, 1] / (HEIGHT - 1) - 0.5
            poses = [self.at(tau) for tau in taus]
            seen = np.array([r @ p + t for (r, t), p in zip(poses, points, strict=True)])
            pixels = FOCAL * seen[:, :2] / seen[:, 2:] + [WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5]
        return pixels


def inside(pixels: Any) -> Any:
    return np.flatnonzero(np.all((pixels > 0) & (pixels < [WIDTH - 1, HEIGHT - 1]), axis=1))


def make(folder: Path, motions: dict[str, Pose], old: bool = False) -> SimpleNamespace:
    """A model of three images, and queries matched with them."""
    rng = np.random.default_rng(3)
    points = rng.uniform((-3, -2, 3), (3, 2, 7), (300, 3))
    poses = [Pose((0, 0.1 * k, 0), (0.4 * k, 0, 0)) for k in range(3)]
    sfm = folder / "sfm"
    sfm.mkdir(parents=True)
    tracks: dict[int, list[tuple[int, int]]] = {}
    rows, shows = [], []
    for number, (name, pose) in enumerate(zip(DB, poses, strict=True), 11):
        pixels = pose.see(points)
        seen = rng.permutation(inside(pixels))
        shows.append(np.append(seen, [-1] * 20))  # some keypoints show no point
        for feature, point in enumerate(seen):
            tracks.setdefault(int(point), []).append((number, feature))
        q, t = Rotation.from_matrix(pose.rotation).as_quat(), pose.at(0)[1]
        words = [number, q[3], *q[:3], *t, 1, name]
        listed = [
            f"{x + 0.5} {y + 0.5} {1000 + p}" for p, (x, y) in zip(seen, pixels[seen], strict=True)
        ]
        rows += [" ".join(map(str, words)), " ".join([*listed, *["1 1 -1"] * 20])]
    (sfm / "images.txt").write_text("# images\n" + "\n".join(rows) + "\n")
    (sfm / "cameras.txt").write_text(f"1 {LENS}\n")
    (sfm / "points3D.txt").write_text(
        "".join(
            f"{1000 + p} {' '.join(map(str, points[p]))} 0 0 0 1 "
            f"{' '.join(f'{i} {f}' for i, f in track)}\n"
            for p, track in tracks.items()
        )
    )
    pairs, queries, correspondences = [], [], {}
    with h5py.File(folder / "features.h5", "w") as h5, h5py.File(folder / "m.h5", "w") as matched:
        for name, pose in motions.items():
            pixels = pose.see(points)
            seen = rng.permutation(inside(pixels))
            keypoints = pixels[seen] + rng.normal(0, NOISE, (len(seen), 2))
            h5.create_group(name).create_dataset("keypoints", data=keypoints.astype(np.float32))
            queries.append(f"{name} {LENS}")
            used = set()
            for k, db in enumerate(DB):
                pairs.append(f"{name} {db}")
                place = {int(p): f for f, p in enumerate(shows[k]) if p >= 0}
                found = np.array([place.get(int(p), -1) for p in seen])
                wrong = rng.random(len(found)) < 0.1
                found[wrong] = rng.integers(-1, len(shows[k]), wrong.sum())
                used |= {(q, int(shows[k][f])) for q, f in enumerate(found) if f >= 0}
                one, other = (item.replace("/", "-") for item in (name, db))
                if k == 1:  # hloc looks for a pair in both orders
                    one, other = other, one
                    turned = np.full(len(shows[k]), -1)
                    turned[found[found >= 0]] = np.flatnonzero(found >= 0)
                    found = turned
                    used |= {(int(q), int(shows[k][f])) for f, q in enumerate(turned) if q >= 0}
                group = matched.create_group(f"{one}{'_' if old else '/'}{other}")
                group.create_dataset("matches0", data=found.astype(np.int16))
                group.create_dataset("matching_scores0", data=np.ones(len(found), np.float16))
            chosen = np.array([(q, p) for q, p in used if p >= 0])
            correspondences[name] = keypoints[chosen[:, 0]], points[chosen[:, 1]]
    (folder / "queries.txt").write_text("\n".join(queries) + "\n")
    (folder / "pairs.txt").write_text("\n".join(pairs) + "\n")
    results = folder / "poses.txt"
    return SimpleNamespace(folder=folder, sfm=sfm, seen=correspondences, results=results)


def localize(files: Any, *words: str, **paths: Path) -> int:
    folder = files.folder
    chosen = {
        "reference-sfm": files.sfm, "queries": folder / "queries.txt",
        "retrieval": folder / "pairs.txt", "features": folder / "features.h5",
        "matches": folder / "m.h5", "results": files.results,
    } | {name.replace("_", "-"): path for name, path in paths.items()}  # fmt: skip
    given = [word for name, path in chosen.items() for word in (f"--{name}", str(path))]
    return main(["localize-hloc", *given, *words])


def read(path: Path) -> dict[str, tuple[Any, Any]]:
    """Rotations and translations camera_from_map by name."""
    found = {}
    for line in path.read_text().splitlines():
        name, *words = line.split()
        values = np.array(words, float)
        q = values[[1, 2, 3, 0]]
        found[name] = Rotation.from_quat(q).as_matrix(), values[4:]
    return found


def errors(found: tuple[Any, Any], truth: tuple[Any, Any]) -> Any:
    """Distance of the centres (m) and angle (deg)."""
    turn = Rotation.from_matrix(found[0] @ truth[0].T).magnitude()
    return np.array(
        [np.linalg.norm(found[0].T @ found[1] - truth[0].T @ truth[1]), np.degrees(turn)]
    )


def motions(count: int) -> dict[str, Pose]:
    rng = np.random.default_rng(8)
    found = {}
    for k in range(count):
        angular, linear = rng.normal(0, 0.8, 3), rng.normal(0, 0.6, 3)
        turn, centre = rng.normal(0, 0.1, 3), rng.normal(0, 0.2, 3)
        found[f"query/cam{k % 2}/{k}.jpg"] = Pose(turn, centre, angular, linear)
    return found


def global_shutter(files: Any, name: str) -> tuple[Any, Any]:
    """The pose that hloc itself would give."""
    pycolmap = pytest.importorskip("pycolmap")
    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, 320.0, 240.0]
    )
    pixels, points = files.seen[name]
    found = pycolmap.estimate_and_refine_absolute_pose(
        pixels + 0.5, points, camera, {"ransac": {"max_error": 12.0}}
    )
    matrix = np.asarray(found["cam_from_world"].matrix())
    return matrix[:, :3], matrix[:, 3]


def test_moving_queries_lose_half_of_the_error(tmp_path, capsys):
    truth = motions(6)
    files = make(tmp_path, truth)
    assert localize(files, "-p", f"readout_time:={READOUT}") == 0
    assert "poses.txt, poses_motion.json: 6 of 6 queries localized" in capsys.readouterr().out
    found = read(files.results)
    told = json.loads((tmp_path / "poses_motion.json").read_text())
    assert set(found) == {f"{k}.jpg" for k in range(6)}
    ours, theirs = [], []
    for name, pose in truth.items():
        ours.append(errors(found[Path(name).name], pose.at(0.0)))
        theirs.append(errors(global_shutter(files, name), pose.at(0.0)))
        motion = told["queries"][name]
        deviations = np.sqrt(np.diag(motion["twist_covariance"]))
        off = np.concatenate([motion["linear_velocity"] - pose.linear,
                              motion["angular_velocity"] - pose.angular])  # fmt: skip
        assert np.all(np.abs(off) < 5.0 * deviations)
        assert np.all(np.abs(off) < np.repeat([0.6, 0.15], 3))
    assert np.all(np.median(ours, axis=0) < 0.5 * np.median(theirs, axis=0))


def test_rows_names_and_older_files(tmp_path, capsys):
    truth = motions(2)
    new, old = make(tmp_path / "new", truth), make(tmp_path / "old", truth, old=True)
    words = ["-p", f"readout_time:={READOUT}", "--prepend-camera-name", "--row", "first"]
    assert localize(new, *words) == localize(old, *words) == 0
    assert new.results.read_text() == old.results.read_text()
    found = read(new.results)
    for name, pose in truth.items():
        assert np.all(errors(found[name.removeprefix("query/")], pose.at(-0.5)) < [0.03, 0.3])
    # A result is not overwritten.
    assert localize(new, *words) == 1
    assert "poses.txt exists already" in capsys.readouterr().err
    # Without a readout time there are poses, and no velocities.
    other = tmp_path / "other.txt"
    assert localize(new, results=other) == 0
    assert "no velocities: readout_time is 0" in capsys.readouterr().out
    told = json.loads((tmp_path / "other_motion.json").read_text())
    assert all(query["angular_velocity"] is None for query in told["queries"].values())


def test_bad_files_are_told_of_in_one_line(tmp_path, capsys):
    files = make(tmp_path, motions(1))
    name, h5 = "query/cam0/0.jpg", tmp_path / "bad.h5"
    bad, broken = tmp_path / "bad", tmp_path / "broken"
    broken.mkdir()

    def refused(said: str, **paths: Path) -> None:
        assert localize(files, **paths) == 1
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1 or "localize:" in error
        assert not files.results.exists()
        assert not (tmp_path / "poses_motion.json").exists()

    bad.write_bytes((tmp_path / "features.h5").read_bytes()[:500])
    refused("bad cannot be read as HDF5", features=bad)
    with h5py.File(h5, "w") as file:
        file.create_group(f"{name}/keypoints")
    refused(f"bad.h5 has no keypoints of {name}", features=h5)
    refused("has no matches of query/cam0/0.jpg and db/0.jpg", matches=h5)
    with h5py.File(h5, "w") as file:
        file[f"{name}/keypoints"] = np.zeros((5, 2))
    refused("but query/cam0/0.jpg has 5: are features and matches", features=h5)
    for index, said in (
        (9999, "keypoint 9999 of db/0.jpg, which has"), (-7, "db/0.jpg are of keypoint -7"),
    ):  # fmt: skip
        shutil.copy(tmp_path / "m.h5", h5)
        with h5py.File(h5, "a") as file:
            file["query-cam0-0.jpg/db-0.jpg/matches0"][3] = index
        refused(said, matches=h5)
    for option, text, said in (
        ("retrieval", f"{name}\n", "bad, line 1: expected QUERY IMAGE"),
        ("retrieval", f"{name} db/7.jpg\n", "is in the model: db/7.jpg is not one of db/0.jpg"),
        ("retrieval", "other.jpg db/0.jpg\n", "most often: no image of the model is paired with"),
        ("queries", f"{name} FOV 640 480 500 320 240 1\n", "model must be one of SIMPLE_PINHOLE"),
        ("queries", "# nothing\n", "bad has no query"),
    ):
        bad.write_text(text)
        refused(said, **{option: bad})
    refused("has neither images.bin nor images.txt", reference_sfm=broken)
    (broken / "images.txt").write_text("1 0 0 0 1 0 0\n\n")
    refused("expected ID QW QX", reference_sfm=broken)
    (broken / "images.bin").write_bytes(struct.pack("<Q", 1) + bytes(70))
    refused("images.bin is truncated or damaged", reference_sfm=broken)
    assert localize(files, "-p", "readout:=1") == 2
    assert localize(files, "--row", "third") == 2
