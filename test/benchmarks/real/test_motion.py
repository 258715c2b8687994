# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Real motions before real points: on a miniature of Aria's files."""

import gzip

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.independent.cameras import Camera as TrueCamera
from benchmarks.real import motion as motions

HEADINGS = ("graph_uid,tracking_timestamp_us,tx_world_device,ty_world_device,tz_world_device,"
            "qx_world_device,qy_world_device,qz_world_device,qw_world_device")  # fmt: skip


def turn(t):
    return Rotation.from_rotvec(np.array([0.2 * np.sin(3.0 * t), 0.3 * np.sin(2.0 * t), 0.1 * t]))


def place(t):
    return np.array([0.2 * np.sin(2.0 * t), 0.1 * t, 0.15 * np.cos(3.0 * t)])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("aria")
    lines = [HEADINGS]
    for k in range(901):
        t = 1e-3 * k
        numbers = [*place(t), *turn(t).as_quat()]
        lines.append(f"a,{5_000_000 + 1000 * k},{','.join(f'{x:.9f}' for x in numbers)}")
        if k == 100:  # as in the sample: the next one comes a microsecond later
            lines.append(f"a,{5_000_001 + 1000 * k},{','.join(f'{x + 1e-5:.9f}' for x in numbers)}")
    (path / "closed_loop_trajectory.csv").write_text("\n".join(lines))
    rng = np.random.default_rng(0)
    points = rng.uniform([-3.0, -3.0, 2.0], [3.0, 3.0, 6.0], (4000, 3))
    with gzip.open(path / "semidense_points.csv.gz", "wt") as file:
        file.write("uid,graph_uid,px_world,py_world,pz_world\n")
        file.writelines(f"{k},b,{x:.6f},{y:.6f},{z:.6f}\n" for k, (x, y, z) in enumerate(points))
    return path


def test_twists_are_the_derivatives_of_the_poses(folder):
    moving, points = motions.read_aria(folder)
    assert points.shape == (4000, 3)
    h = 1e-4
    for t in (0.2, 0.55):
        angular, linear = moving.twist(t)
        rate = (turn(t - h).inv() * turn(t + h)).as_rotvec() / (2.0 * h)
        speed = turn(t).inv().apply(place(t + h) - place(t - h)) / (2.0 * h)
        np.testing.assert_allclose(angular, rate, atol=2e-3)
        np.testing.assert_allclose(linear, speed, atol=2e-3)


def test_rows_see_the_room_when_they_are_exposed_and_the_judge_knows_the_truth(folder):
    moving, points = motions.read_aria(folder)
    camera = TrueCamera(readout_time=0.02)
    recording = motions.simulated("mini", moving, points, camera, 60, 0.2)
    assert len(recording.frames) == 18
    frame = recording.frames[4]
    time = 1e-9 * (frame.middle_ns - 10**12) + (frame.pixels[:, 1] / 479.0 - 0.5) * 0.02
    turns, places = moving.poses(time)
    shown = camera.project(np.einsum("nji,nj->ni", turns, frame.points - places))
    assert np.abs(shown - frame.pixels).max() < 1.5  # five deviations of the noise, and more
    rows = motions.judge(recording, moving)
    rows |= motions.at_any_time(recording, moving)
    for name in ("single", "tracked", "tracked, 1 later"):
        assert rows[name].localized == 18
        assert rows[name].errors[0, 0] < 0.3 * rows["solvepnp"].errors[0, 0]
        assert min(rows[name].inside) > 0.8
    assert rows["tracked, 1 later"].errors[2, 0] < rows["tracked"].errors[2, 0]
    for name in ("within rows", "between images", "10 ms ahead"):
        assert rows[name].localized >= 18
        assert rows[name].errors[0, 0] < 0.3 * rows["solvepnp"].errors[0, 0]
        assert min(rows[name].inside) > 0.75
    assert rows["30 ms ahead"].errors[0, 0] < 0.5 * rows["30 ms ahead, held"].errors[0, 0]
    assert motions.table(rows).text().count("\n") == len(rows)
