# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The benches judge rightly: honest estimates pass, and each kind of lie is seen."""

from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.frames.judged import FIVE_SIGMA, REGION
from benchmarks.honesty.scores import Score, Scores, Truth, score
from rs_localizer.io.outputs import Pose, Twist


def published(rng: np.random.Generator, wider: float = 1.0) -> Score:
    """A pose and twist drawn from their covariances, which are then multiplied."""
    spread = rng.normal(size=(6, 6)) * np.repeat([1e-3, 1e-2], 3)[:, None]
    covariance = spread @ spread.T
    truth = Truth(
        Rotation.random(random_state=rng.integers(2**31)).as_matrix(),
        rng.normal(size=3), rng.normal(size=3), rng.normal(size=3),
    )  # fmt: skip
    way, turn = np.split(spread @ rng.normal(size=6), 2)
    pose = Pose(
        truth.position - way,
        # In the fixed axes of the map, as REP-103's covariances.
        Rotation.from_rotvec(-turn).as_matrix() @ truth.rotation,
        covariance * wider,
    )
    linear, angular = np.split(spread @ rng.normal(size=6), 2)
    twist = Twist(truth.linear - linear, truth.angular - angular, covariance * wider)
    return score(pose, twist, truth, int(rng.integers(2**31)))


@cache
def scores(wider: float) -> Scores:
    rng = np.random.default_rng(0)
    return Scores([published(rng, wider) for _ in range(2000)])


def test_truths_drawn_from_the_covariance_lie_inside():
    honest = scores(1.0)
    for part in ("pose", "twist"):
        assert np.mean(honest.of(part) < REGION) == pytest.approx(0.95, abs=0.012)
    assert honest.of("pose").max() < FIVE_SIGMA


@pytest.mark.parametrize(("wider", "least", "most"), [(0.5, 0.5, 0.7), (3.0, 0.99, 1.0)])
def test_too_small_and_too_large_covariances_are_seen(wider, least, most):
    for part in ("pose", "twist"):
        assert least < np.mean(scores(wider).of(part) < REGION) <= most
