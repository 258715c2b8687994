# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A rolling camera beside a global one before motion capture, on a rendered miniature."""

import miniatures
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.__main__ import main
from benchmarks.independent import motions
from benchmarks.independent.cameras import Camera as TrueCamera
from benchmarks.independent.frames import simulate
from benchmarks.independent.scenes import Rich
from benchmarks.real.motion import EPOCH_NS
from benchmarks.real.tum_rs import read_sequence
from rs_localizer.config import NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter
from rs_localizer.io.recording import write_frame

READOUT, PERIOD, LENGTH = 0.03, 1.0 / 20.0, 30
SINCE = 1_536_000_000.0
BODY_FROM_CAMERA = Rotation.from_euler("xyz", [3.0, -4.0, 90.0], degrees=True)


@pytest.fixture(scope="module")
def body():
    return miniatures.in_hand((1.0, 0.3, 1.0), 8, 1.5)


@pytest.fixture(scope="module")
def rolling(body):
    """The motion of the rolling camera, turned and aside of the body."""
    return miniatures.Mounted(body, BODY_FROM_CAMERA.as_matrix(), np.array([0.05, 0.02, -0.01]))


@pytest.fixture(scope="module")
def sequence(body, rolling, tmp_path_factory):
    folder = tmp_path_factory.mktemp("tum") / "dataset-seq1"
    room = miniatures.papered()
    beside = miniatures.Mounted(body, BODY_FROM_CAMERA.as_matrix(), np.array([-0.05, 0.02, -0.01]))
    cameras = {
        "cam0": (TrueCamera(320, 240, 260.0, readout_time=0.0), beside),
        "cam1": (TrueCamera(320, 240, 265.0, readout_time=READOUT), rolling),
    }
    films = {
        name: miniatures.film(LENGTH, camera, room, motion, PERIOD, samples=1)
        for name, (camera, motion) in cameras.items()
    }
    miniatures.write_tum_rs(folder, body, films)
    return folder


def test_the_truth_is_the_motion_of_the_rolling_camera(sequence, body, rolling):
    chain = sequence / "dso" / "camchain.yaml"
    config = NodeConfig(readout_time=READOUT)
    recording, truth = read_sequence(sequence, chain, config, 0.3 - 0.1, 0.9)
    assert len(recording.frames) == 17
    frame = recording.frames[12]
    time = 1e-9 * frame.middle_ns - SINCE
    assert time == pytest.approx(12 * PERIOD + 0.5 * READOUT, abs=1e-6)
    rotations, places = rolling.poses(np.zeros(1, int), np.array([time]))
    found, there = truth.poses(np.array([1e-9 * (frame.middle_ns - EPOCH_NS)]))
    off = Rotation.from_matrix(found[0].T @ rotations[0]).magnitude()
    assert np.degrees(off) < 0.02
    np.testing.assert_allclose(there[0], places[0], atol=3e-4)
    rate, _ = truth.twist(1e-9 * (frame.middle_ns - EPOCH_NS))
    true = BODY_FROM_CAMERA.inv().apply(body.states(np.zeros(1, int), np.array([time])).angular[0])
    np.testing.assert_allclose(np.degrees(rate), np.degrees(true), atol=1.5)
    # A landmark is on a wall of the room.
    walls = np.abs(np.abs(np.concatenate([one.points for one in recording.frames])) - 1.8)
    assert np.median(walls.min(axis=1)) < 0.01


def test_ours_and_p3p_stand_beside_each_other(sequence, capsys):
    words = ["real", "tum-rs", str(sequence), "-p", f"readout_time:={READOUT}"]
    assert main(words) == 0
    lines = capsys.readouterr().out.splitlines()
    cells = {line[:16].strip(): line[16:].replace(",", "").split() for line in lines[1:-2]}
    single, later, solvepnp = (cells[name] for name in ("single", "tracked, 1 later", "solvepnp"))
    assert int(single[0]) == int(later[0]) == LENGTH
    for column in (1, 3):  # medians: deg, mm
        assert float(single[column]) < float(solvepnp[column]) / 3.0
        assert float(later[column]) < float(solvepnp[column])
    assert float(later[5]) < 6.0  # deg/s, of up to 84
    assert lines[-2].startswith(f"{LENGTH} images")
    assert "another one" not in lines[-1]


def test_motion_capture_of_your_own(tmp_path, capsys):
    true, length = TrueCamera(), 8
    frames = simulate(true, motions.hand, Rich(80), 1, length, seed=3)
    camera = Camera(true.width, true.height, K=true.matrix, D=np.array(true.distortion))
    with BagWriter(tmp_path / "rec") as bag:
        for k in range(length):
            points, pixels = frames.seen(k, 0.1)
            write_frame(
                bag, camera, int(frames.stamp_ns[k]), points, pixels, np.arange(len(points))
            )
    # Motions are made of the same seed as the frames; their time 0 is the middle of the recording.
    first = -0.5e-9 * (frames.stamp_ns[-1] - frames.stamp_ns[0]) - 0.5 * true.readout_time
    local = np.arange(first - 0.3, -first + 0.3, 1.0 / 120.0)
    rotations, places = motions.hand(1, np.random.default_rng(3)).poses(
        np.zeros(len(local), int), local
    )
    times = local - first + 1e-9 * frames.stamp_ns[0]
    poses = np.column_stack([times, places, Rotation.from_matrix(rotations).as_quat()])
    np.savetxt(tmp_path / "poses.txt", poses, fmt="%.9f")
    words = ["real", "mocap", str(tmp_path / "rec"), "--truth", str(tmp_path / "poses.txt")]
    assert main([*words, "-p", f"readout_time:={true.readout_time}"]) == 0
    rows = {line[:16].strip(): line[16:].replace(",", "").split()
            for line in capsys.readouterr().out.splitlines()}  # fmt: skip
    single, solvepnp = rows["single"], rows["solvepnp"]
    assert int(single[0]) == length
    assert float(single[1]) < 0.3 * float(solvepnp[1])  # deg
    assert float(single[5]) < 5.0  # deg/s


def test_what_is_missing_is_said(sequence, tmp_path, capsys):
    assert main(["real", "tum-rs", str(sequence)]) == 1
    assert "-p readout_time:=" in capsys.readouterr().err
    assert main(["real", "tum-rs", str(tmp_path), "-p", "readout_time:=0.03"]) == 1
    assert "camchain.yaml is missing" in capsys.readouterr().err
