# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of known size are found, and the worst frame is in the picture."""

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.io.trajectories import Motions, Trajectory, Twists
from rs_localizer.tools import errors

RNG = np.random.default_rng(0)
STAMPS = 1_500_000_000_000_000_000 + np.arange(10, dtype=np.int64) * 33_333_333
TURNS = Rotation.from_quat(RNG.normal(size=(10, 4)))
TRUTH = Motions(
    Trajectory(STAMPS, RNG.normal(size=(10, 3)), TURNS.as_quat()),
    Twists(STAMPS, RNG.normal(size=(10, 3)), RNG.normal(size=(10, 3))),
)


def test_associate_takes_the_nearest_within_the_tolerance(monkeypatch):
    true = np.array([10, 20, 30, 40], np.int64)
    estimated = np.array([0, 8, 16, 25, 30, 33, 47], np.int64)
    monkeypatch.setattr(errors, "TOLERANCE_NS", 5)
    rows, true_rows = errors.associate(estimated, true)
    assert rows.tolist() == [1, 2, 3, 4, 5]
    assert true_rows.tolist() == [0, 1, 1, 2, 2]
    monkeypatch.setattr(errors, "TOLERANCE_NS", 0)
    rows, true_rows = errors.associate(estimated, true)
    assert (rows.tolist(), true_rows.tolist()) == ([4], [2])


def test_errors_have_the_units_of_the_table():
    # Rotations about different axes by 5 degrees, in the body's own axes; a sign means nothing.
    axes = RNG.normal(size=(10, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turned = TURNS * Rotation.from_rotvec(np.radians(5.0) * axes)
    moved = Trajectory(STAMPS, TRUTH.poses.positions + 0.02 * axes, -turned.as_quat())
    angular = TRUTH.twists.angular + np.array([0.0, 0.03, 0.04])
    off = Twists(STAMPS, angular, TRUTH.twists.linear - np.array([0.6, 0, 0.8]))
    found = errors.errors_of(Motions(moved.part(slice(3, 6)), off), TRUTH)
    for kind, error in zip(errors.UNITS, (0.02, 5.0, np.degrees(0.05), 1.0), strict=True):
        np.testing.assert_allclose(found[kind].values, error)
    np.testing.assert_array_equal(found["position"].stamps_ns, STAMPS[3:6])
    assert list(errors.errors_of(Motions(moved, None), TRUTH)) == ["position", "orientation"]


def test_picture_has_a_colored_curve_for_each_method(tmp_path):
    values = np.full(400, 0.01)
    values[77] = 30.0
    one = errors.Errors(np.arange(400) * 10**8, values)
    found = {"position": one, "orientation": one}
    errors.draw({"ours": found, "p3p": found}, tmp_path / "both.png")
    errors.draw({"ours": found}, tmp_path / "one.png")
    both, alone = (cv2.imread(str(tmp_path / name)) for name in ("both.png", "one.png"))
    assert both.shape == alone.shape
    orange = both[..., 2].astype(int) - both[..., 0] > 60
    assert orange.sum() > 1000
    assert not (alone[..., 2].astype(int) - alone[..., 0] > 60).any()
