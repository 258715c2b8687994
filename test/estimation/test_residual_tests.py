# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Tests of what a model leaves of a frame."""

import numpy as np
import pytest

from rs_localizer.estimation.residual_tests import neighbours_agree


def test_neighbours_agree_where_errors_are_shared_and_not_where_they_are_noise():
    rng = np.random.default_rng(5)
    tau, everything = rng.uniform(-0.5, 0.5, 60), np.ones(60, dtype=bool)
    rays = np.column_stack([rng.uniform(-0.6, 0.6, 60), tau])
    noise = np.array(
        [neighbours_agree(rng.normal(size=(60, 2)), tau, rays, everything) for _ in range(3000)]
    )
    assert abs(noise.mean()) < 0.1
    assert noise.std() == pytest.approx(1.0, abs=0.06)
    shared = np.column_stack([np.sin(9 * tau), np.cos(9 * tau)]) + rng.normal(size=(60, 2))
    assert neighbours_agree(shared, tau, rays, everything) > 2.5
    # Rows that do not count stand between no neighbours.
    strewn = np.where(np.arange(60)[:, None] % 3, shared, 100.0 * rng.normal(size=(60, 2)))
    counting = np.arange(60) % 3 > 0
    assert neighbours_agree(strewn, tau, rays, counting) == pytest.approx(
        neighbours_agree(strewn[counting], tau[counting], rays[counting], everything[counting])
    )
    assert neighbours_agree(shared, tau, rays, ~everything) == 0.0
    # Nor do those that stand together in the image.
    corner = np.where(np.arange(60)[:, None] == 0, 1.0, 0.001 * rays)
    assert abs(neighbours_agree(shared, tau, corner, everything)) < 2.0
