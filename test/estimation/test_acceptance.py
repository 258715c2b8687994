# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What is refused, reason by reason: posteriors that are right but for one thing."""

from types import SimpleNamespace

import numpy as np
import pytest

from rs_localizer.core.reasons import Reason
from rs_localizer.estimation.acceptance import refusal, speeding
from rs_localizer.estimation.prior import motion_terms

from .frames import fitted, frame

PRIOR = motion_terms((0.18, 0.09), (0.009, 0.0036))
THRESHOLD = 2.0
ELEVEN = np.arange(40) < 11


@pytest.fixture
def good():
    observations, truth = frame(0, 0.15, 0.3, count=40)
    return fitted(observations, truth, PRIOR, THRESHOLD)._replace(gate=THRESHOLD)


def reason(posterior):
    failure = refusal(posterior, 64, min_inliers=12, threshold=THRESHOLD, rolling=True)
    return None if failure is None else failure.reason


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, None),
        ({"inliers": ELEVEN}, Reason.TOO_FEW_INLIERS),
        (
            {"inliers": ELEVEN, "squared_errors": np.where(ELEVEN, 0.1, np.inf)},
            Reason.BEHIND_CAMERA,
        ),
        ({"smallest_eigenvalue": 1e-13}, Reason.DEGENERATE),
        # Errors as large as the gate.
        ({"noise": 1.45}, None),
        ({"noise": 1.55}, Reason.RESIDUAL),
    ],
)
def test_what_is_wrong_with_a_posterior_is_its_reason(good, changes, expected):
    assert reason(good._replace(**changes)) is expected


@pytest.mark.parametrize("part", ["state", "covariance"])
def test_what_cannot_be_computed_is_no_motion(good, part):
    lost = getattr(good, part).copy()
    lost.flat[-1] = np.nan
    assert reason(good._replace(**{part: lost})) is Reason.DEGENERATE


def test_speeding_counts_what_the_configuration_expects():
    state, information = np.zeros(24), np.zeros((18, 18))
    state[12:15], state[15:18] = (0.2, 0.0, -0.1), (0.0, 0.03, 0.0)
    np.fill_diagonal(information[6:9, 6:9], 0.1**-2)
    np.fill_diagonal(information[9:12, 9:12], 0.01**-2)
    observed = SimpleNamespace(rotation=None, terms=SimpleNamespace(informations=[information]))
    assert speeding(observed, state) == pytest.approx(5.0 + 9.0)
    observed.rotation = "of a gyroscope"
    assert speeding(observed, state) == pytest.approx(9.0)
