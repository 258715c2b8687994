# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Points just beyond the gate: vibration, or another group of points."""

import numpy as np

from rs_localizer.estimation.first_look import near_outliers
from rs_localizer.estimation.residuals import Lines


def test_points_that_are_shifted_alike_are_no_vibration():
    """A fifth of the matches, in any rows."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        errors = rng.normal(0.0, 0.5, (100, 2))
        errors[:20] += [6.0, 5.0]
        tau = rng.uniform(-0.5, 0.5, 100)
        lines = Lines(
            errors, np.zeros((100, 2, 18)), np.zeros((100, 2, 3)), tau, np.zeros((100, 2))
        )
        squared = np.sum(errors**2, axis=1)
        assert near_outliers(lines, squared, squared < 16.0, 2.0) == 0
