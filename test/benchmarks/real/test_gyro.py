# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The judge before a gyroscope, on a miniature that the independent simulator makes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.aided import believed
from benchmarks.independent import motions
from benchmarks.independent.cameras import Camera as TrueCamera
from benchmarks.independent.frames import Frames, simulate
from benchmarks.independent.scenes import Rich
from benchmarks.real import __main__ as command
from benchmarks.real.gyro import judge
from benchmarks.real.gyroscopes import Gyroscope, aligned
from benchmarks.real.peers import PEERS, solve_pnp
from benchmarks.real.recordings import Frame, Recording, read_bag
from rs_localizer.config import CalibrationErrors, NodeConfig
from rs_localizer.io.bags import BagWriter
from rs_localizer.io.recording import (
    CAMERA_INFO_TOPIC,
    CORRESPONDENCES_TOPIC,
    make_camera_info,
    make_correspondences,
)

TRUE, LENGTH = TrueCamera(), 8
CAMERA, EXACT = believed(TRUE, 0.0), CalibrationErrors(0.0, 0.0, 0.0, 0.0)
CONFIG = NodeConfig(readout_time=TRUE.readout_time, calibration=EXACT)


@pytest.fixture(scope="module")
def frames() -> Frames:
    return simulate(TRUE, motions.hand, Rich(80), 1, LENGTH, seed=3)


@pytest.fixture(scope="module")
def recording(frames, tmp_path_factory):
    path = tmp_path_factory.mktemp("gyro") / "rec"
    with BagWriter(path) as bag:
        for k in range(LENGTH):
            points, pixels = frames.seen(k, 0.1)
            stamp, ids = int(frames.stamp_ns[k]), np.arange(len(points))
            bag.write(CAMERA_INFO_TOPIC, make_camera_info(CAMERA, stamp), stamp)
            cloud = make_correspondences(stamp, points, pixels, ids)
            bag.write(CORRESPONDENCES_TOPIC, cloud, stamp)
    return path


def exact(frames) -> Gyroscope:
    """Motions are made of the same seed as the frames."""
    moving = motions.hand(1, np.random.default_rng(3))
    start = -0.5e-9 * (frames.stamp_ns[-1] - frames.stamp_ns[0]) - 0.5 * TRUE.readout_time
    local = np.arange(start - 0.1, -start + 0.1, 1e-3)
    rates = moving.states(np.zeros(len(local), np.int64), local).angular
    return Gyroscope(local - start + 1e-9 * frames.stamp_ns[0], rates)


def test_mean_rates_are_those_of_the_turn_between_two_times():
    times = np.linspace(0.0, 1.0, 1001)
    rates = np.column_stack([times, 2.0 * np.ones_like(times), -times])
    mean = Gyroscope(times, rates).mean_rate(np.array([0.2]), np.array([0.6]))
    np.testing.assert_allclose(mean, [[0.4, 2.0, -0.4]], atol=1e-12)


def test_right_twists_are_near_and_turned_round_ones_far(recording, frames, tmp_path, capsys):
    read, gyroscope = read_bag(recording, CONFIG), exact(frames)
    rows = judge(read, gyroscope, CONFIG).rows
    for name in ("single", "tracked"):
        assert rows[name].localized == LENGTH
        assert rows[name].twist[0] < 1.5
        assert rows[name].between[0] < 0.5
        assert 0.3 < rows[name].ratio < 4.0
        assert rows[name].near > 0.98
    assert rows["single"].between[0] < 0.3 * rows["solvepnp"].between[0]
    backwards = judge(read, Gyroscope(gyroscope.times, -gyroscope.rates), CONFIG).rows
    assert backwards["single"].twist[0] > 20.0
    assert backwards["single"].inside < 0.2
    text = tmp_path / "gyroscope.txt"
    np.savetxt(text, np.column_stack([gyroscope.times, gyroscope.rates]), fmt="%.9f")
    command.main(["gyro", str(recording), "--gyroscope", str(text), "--out", str(tmp_path),
                  "-p", f"readout_time:={TRUE.readout_time}"])  # fmt: skip
    assert capsys.readouterr().out.count("\n") == 1 + len(PEERS) + 4 + 3 + 1
    assert (tmp_path / "gyro.png").stat().st_size > 10_000


def test_clock_axes_and_bias_of_a_gyroscope_are_found():
    frames = simulate(TRUE, motions.hand, Rich(80), 1, 60, seed=3)
    middle = round(0.5e9 * TRUE.readout_time)
    images = [Frame(int(frames.stamp_ns[k]) + middle, *frames.seen(k, 0.1)) for k in range(60)]
    truth, mount = exact(frames), Rotation.from_rotvec([0.3, -1.2, 2.0])
    moved = Gyroscope(truth.times - 0.037, mount.apply(truth.rates) + np.array([0.01, -0.02, 0.03]))
    found, said = aligned(moved, Recording("mini", CAMERA, images))
    assert "+3" in said
    np.testing.assert_allclose(found.times, truth.times, atol=1e-3)
    assert np.degrees(np.median(np.linalg.norm(found.rates - truth.rates, axis=1))) < 0.5
    with pytest.raises(ValueError, match="7 pairs of neighbours are localized, 20 are needed"):
        aligned(moved, Recording("short", CAMERA, images[:8]))


@pytest.mark.parametrize("name", PEERS)
def test_peers_find_a_still_camera(name):
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.0, -1.0, 3.0], [1.0, 1.0, 5.0], (60, 3))
    pixels = CAMERA.project(points)
    pose = PEERS[name](CAMERA, points, pixels)
    np.testing.assert_allclose(pose.rotation, np.eye(3), atol=1e-4)
    np.testing.assert_allclose(pose.position, 0.0, atol=1e-3)
    assert pose.residuals.max() < 0.1
    assert solve_pnp(CAMERA, points[:3], pixels[:3]) is None
