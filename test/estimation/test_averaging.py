"""What is the same, or would become it."""

import numpy as np
import pytest

from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.averaging import on_the_way
from rs_localizer.estimation.refine import apply_step


@pytest.mark.parametrize(("deviations", "ends_there"), [(0.9, True), (1.1, False)])
def test_within_a_standard_deviation_a_state_ends_at_the_best_one(deviations, ends_there):
    rng = np.random.default_rng(0)
    best = np.concatenate([np.eye(3).ravel(), [0.0, 0.0, 2.0], np.zeros(12)])
    # Radians and metres, known to very different parts; and velocities that a prior holds.
    sizes = np.repeat([1e-3, 1e-5, 1e-2, 1e-9, 1e-9, 1e-9], 3)
    factor = sizes[:, None] * (np.eye(PARAMETERS) + 0.1 * rng.normal(size=(PARAMETERS, PARAMETERS)))
    direction = rng.normal(size=PARAMETERS)
    step = factor @ direction * (deviations / np.linalg.norm(direction))
    assert on_the_way(apply_step(best, step), best, factor @ factor.T) == ends_there
