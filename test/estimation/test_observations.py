# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Packed points, and a part of them."""

import numpy as np

from rs_localizer.core.rig import Mounts
from rs_localizer.estimation.observations import Observations


def test_a_part_of_the_points_is_what_packing_it_gives():
    rng = np.random.default_rng(0)
    given = (
        rng.normal(size=(101, 3)), rng.normal(size=(101, 2)), rng.uniform(-0.5, 0.5, 101),
        rng.normal(size=(101, 2, 2)),
    )  # fmt: skip
    mounts = Mounts.one(np.array([0.0, 0.002]))
    for count, every in ((101, 1), (51, 2), (21, 5), (2, 100)):
        part = Observations.of(*given, mounts).thinned(count)
        alone = Observations.of(*[values[::every] for values in given], mounts)
        assert len(part) == len(alone) == count
        np.testing.assert_array_equal(part.packed, alone.packed)
        state = np.concatenate([np.eye(3).ravel(), [0.0, 0.0, 9.0], 0.01 * np.ones(12)])
        np.testing.assert_array_equal(part.squared_errors(state), alone.squared_errors(state))
