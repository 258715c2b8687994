# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames of the second simulator: scenes as described, conventions as the estimator has them."""

import numpy as np
import pytest

from benchmarks.frames.conditions import Condition, moving
from benchmarks.frames.judged import judge
from benchmarks.independent.cameras import Camera, Scan
from benchmarks.independent.frames import simulate
from benchmarks.independent.motions import rest
from benchmarks.independent.scenes import Board, Rich


def test_a_bent_board_is_flat_in_its_map_only():
    flat, bent = (simulate(Camera(), rest, Board(bend=bend), 5, 1, 0) for bend in (0.0, 0.002))
    np.testing.assert_array_equal(flat.points, bent.points)
    moved = np.linalg.norm(flat.exact - bent.exact, axis=-1)
    sides = [0, 8, 45, 53]  # corners of the 9 x 6 grid
    assert moved[:, sides].max() < 1e-9
    assert moved.max() > 0.05


@pytest.mark.parametrize("scan", list(Scan))
def test_the_estimator_finds_the_truth_of_exact_pixels(scan):
    # Steady motion, which every version of the estimator models: signs, axes and moments agree.
    motion = moving("steady", rate=1.5, speed=0.7)
    condition = Condition("exact", "any", motion, Rich(), 0.0, camera=Camera(scan=scan))
    found = judge(condition, 4, 0, {})
    assert found.localized.all()
    for name, most in {"deg_s": 2e-3, "deg": 2e-3, "mm": 0.1, "deg/s": 0.3, "m/s": 0.01}.items():
        assert found.of(name).max() < most, name
