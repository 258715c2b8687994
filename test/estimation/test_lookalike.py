"""Planes before which a camera that moves sees what one at rest sees."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.averaging import longest_axis
from rs_localizer.estimation.lookalike import holding_motion
from rs_localizer.estimation.modes import Mode

STATE = np.concatenate([np.eye(3).ravel(), [0.0, 0.0, 2.0], np.zeros(12)])
PUBLISHED = np.diag(np.repeat([0.03, 0.01, 0.02, 0.1, 0.1, 0.1], 3)) ** 2


def mode(speed, cost, deviation=0.05, seed=0):
    """A Gaussian about the state whose axes are any."""
    root = deviation * np.random.default_rng(seed).normal(size=(40, PARAMETERS)) / math.sqrt(40)
    return Mode(STATE, root.T @ root, -cost, 0.0, cost, speed, 0.0)


def least_of(covariance):
    """The least variance of anything."""
    return np.linalg.eigvalsh(covariance).min()


def test_it_stays_as_it_is_where_the_camera_clearly_moves() -> None:
    modes = [mode(0.0, 120.0), mode(1.0, 100.0)]
    assert holding_motion(modes, STATE, PUBLISHED) is PUBLISHED
    assert holding_motion([mode(0.0, 100.0)], STATE, PUBLISHED) is PUBLISHED
    assert holding_motion([mode(0.0, 100.0), mode(1.0, 120.0)], STATE, PUBLISHED) is PUBLISHED


@pytest.mark.parametrize("seed", range(5))
def test_it_holds_the_motion_but_for_the_longest_turn(seed) -> None:
    moving = mode(1.0, 101.0, seed=seed)
    found = holding_motion([mode(0.0, 100.0), moving], STATE, PUBLISHED)
    assert least_of(found - PUBLISHED) > -1e-12  # wider in every direction
    assert longest_axis(found) == pytest.approx(longest_axis(PUBLISHED), rel=0.02)
    beside = np.arange(3, 12)  # what is no turn, whatever the turn is
    given = [np.linalg.inv(np.linalg.inv(one)[np.ix_(beside, beside)])
             for one in (found[:12, :12], moving.covariance[:12, :12])]  # fmt: skip
    assert least_of(given[0] - given[1]) > 0.0
