# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What hloc has matched becomes poses; its files are made here, by a small projector."""

import importlib
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

h5py = pytest.importorskip("h5py")
pytest.importorskip("pycolmap")
hloc_queries = importlib.import_module("hloc_queries")

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


def localize(files: Any, readout: float = READOUT) -> None:
    folder = files.folder
    names = ("queries.txt", "pairs.txt", "features.h5", "m.h5")
    places = [files.sfm, *(folder / name for name in names), files.results]
    hloc_queries.main(*map(str, places), str(readout))


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
    import pycolmap

    camera = pycolmap.Camera(
        model="SIMPLE_PINHOLE", width=WIDTH, height=HEIGHT, params=[FOCAL, 320.0, 240.0]
    )
    pixels, points = files.seen[name]
    found = pycolmap.estimate_and_refine_absolute_pose(
        pixels + 0.5, points, camera, {"ransac": {"max_error": 12.0}}
    )
    matrix = np.asarray(found["cam_from_world"].matrix())
    return matrix[:, :3], matrix[:, 3]


def test_moving_queries_lose_half_of_the_error(tmp_path):
    truth = motions(6)
    files = make(tmp_path, truth)
    localize(files)
    found = read(files.results)
    told = json.loads((tmp_path / "poses_motion.json").read_text())
    assert set(found) == {f"{k}.jpg" for k in range(6)}
    ours, theirs = [], []
    for name, pose in truth.items():
        ours.append(errors(found[Path(name).name], pose.at(0.0)))
        theirs.append(errors(global_shutter(files, name), pose.at(0.0)))
        motion = told["queries"][name]
        off = np.concatenate([motion["angular_velocity_rad_per_s"] - pose.angular,
                              motion["linear_velocity_m_per_s"] - pose.linear])  # fmt: skip
        assert np.all(np.abs(off) < 5.0 * np.array(motion["twist_deviations"]))
        assert np.all(np.abs(off) < np.repeat([0.15, 0.6], 3))
    assert np.all(np.median(ours, axis=0) < 0.5 * np.median(theirs, axis=0))
