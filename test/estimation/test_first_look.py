# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The first look at a frame, and vibration that no frame shows."""

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks.frames.conditions import HAND, Condition, moving
from benchmarks.frames.judged import judge
from benchmarks.independent.scenes import Rich
from rs_localizer.estimation.first_look import near_outliers
from rs_localizer.estimation.residuals import Lines


def scored(motion, noise):
    """Squared normalised errors of pose at the first row and of the twist, 60 frames."""
    condition = Condition("own", "", motion, Rich(), noise)
    found = judge(condition, 60, 4, {})
    return found, np.array([found.of("pose_s"), found.of("twist")]).T


def test_regions_hold_for_vibration_that_no_frame_shows():
    """A tenth of a degree at 20 Hz, which the rows hardly tell from a steady turn."""
    _, squared = scored(moving("vibration", degrees=0.1, hertz=20.0), 0.3)
    # Without, 68 % of the twists (benchmarks.frames, sine/0.1deg/20Hz/0.3px, seed 1).
    inside = np.mean(squared < chi2.ppf(0.95, 6), axis=0)
    assert (inside >= 0.85).all(), inside


def test_a_calm_hand_is_not_said_to_shake():
    found, squared = scored(HAND, 0.3)
    assert (np.mean(squared < chi2.ppf(0.95, 6), axis=0) >= 0.93).all()
    # Claimed over actual deviation of the turn rate, three dimensions.
    assert np.sqrt(chi2.median(3) / np.median(found.of("angular"))) < 1.7


@pytest.mark.parametrize(
    ("inliers", "near", "told"),
    [(12, 3, 3), (13, 2, 0), (16, 4, 0), (20, 4, 0), (20, 5, 5), (40, 7, 0), (40, 8, 8)],
)
def test_points_just_beyond_the_gate_are_told_unless_they_are_one_marker(inliers, near, told):
    """Distances up to 3 and of 12 px around a gate of 4 px, and of wrong points at 100."""
    count = inliers + near + 6
    tau = np.linspace(-0.5, 0.5, count)
    errors = np.zeros((count, 2))
    errors[:, 0] = np.repeat([0.0, 12.0, 100.0], [inliers, near, 6])
    errors[:inliers, 0] = np.linspace(0.0, 3.0, inliers)
    squared = np.sum(errors**2, axis=1)
    lines = Lines(
        errors, np.zeros((count, 2, 18)), np.zeros((count, 2, 3)), tau, np.zeros((count, 2))
    )
    assert near_outliers(lines, squared, squared < 16.0, 2.0) == told


def test_points_that_are_shifted_alike_are_no_vibration():
    """A fifth of the matches, in any rows."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        errors = rng.normal(0.0, 0.5, (100, 2))
        errors[:20] += [6.0, 5.0]
        tau = rng.uniform(-0.5, 0.5, 100)
        lines = Lines(
            errors, np.zeros((100, 2, 18)), np.zeros((100, 2, 3)), tau, np.zeros((100, 2))
        )
        squared = np.sum(errors**2, axis=1)
        assert near_outliers(lines, squared, squared < 16.0, 2.0) == 0
