# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What frames tell the next ones, by the settings."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import rs_localizer as rsl
from rs_localizer.core.reasons import Reason
from rs_localizer.core.scales import Scales
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.tracking import Memory, Tracker

SAID = Scales.nothing()._replace(size=np.array([-6.0, 1.0]))
CAMERA = rsl.Camera(width=640, height=480, K=np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]))


class Answering(rsl.Localizer):
    """Remembers the priors that it is asked with."""

    def __init__(self, answers: list[Any]) -> None:
        super().__init__(CAMERA)
        self.priors, self.answers = list[Any](), iter(answers)

    def find(self, *arguments: Any, **_: Any) -> Any:
        self.priors.append(arguments[3] if len(arguments) > 3 else None)
        return next(self.answers)

    def accepted(self, result: Any) -> Any:
        return result


RNG = np.random.default_rng(0)
POINTS, PIXELS = RNG.uniform(1.0, 3.0, (8, 3)), RNG.uniform(0.0, 480.0, (8, 2))
LOCALIZED = Estimate(
    rotation=np.eye(3),
    translation=np.zeros(3),
    angular_velocity=np.zeros(3),
    linear_velocity=np.zeros(3),
    inliers=np.ones(8, dtype=bool),
    residuals=np.ones(8),
    joint_covariance=1e-4 * np.eye(18),
    iterations=10,
    scales=SAID,
)
REFUSED = Failure(Reason.NO_HYPOTHESIS, "")


def test_the_next_frame_knows_what_the_last_one_with_a_pose_said_until_reset():
    """One that is refused is also looked at without, here twice in vain."""
    localizer = Answering([LOCALIZED, REFUSED, REFUSED, LOCALIZED, LOCALIZED])
    frames = Tracker(localizer, memory=Memory.MAP_AND_LENS)
    for _ in range(3):
        frames.localize(0, POINTS, PIXELS)
    assert [prior is None for prior in localizer.priors] == [True, False, True, False]
    for prior in localizer.priors[1::2]:
        assert prior.motion is None
        assert prior.scales.size[0] == pytest.approx(-6.0)
        assert prior.scales.size[1] >= 1.0
    frames.reset()
    frames.localize(0, POINTS, PIXELS)
    assert localizer.priors[4] is None


def test_what_was_learned_is_forgotten_where_a_frame_fits_only_without():
    """A hand bends a board, and lets it go: no frame after it may be refused for that."""
    other = replace(LOCALIZED, scales=Scales.nothing())
    localizer = Answering([LOCALIZED, REFUSED, other, LOCALIZED])
    frames = Tracker(localizer, memory=Memory.MAP_AND_LENS)
    assert all(frames.localize(0, POINTS, PIXELS) for _ in range(3))
    np.testing.assert_allclose(localizer.priors[-1].scales.size, 0.0)
