# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What frames tell the next ones, by the settings."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import rs_localizer as rsl
from rs_localizer.config import NodeConfig
from rs_localizer.core.reasons import Reason
from rs_localizer.core.scales import SCALES, Scales
from rs_localizer.core.types import Failure
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.tracking import Memory, Tracker

SAID = Scales.nothing()._replace(means=np.full(SCALES, -6.0), precisions=np.ones(SCALES))
CAMERA = rsl.Camera(width=640, height=480, K=np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))


def test_the_next_frame_knows_what_the_last_one_with_a_pose_said_until_reset():
    priors: list[Any] = []
    said = {"scales": SAID, "lens": None, "of_lens": None}
    results: list[Any] = [SimpleNamespace(**said)] * 3
    results.insert(1, Failure(Reason.NO_HYPOTHESIS, ""))

    class Answering(rsl.Localizer):
        def find(self, points: Any, pixels: Any, scores: Any, prior: Any, *_: Any) -> Any:
            priors.append(prior)
            return results[len(priors) - 1]

        def accepted(self, result: Any) -> Any:
            return result

    frames = Tracker(Answering(CAMERA), memory=Memory.MAP_AND_LENS)
    for _ in range(3):
        frames.localize(0, [], [])
    assert priors[0] is None
    for prior in priors[1:]:
        assert prior.motion is None
        np.testing.assert_allclose(prior.scales.means, -6.0)
        assert prior.scales.precisions.min() >= 1.0
    frames.reset()
    frames.localize(0, [], [])
    assert priors[3] is None


@pytest.mark.parametrize(
    ("settings", "memory"),
    [
        ({}, Memory.MAP_AND_LENS),
        ({"readout_time": 0.02}, Memory.MOTION),
        ({"tracking": False}, Memory.NOTHING),
        ({"tracking": False, "readout_time": 0.02}, Memory.NOTHING),
        ({"solver": "p3p"}, Memory.NOTHING),
    ],
)
def test_the_settings_say_what_is_remembered(monkeypatch, settings, memory):
    chosen = []

    def make(localizer, inertial, memory):
        chosen.append(memory)
        return Tracker(localizer, inertial, memory)

    monkeypatch.setattr("rs_localizer.pipeline.frames.Tracker", make)
    FrameLocalizer(NodeConfig(**settings))
    assert chosen == [memory]


def test_only_a_remembered_motion_predicts():
    frames = Tracker(rsl.Localizer(CAMERA), memory=Memory.MAP_AND_LENS)
    assert frames.prediction(0) is None
    with pytest.raises(ValueError, match="needs the readout time"):
        Tracker(rsl.Localizer(CAMERA))
