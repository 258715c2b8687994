# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses in any map before motion capture of a body: on a miniature of TUM-RS' layout."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.real import __main__ as command
from benchmarks.real.mocap import errors
from rs_localizer.io.trajectories import Trajectory, Twists, write_tum, write_twists

START_NS = 1_520_000_000_000_000_000
MOUNTED, LEVER = Rotation.from_rotvec([1.0, -0.5, 2.0]), np.array([0.1, -0.05, 0.02])
TURNED, MOVED, SCALE = Rotation.from_rotvec([0.2, 2.0, -0.3]), np.array([3.0, -1.0, 0.5]), 2.5


def turn(t):
    return Rotation.from_rotvec(
        np.column_stack([0.4 * np.sin(3.0 * t), 0.5 * np.sin(2.0 * t), 0.3 * np.cos(2.5 * t)])
    )


def place(t):
    return np.column_stack([0.5 * np.sin(2.0 * t), 0.3 * t, 0.4 * np.cos(3.0 * t)])


def in_map(t):
    """Of the camera: pose, and velocities in its axes by finite differences."""
    h, body = 1e-5, turn(t)
    orientation = TURNED * body * MOUNTED
    at = SCALE * TURNED.apply(place(t) + body.apply(LEVER)) + MOVED
    return orientation, at, h


@pytest.fixture
def folders(tmp_path):
    """``mav0/mocap0/data.csv`` at 120 Hz, and what replay writes at 20 Hz."""
    truth, t = tmp_path / "data.csv", np.arange(0.0, 3.0, 1.0 / 120.0)
    lines = ["#timestamp [ns],p_RS_R_x [m],y,z,q_RS_w [],x,y,z"]
    for time, where, q in zip(t, place(t), turn(t).as_quat(), strict=True):
        numbers = (*where, q[3], *q[:3])
        lines.append(f"{START_NS + round(1e9 * time)},{','.join(f'{x:.9f}' for x in numbers)}")
    truth.write_text("\n".join(lines))
    poses, t = tmp_path / "poses", np.arange(0.2, 2.8, 0.05)
    poses.mkdir()
    orientation, at, h = in_map(t)
    (after, there, _), (before, back, _) = in_map(t + h), in_map(t - h)
    angular = (before.inv() * after).as_rotvec() / (2.0 * h)
    linear = orientation.inv().apply(there - back) / (2.0 * h)
    stamps = START_NS + np.round(1e9 * t).astype(np.int64)
    write_tum(poses / "poses.txt", Trajectory(stamps, at, orientation.as_quat()))
    write_twists(poses / "twists.txt", Twists(stamps, angular, linear))
    return poses, truth


def test_mount_map_and_scale_are_found_and_errors_are_those_of_the_rest(folders, capsys):
    poses, truth = folders
    assert np.all(np.percentile(errors(poses, truth), 95, axis=0) < [0.02, 1.0, 1.5, 0.02])
    lines = (poses / "twists.txt").read_text().splitlines()
    words = [line.split() for line in lines]
    (poses / "twists.txt").write_text(
        "\n".join(
            line if line.startswith("#") else " ".join([w[0], repr(float(w[1]) + 0.1), *w[2:]])
            for line, w in zip(lines, words, strict=True)
        )
    )
    assert np.median(errors(poses, truth)[:, 2]) == pytest.approx(np.degrees(0.1), abs=0.5)
    command.main(["mocap", str(poses), str(truth)])
    assert "| poses | 52 |" in capsys.readouterr().out


def test_another_clock_is_named(folders, tmp_path):
    poses, truth = folders
    later = tmp_path / "later.csv"
    later.write_text(truth.read_text().replace("\n152", "\n162"))
    with pytest.raises(ValueError, match=r"0 of 52 poses lie within .* another clock"):
        errors(poses, later)
