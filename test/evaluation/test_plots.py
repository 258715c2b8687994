# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What pictures show: ranges that one outlier does not stretch."""

import numpy as np

from rs_localizer.evaluation import plots
from rs_localizer.evaluation.metrics import Errors
from rs_localizer.io.trajectories import Trajectory

COUNT = 200
RNG = np.random.default_rng(0)
STAMPS = np.arange(COUNT, dtype=np.int64) * 33_000_000
WAY = np.cumsum(0.02 * RNG.normal(size=(COUNT, 3)), axis=0)
STILL = np.tile([0.0, 0.0, 0.0, 1.0], (COUNT, 1))


def test_one_outlier_stretches_no_axis():
    far = WAY.copy()
    far[50] = [400.0, -300.0, 90.0]
    figure = plots.trajectories(None, {"r6p_vcwt": Trajectory(STAMPS, far, STILL)})
    for axes, other in zip(figure.axes, (1, 2), strict=True):
        for limits, column in ((axes.get_xlim(), 0), (axes.get_ylim(), other)):
            assert limits[1] - limits[0] < 3 * np.ptp(WAY[:, [0, other]], axis=0).max()
            assert limits[0] < np.median(WAY[:, column]) < limits[1]
    sizes = np.abs(RNG.normal(size=COUNT))
    large = np.where(np.arange(COUNT) == 50, 1e6, sizes)
    figure = plots.errors({"r6p_vcwt": Errors(STAMPS, large, sizes, sizes)}, {})
    assert figure.axes[0].get_ylim()[1] < 100 * 1e3 * sizes.max()  # mm
