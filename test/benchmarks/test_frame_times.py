# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from benchmarks.frame_times import main


@pytest.mark.bench
def test_frames_are_timed_and_slow_ones_profiled_apart(tmp_path, capsys):
    """Few frames before an IMU's delay is known: with and without one."""
    file = tmp_path / "times.npy"
    main(["--frames", "8", "--points", "60", "--runs", "1", "--imu", "200", "--save", str(file)])
    printed = capsys.readouterr().out
    assert "CPU time, ms: p50 " in printed
    assert "ordinary frames:" in printed
    assert "slow frames:" in printed
    assert "tracked, shaking of" in printed
    assert "with the IMU" in printed
    times = np.load(file)
    assert len(times) == 8
    assert np.all(times > 0.0)
