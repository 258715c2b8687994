# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""All that the points leave possible: rest and motion, in-frame turns, and wrong maps."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from rs_localizer.estimation.acceptance import refusal
from rs_localizer.estimation.hypotheses import frame_posterior

from ..moving import board, squared  # noqa: TID252 - Python has a package "test"
from .frames import ASSUMED, PRIOR, changed, distance, fitted, frame, observe
from .projection import disturbed

PARTS = slice(0, 6), slice(6, 12)  # pose and velocities


def settled(seed, speed, noise=0.5, **more):
    observations, truth = frame(seed, speed, noise, **more)
    return frame_posterior(observations, truth, PRIOR, 2.0, ASSUMED), truth


@pytest.mark.parametrize("frames", [30, pytest.param(60, marks=pytest.mark.bench)])
def test_at_rest_the_truth_is_covered(frames):
    resting = [settled(seed, 0.0) for seed in range(frames)]
    poses, twists = (np.array([distance(*case, part) for case in resting]) for part in PARTS)
    assert np.median(poses) < 6.6  # 5.35 of six parameters
    assert np.mean(poses < chi2.ppf(0.95, 6)) > 0.88
    # The region of the velocities holds zero, and says so of every frame but few.
    assert np.mean(twists < chi2.ppf(0.95, 6)) > 0.9


def turns(posterior):
    """Whether zero lies outside of the 95 % region of the velocities."""
    region = posterior.covariance[6:12, 6:12]
    return squared(posterior.state[12:18], region) > chi2.ppf(0.95, 6)


@pytest.mark.parametrize("frames", [10, pytest.param(20, marks=pytest.mark.bench)])
def test_a_bent_board_at_rest_does_not_turn(frames):
    """Its map says that it is flat: 40 corners 0.5 m wide, 1 m away, bent by 2 mm."""
    flat = board(8, 5, 0.5, 0.36)
    bent = flat + np.outer(2e-3 * (1 - (flat[:, 0] / 0.25) ** 2), [0.0, 0.0, 1.0])
    fooled, turning = 0, 0
    for seed in range(frames):
        turn = np.random.default_rng(seed).uniform(-0.5, 0.5, 3)
        rotation = Rotation.from_rotvec(turn).as_matrix()
        state = np.concatenate([rotation.ravel(), [0.0, 0.0, 1.0], np.zeros(12)])
        observations = observe(state, bent, 0.1, seed, seen_as=flat)
        fooled += turns(fitted(observations, state, PRIOR, 2.0))
        turning += turns(frame_posterior(observations, state, PRIOR, 2.0, ASSUMED))
    assert fooled > frames / 2  # the best motion alone
    assert turning <= frames / 10


SWING = np.radians(0.3) * np.array([[0.6, 0.8, 0.3], [-0.8, 0.6, 0.2]])


def shaken(seed, cycles=4.0, swings=SWING, noise=0.2, wrong=0, count=80):
    """Observations of a wave beside a motion, and the motion (24,); some points are wrong.

    The wave is a cosine and a sine of so many cycles per readout.
    """

    def wave(tau):
        angle = 2.0 * np.pi * cycles * tau[:, None]
        return np.cos(angle) * swings[0] + np.sin(angle) * swings[1]

    observations, state = frame(seed, 0.02, noise, count, swing=wave)
    if not wrong:
        return observations, state
    points = observations.points.copy()
    points[:wrong] += np.random.default_rng(seed).uniform(-2.0, 2.0, (wrong, 3))
    return changed(observations, points), state


def at_the_middle(state, cycles, swings):
    """The motion (24,) at the middle row: turned by the wave, and turning with it."""
    step = np.zeros(18)
    step[:3], step[6:9] = swings[0], 2.0 * np.pi * cycles * swings[1]
    return disturbed(state, step)


@pytest.mark.parametrize("frames", [8, pytest.param(40, marks=pytest.mark.bench)])
def test_a_vibrating_camera_stays_in_its_region(frames):
    """0.3 deg at 60 Hz in 0.1 px of noise, which one frame of eight takes for noise."""
    squared, noises = [], []
    for seed in range(frames):
        rng = np.random.default_rng(seed + 500)
        axis, phase = rng.normal(size=3), rng.uniform(0.0, 2.0 * np.pi)
        axis *= np.radians(0.3) / np.linalg.norm(axis)
        swings = np.outer([np.cos(phase), np.sin(phase)], axis)
        observations, state = shaken(seed, 1.8, swings, 0.1, count=100)
        found = frame_posterior(observations, state, PRIOR, 2.0, ASSUMED)
        truth = at_the_middle(state, 1.8, swings)
        squared.append([distance(found, truth, part) for part in PARTS])
        noises.append(found.noise)
        assert np.count_nonzero(~found.inliers) < 5
    assert np.mean(np.abs(np.array(noises) - 0.1) < 0.03) >= 0.85
    assert (np.mean(np.array(squared) < chi2.ppf(0.95, 6), axis=0) >= 0.85).all()


def test_of_very_many_points_of_a_vibrating_camera_the_inliers_are_kept():
    """More than are fitted: the others are judged with what the camera turns beside its motion."""
    observations, state = shaken(1, 1.8, count=3000)
    found = frame_posterior(observations, state, PRIOR, 2.0, ASSUMED)
    assert len(found.shake)
    assert np.count_nonzero(found.inliers) > 0.98 * 3000
    assert np.sqrt(found.squared_errors[found.inliers].mean() / 2) == pytest.approx(0.2, rel=0.1)


def test_of_very_many_points_rounding_leaves_none_out():
    for seed in range(6):
        observations, state = frame(seed, 0.02, 0.5, count=2600)
        found = frame_posterior(observations, state, PRIOR, 1.0, ASSUMED)
        again = frame_posterior(changed(observations, rounded=1e-15), state, PRIOR, 1.0, ASSUMED)
        assert 2000 < np.count_nonzero(found.inliers) < 2600
        np.testing.assert_array_equal(found.inliers, again.inliers)


@pytest.mark.parametrize(
    ("count", "wrong", "published"),
    [
        (20, 4, 0),
        pytest.param(16, 0, 0, marks=pytest.mark.bench),
        pytest.param(40, 8, 6, marks=pytest.mark.bench),
    ],
)
def test_few_points_of_a_vibrating_camera_are_refused_or_covered(count, wrong, published):
    """Six pixels of swing, where points within four may count as inliers of a motion alone.

    Of 40 points with eight wrong ones most frames are followed.
    """
    squared = []
    for seed in range(10):
        observations, state = shaken(seed, 3.0, 2.0 * SWING, 0.5, wrong, count)
        start = fitted(observations, state, PRIOR, 8.0)
        found = frame_posterior(observations, start.state, PRIOR, 2.0, ASSUMED)
        if refusal(found, 0, min_inliers=12, threshold=2.0, rolling=True) is not None:
            continue
        squared.append(distance(found, at_the_middle(state, 3.0, 2.0 * SWING), slice(0, 12)))
    assert len(squared) >= published
    beyond = np.array(squared) > chi2.ppf(0.95, 12)
    assert beyond.sum() <= max(1, 0.2 * len(squared))
    assert max(squared, default=0.0) < chi2.isf(5.7e-7, 12)  # five sigma
