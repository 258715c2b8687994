# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""After warming up no frame waits for the compiler, and what is no camera is said to be none."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import rs_localizer as rsl
from rs_localizer.estimation import frame_posterior

# In a process of its own: what other tests have compiled in this one is no longer missing.
LATE = """
import gc
from numba.core.registry import CPUDispatcher
from rs_localizer.config import NodeConfig
from benchmarks.frames.conditions import conditions
from benchmarks.frames.judged import judge
from rs_localizer.pipeline.frames import FrameLocalizer

def compiled():
    ours = [k for k in gc.get_objects() if isinstance(k, CPUDispatcher)]
    return {(k.__module__, k.__name__, str(s)) for k in ours for s in k.signatures}

FrameLocalizer(NodeConfig()).warm_up_rest()
before = compiled()
for condition in [one for one in conditions() if one.bench != "axis"][::6]:
    judge(condition, 1, 3, {})
after = compiled()
assert len(after) > 50
for late in sorted(after - before):
    print(*late)
"""
K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize("direction", ["top_to_bottom", "right_to_left"])
def test_shaking_is_followed_once(direction, monkeypatch):
    """Its kernels are those that an ordinary frame does not need."""
    fits = []
    fit = frame_posterior.fit_turn

    def watched(*arguments):
        fits.append(fit(*arguments))
        return fits[-1]

    monkeypatch.setattr(frame_posterior, "fit_turn", watched)
    camera = rsl.Camera(640, 480, K, readout_time=0.02, scan_direction=direction)
    rsl.Localizer(camera).warm_up()
    assert any(one.finite and one.gain > 0.0 for one in fits)


def test_no_frame_waits_for_the_compiler():
    """Slow and fast, few points and thousands, planes and rooms, alone and in tracking."""
    ran = subprocess.run(
        [sys.executable, "-c", LATE], cwd=Path(__file__).parents[1],
        capture_output=True, text=True, timeout=200, check=True,
    )  # fmt: skip
    assert [line for line in ran.stdout.splitlines() if line.startswith("rs_localizer.")] == []
