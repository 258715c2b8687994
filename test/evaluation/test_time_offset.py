# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Clocks that differ are found from the motion; frames that differ are laid over each other."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer import data
from rs_localizer.evaluation.metrics import (
    aligned,
    angles_between,
    estimate_offset,
    interpolated,
    shifted,
)
from rs_localizer.io.trajectories import Trajectory, read_tum


@pytest.fixture(scope="module")
def truth() -> Trajectory:
    """Twelve seconds of a hand, at 120 Hz or so."""
    recorded = read_tum(data.path(data.HAND_MOTION))
    seconds = (recorded.stamps_ns - recorded.stamps_ns[0]) * 1e-9
    return recorded.part((seconds > 8.0) & (seconds < 20.0))


def estimate(truth: Trajectory, noise: float = 0.1) -> Trajectory:
    """30 Hz with noise in deg and cm."""
    rng = np.random.default_rng(0)
    stamps = truth.stamps_ns[0] + np.arange(1, 350) * 33_333_333
    part = interpolated(truth, stamps)[1]
    turned = Rotation.from_quat(part.quaternions) * Rotation.from_rotvec(
        np.radians(noise) * rng.normal(size=(len(part), 3))
    )
    positions = part.positions + 0.01 * noise * rng.normal(size=(len(part), 3))
    return Trajectory(part.stamps_ns, positions, turned.as_quat())


@pytest.mark.parametrize("offset", [0.0, 0.012, 1.0, -1.7e9])
def test_offsets_are_found(truth, offset):
    found = estimate_offset(shifted(estimate(truth), -offset), truth)
    assert found is not None
    assert found.seconds == pytest.approx(offset, abs=5e-4)
    assert found.correlation > 0.9
    assert found.after < 0.25
    if offset == 1.0:
        assert found.before > 5.0


def test_an_offset_is_found_in_another_frame(truth):
    """A map that was made elsewhere: the poses do not fit, their speeds do."""
    turn = Rotation.from_rotvec([0.3, -2.0, 1.0])
    other = Trajectory(
        truth.stamps_ns, turn.apply(truth.positions) + 5.0,
        (turn * Rotation.from_quat(truth.quaternions)).as_quat(),
    )  # fmt: skip
    found = estimate_offset(shifted(estimate(truth), 0.5), other)
    assert found is not None
    assert found.seconds == pytest.approx(-0.5, abs=0.02)


def test_another_motion_has_none(truth):
    recorded = read_tum(data.path(data.HAND_MOTION))
    seconds = (recorded.stamps_ns - recorded.stamps_ns[0]) * 1e-9
    other = recorded.part((seconds > 60.0) & (seconds < 70.0))
    assert estimate_offset(other, truth) is None
    assert estimate_offset(truth.part(slice(0, 3)), truth) is None


def test_positions_on_a_line_do_not_spoil_orientations(truth):
    """Along a straight way positions leave the turn about it open; orientations do not."""
    count = 100
    rng = np.random.default_rng(1)
    line = np.outer(np.linspace(0.0, 2.0, count), [1.0, 2.0, 0.5])
    stamps = np.arange(count, dtype=np.int64) * 10**7
    turns = Rotation.from_rotvec(0.5 * rng.normal(size=(count, 3)))
    true = Trajectory(stamps, line, turns.as_quat())
    turn = Rotation.from_rotvec([1.0, 0.4, -2.0])
    noisy = turns * Rotation.from_rotvec(np.radians(0.2) * rng.normal(size=(count, 3)))
    places = turn.apply(line + 1e-3 * rng.normal(size=line.shape)) + 3.0
    moved = Trajectory(stamps, places, (turn * noisy).as_quat())
    found = aligned(moved, true)
    assert np.median(angles_between(found.quaternions, true.quaternions)) < 0.5
    assert np.abs(found.positions - true.positions).max() < 0.01


def test_positions_decide_where_they_say_more():
    """Orientations all off by 10 deg, as between two bodies, do not tilt the map."""
    rng = np.random.default_rng(2)
    positions = rng.normal(size=(50, 3))
    turns = Rotation.random(50, random_state=0)
    stamps = np.arange(50, dtype=np.int64)
    true = Trajectory(stamps, positions, turns.as_quat())
    off = turns * Rotation.from_rotvec([np.radians(10.0), 0.0, 0.0])
    found = aligned(Trajectory(stamps, positions, off.as_quat()), true)
    np.testing.assert_allclose(found.positions, positions, atol=0.02)
