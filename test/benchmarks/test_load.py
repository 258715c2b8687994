# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The load benchmark counts what it sends; its figures are no matter of tests."""

import numpy as np
import pytest

from benchmarks.load.frames import simulated
from benchmarks.load.measuring import steady


@pytest.mark.bench
def test_every_frame_is_accounted_for():
    frames = simulated(points=60, outliers=0.2, rate=20.0, different=40, imu_rate=200.0)
    (result,) = steady(frames, cameras=1, count=60)
    assert result.frames == 60
    # On a busy machine frames are replaced, and some sensor data may be lost.
    assert result.answered > 0
    assert result.lost <= 5
    assert len(result.latencies) == result.answered
    assert np.all(result.latencies > 0.0)
    assert np.all(result.memory > 50.0)
    assert 0.0 < result.cpu < 2.0
    assert result.imu.endswith("%")
