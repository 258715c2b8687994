# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The paper's real experiment, on a miniature."""

import numpy as np
import pytest

from benchmarks.independent import motions
from benchmarks.independent.cameras import Camera as TrueCamera
from benchmarks.independent.frames import simulate
from benchmarks.independent.scenes import Rich
from benchmarks.real import solvers
from benchmarks.real.recordings import Frame, Recording
from rs_localizer.config import LocalizerConfig
from rs_localizer.core.camera import Camera

TRUE = TrueCamera()


@pytest.fixture(scope="module")
def recording():
    frames = simulate(TRUE, motions.hand, Rich(60), 1, 2, seed=3)
    camera = Camera(TRUE.width, TRUE.height, K=TRUE.matrix, D=np.array(TRUE.distortion),
                    readout_time=TRUE.readout_time)  # fmt: skip
    seen = [Frame(frames.middle_ns(k), *frames.seen(k, 0.2)) for k in range(2)]
    return Recording("mini", camera, seen)


def test_minimal_models_differ_and_estimates_do_not(recording):
    before = solvers.minimal(recording, recording.frames)
    config = LocalizerConfig()
    after = {name: solvers.refined(recording, recording.frames, config, name)
             for name in ("r6p_vcwt", "r9p")}  # fmt: skip
    near = {name: np.mean(np.concatenate(errors) < 1.0) for name, errors in before.items()}
    assert near["r6p_vcwt"] > near["p3p"] + 0.1
    for one, other in zip(*after.values(), strict=True):
        np.testing.assert_allclose(one, other, atol=0.02)
        assert np.mean(one < 1.0) > 0.98
    peers = {"solvepnp": solvers.peer(recording, recording.frames, "solvepnp")}
    chosen = {name: before[name] for name in after}
    lines = solvers.text(chosen, after, peers).splitlines()
    assert [line.split("|")[1].strip() for line in lines[2:]] == ["`r6p_vcwt`", "`r9p`", "solvepnp"]
