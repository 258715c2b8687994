# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""After warming up no frame waits for the compiler, and what is no camera is said to be none."""

import subprocess
import sys
from pathlib import Path

# In a process of its own: what other tests have compiled in this one is no longer missing.
LATE = """
import gc
import numpy as np
from numba.core.registry import CPUDispatcher
from rs_localizer.config import NodeConfig
from benchmarks.frames.conditions import conditions
from benchmarks.frames.judged import judge
from rs_localizer.inertial.buffer import ReadingBuffer, Readings
from rs_localizer.pipeline.frames import FrameLocalizer

def compiled():
    ours = [k for k in gc.get_objects() if isinstance(k, CPUDispatcher)]
    return {(k.__module__, k.__name__, str(s)) for k in ours for s in k.signatures}

FrameLocalizer(NodeConfig()).warm_up_rest()
FrameLocalizer(NodeConfig(readout_time=0.02)).warm_up_imu()
before = compiled()
readings = ReadingBuffer()
for k in range(9):
    readings.add(k * 2_000_000, "imu", np.ones(3))
assert isinstance(readings.between(4_000_000, 8_000_000), Readings)
for condition in [one for one in conditions() if one.bench not in ("axis", "boards")][::6]:
    judge(condition, 1, 3, {})
after = compiled()
assert len(after) > 50
for late in sorted(after - before):
    print(*late)
"""


def test_no_frame_waits_for_the_compiler():
    """Slow and fast, few points and thousands, planes and rooms, alone and in tracking."""
    ran = subprocess.run(
        [sys.executable, "-c", LATE], cwd=Path(__file__).parents[1],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert [line for line in ran.stdout.splitlines() if line.startswith("rs_localizer.")] == []
