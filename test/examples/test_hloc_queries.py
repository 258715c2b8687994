# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What hloc has matched becomes poses; its files are made here."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typed_commands import EXAMPLES, commands, started

import rs_localizer as rsl
from rs_localizer.core.shutter import project_rolling

h5py = pytest.importorskip("h5py")
pytest.importorskip("pycolmap")

READOUT = 0.03
CAMERA = rsl.Camera(640, 480, [[500.0, 0, 319.5], [0, 500, 239.5], [0, 0, 1]], readout_time=READOUT)
LENS = "SIMPLE_PINHOLE 640 480 500.0 320 240"  # COLMAP: the corner of the image is 0, 0
RNG = np.random.default_rng(3)
POINTS = RNG.uniform((-3, -2, 3), (3, 2, 7), (300, 3))


def moving(turn: Any, place: Any, angular: Any, linear: Any) -> rsl.Motion:
    """Velocities are rad/s and m/s, in the camera's axes."""
    rotation = Rotation.from_rotvec(turn).as_matrix()
    per_readout = READOUT * np.array([angular, linear], float)
    return rsl.Motion(rotation, -rotation @ place, *per_readout)


def seen(motion: rsl.Motion) -> tuple[Any, Any]:
    """Which points an image shows, and their pixels."""
    pixels, _ = project_rolling(CAMERA, motion.at_rows, POINTS)
    shown = RNG.permutation(np.flatnonzero(CAMERA.inside(pixels)))
    return shown, pixels[shown]


def write(folder: Path, queries: dict[str, rsl.Motion]) -> None:
    """A model of two images, and queries matched with them: the example's files."""
    model, tracks, shows = folder / "sfm", {}, []
    model.mkdir()
    lines = []
    for number in (1, 2):
        still = moving((0, 0.1 * number, 0), (0.4 * number, 0, 0), (0, 0, 0), (0, 0, 0))
        shown, pixels = seen(still)
        shows.append({int(point): feature for feature, point in enumerate(shown)})
        for point, feature in shows[-1].items():
            tracks.setdefault(point, []).append(f"{number} {feature}")
        x, y, z, w = Rotation.from_matrix(still.rotation).as_quat()
        keypoints = [f"{u + 0.5} {v + 0.5} {p}" for p, (u, v) in zip(shown, pixels, strict=True)]
        lines.append(" ".join(map(str, (number, w, x, y, z, *still.translation, 1, f"{number}.j"))))
        lines.append(" ".join([*keypoints, "1 1 -1"]))  # some keypoints show no point
    (model / "images.txt").write_text("\n".join(lines) + "\n")
    (model / "cameras.txt").write_text(f"1 {LENS}\n")
    (model / "points3D.txt").write_text("".join(
        f"{p} {' '.join(map(str, POINTS[p]))} 0 0 0 1 {' '.join(of)}\n" for p, of in tracks.items()
    ))  # fmt: skip
    names = [folder / name for name in ("queries.txt", "pairs.txt", "features.h5", "matches.h5")]
    names[0].write_text("".join(f"{name} {LENS}\n" for name in queries))
    names[1].write_text("".join(f"{name} {k}.j\n" for name in queries for k in (1, 2)))
    with h5py.File(names[2], "w") as features, h5py.File(names[3], "w") as matched:
        for name, motion in queries.items():
            shown, pixels = seen(motion)
            pixels += RNG.normal(0.0, 0.5, pixels.shape)
            features.create_group(name).create_dataset("keypoints", data=pixels)
            there = [np.array([show.get(int(p), -1) for p in shown]) for show in shows]
            there[0][RNG.random(len(shown)) < 0.1] = 0  # wrong ones
            back = np.full(len(shows[1]) + 1, -1)
            back[there[1][there[1] >= 0]] = np.flatnonzero(there[1] >= 0)
            flat = name.replace("/", "-")
            # hloc looks for a pair in both orders, and wrote another separator.
            matched.create_group(f"{flat}/1.j").create_dataset("matches0", data=there[0])
            matched.create_group(f"2.j_{flat}").create_dataset("matches0", data=back)


def test_moving_queries_have_their_poses_and_velocities(tmp_path):
    rng = np.random.default_rng(8)
    truth = {
        f"query/cam{k % 2}/{k}.jpg": moving(
            rng.normal(0, 0.1, 3), rng.normal(0, 0.2, 3), rng.normal(0, 0.8, 3),
            rng.normal(0, 0.6, 3),
        )
        for k in range(4)
    }  # fmt: skip
    write(tmp_path, truth)
    (tmp_path / "examples").symlink_to(EXAMPLES)
    (line,) = commands("hloc_queries.py")
    done = started(line, tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    lines = [line.split() for line in (tmp_path / "poses.txt").read_text().splitlines()]
    told = json.loads((tmp_path / "poses_motion.json").read_text())["queries"]
    assert [name for name, *_ in lines] == [Path(name).name for name in truth]
    for (name, motion), (_, *words) in zip(truth.items(), lines, strict=True):
        w, x, y, z, *translation = map(float, words)
        rotation = Rotation.from_quat([x, y, z, w])
        off = (rotation * Rotation.from_matrix(motion.rotation).inv()).magnitude()
        assert np.degrees(off) < 0.3
        centre = -rotation.inv().apply(translation)
        assert np.linalg.norm(centre + motion.rotation.T @ motion.translation) < 0.02
        found = told[name]
        velocities = found["angular_velocity_rad_per_s"], found["linear_velocity_m_per_s"]
        errors = np.concatenate(velocities) - np.concatenate(
            [motion.angular_velocity, motion.linear_velocity]
        ) / READOUT  # fmt: skip
        assert np.all(np.abs(errors) < 5.0 * np.array(found["twist_deviations"]))
        assert np.all(np.abs(errors) < np.repeat([0.15, 0.6], 3))
