# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames of the second simulator: scenes as described, conventions as the estimator has them."""

from functools import partial

import numpy as np
import pytest

from benchmarks.honesty.estimating import believed, scored
from benchmarks.independent.cameras import Camera, Scan
from benchmarks.independent.frames import simulate
from benchmarks.independent.motions import rest, steady
from benchmarks.independent.scenes import Board, Rich
from rs_localizer.localizer import Localizer


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
    moving = partial(steady, rate=1.5, speed=0.7)
    frames = simulate(Camera(scan=scan), moving, Rich(), 4, 1, 0)
    camera = believed(frames.camera)
    localizer = Localizer(camera)
    results = {k: localizer.localize(*frames.seen(k, 0.0)) for k in range(4)}
    found = scored(frames, results, camera)
    for scores in (found.stamp, found.middle):
        assert scores.localized.all()
        assert scores.of("orientation").max() < 2e-3
        assert scores.of("position").max() < 1e-4
        assert scores.of("angular").max() < 0.3
        assert scores.of("linear").max() < 0.01
