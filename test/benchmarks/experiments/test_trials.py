# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The synthetic scene against the camera equations, point by point."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.experiments.trials import Setting, Trials, draw_trials


def bearings(trials: Trials, i: int, linear_in_camera: bool) -> np.ndarray:
    """Where the truth of frame i puts its points at their own row times."""
    truth = trials.truth
    r, c, w, t = truth.rotation[i], truth.translation[i], truth.w[i], truth.t[i]
    seen = []
    for x, tau in zip(trials.points[i], trials.tau[i], strict=True):
        turn = Rotation.from_rotvec(tau * w)
        if linear_in_camera:
            p = turn.apply(r @ x) + c + tau * t
        else:
            # The centre moves straight: by -tau s in the camera axes of the middle row, where
            # t = s + w x C.
            s = t - np.cross(w, c)
            p = turn.apply(r @ x + c + tau * s)
        seen.append(p[:2] / p[2])
    return np.array(seen)


@pytest.mark.parametrize("drifting", [False, True])
def test_points_are_seen_at_their_own_row(drifting):
    trials = draw_trials(5, 0, Setting(25.0, 0.2, 0.0, drifting))
    for i in range(5):
        np.testing.assert_allclose(trials.rays[i], bearings(trials, i, drifting), atol=1e-9)
