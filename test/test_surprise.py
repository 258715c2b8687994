# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What the tracker learns of a frame, against a Kalman filter that is known to be right."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from rs_localizer.core.scales import SCALES, Scales
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.experience import Experience
from rs_localizer.estimation.prior import Prior
from rs_localizer.tracking import _followed, _innovation, _Track

SCALES_SAID = Scales.nothing()._replace(means=np.full(SCALES, -6.0), precisions=np.ones(SCALES))
# Radians, metres, per readout and per readout squared.
UNITS = np.repeat([1e-2, 3e-2, 1e-3, 2e-3, 1e-4, 3e-4], 3)
START = Rotation.from_rotvec([0.4, -1.0, 0.2]).as_matrix()


def covariance(rng, size=1.0):
    root = rng.normal(size=(18, 18)) / np.sqrt(18) + np.eye(18)
    return size**2 * np.outer(UNITS, UNITS) * (root @ root.T)


def at(step, joint):
    """The estimate that lies a step (18,) from the prediction: turned and moved in its own axes."""
    turn = Rotation.from_rotvec(-step[:3]).as_matrix()
    rest = step[6:].reshape(4, 3)
    return Estimate(
        turn @ START, turn @ ([0.1, 0.2, 3.0] - step[3:6]), rest[0], rest[1],
        angular_acceleration=rest[2], linear_acceleration=rest[3],
        inliers=np.ones(5, dtype=bool), residuals=np.zeros(5), joint_covariance=joint,
        global_shutter_inliers=0, iterations=0,
        scales=SCALES_SAID,
    )  # fmt: skip


def predicted(spread):
    still = rsl.Motion(START, np.array([0.1, 0.2, 3.0]), np.zeros(3), np.zeros(3))
    return Prior(motion=still, covariance=spread)


def surprises(times, seen=slice(0, 18), frames=400, field=0.0):
    """Of motions that change ``times`` as much as predicted, of which part is measured.

    ``field``: error of a map, as many times the prediction's deviations, that the gain ignores.
    """
    rng = np.random.default_rng(0)
    # Small steps: what is not linear in them is left out of the filter here.
    prior, noise = (covariance(rng, size) for size in (1e-2, 5e-3))
    measured = np.eye(18)[seen]
    gain = prior @ measured.T @ np.linalg.inv(measured @ (prior + noise) @ measured.T)
    off = field**2 * prior
    posterior = prior - gain @ measured @ prior + gain @ measured @ off @ measured.T @ gain.T
    # Shaking behind the motion is none of its business.
    joint = np.eye(24)
    joint[:18, :18] = posterior
    found = []
    for _ in range(frames):
        truth = times * rng.multivariate_normal(np.zeros(18), prior)
        error = rng.multivariate_normal(np.zeros(18), noise)
        if field:
            error += rng.multivariate_normal(np.zeros(18), off)
        found.append(_innovation(predicted(prior), at(gain @ measured @ (truth + error), joint)))
    return np.array(found)


@pytest.mark.parametrize("seen", [slice(0, 18), slice(0, 6)], ids=["all", "pose"])
def test_a_motion_as_predicted_surprises_by_one(seen):
    assert np.mean(surprises(1.0, seen)) == pytest.approx(1.0, abs=0.1)


def test_larger_changes_surprise_by_their_square():
    calm, wild = (np.mean(surprises(times)) for times in (1.0, 5.0))
    assert 0.7 * 25 < wild / calm < 25
    assert np.mean(surprises(0.0)) < 0.5


@pytest.mark.parametrize("field", [2.0, 5.0, 20.0])
def test_a_map_that_is_off_hardly_surprises(field):
    assert 0.9 < np.mean(surprises(1.0, field=field)) < 2.5


def test_a_frame_that_decides_nothing_does_not_surprise():
    spread = covariance(np.random.default_rng(1))
    assert _innovation(predicted(spread), at(np.zeros(18), spread)) == pytest.approx(0.0, abs=1e-9)
    # Rounding errors are not divided by the nothing that was expected.
    assert np.all(_innovation(predicted(spread), at(1e-6 * UNITS, spread)) < 1e-6)


TURN = np.r_[0:3, 6:9, 12:15]
WAY = TURN + 3


def followed(times_deviation, tracked=True, jolts=1.0, of=None):
    spread = covariance(np.random.default_rng(2))
    first = at(np.zeros(18), 0.01 * spread)
    step = np.zeros(18)
    for part in (TURN, WAY) if of is None else (of,):
        along = np.linalg.cholesky(spread[np.ix_(part, part)])[:, 0]
        step[part] = times_deviation * np.sqrt(9.0) * along
    found = replace(at(step, 0.01 * spread), tracked=tracked,
                    inliers=np.array([True, False, False, False, False]))  # fmt: skip
    track = _Track(first, 0, 1.0, Experience.of(first), jolts * np.ones(2))
    return _followed(track, predicted(spread), found, 5)


def test_surprises_raise_what_is_expected_and_calm_lowers_it():
    assert followed(1.0).process_noise_scale == pytest.approx([1.0, 1.0], abs=0.01)
    # A turn by 0.3 rad, whose move is told about what the camera sees.
    assert followed(10.0).process_noise_scale == pytest.approx([10.0, 10.0], rel=0.03)
    assert followed(0.1, jolts=20.0).process_noise_scale == pytest.approx([2.0, 2.0], rel=0.02)
    # Never below what the configuration says, nor without bound.
    assert followed(0.0).process_noise_scale == pytest.approx([0.3, 0.3])  # a calm camera
    assert followed(100.0, jolts=9e3).process_noise_scale == pytest.approx([1e4, 1e4])


@pytest.mark.parametrize(("of", "raised"), [(TURN, 0), (WAY, 1)])
def test_turns_and_moves_surprise_apart(of, raised):
    jolts = followed(10.0, of=of).process_noise_scale
    assert jolts[raised] == pytest.approx(10.0, rel=0.02)
    assert jolts[1 - raised] <= 1.0


def test_a_first_frame_is_taken_as_it_is():
    found = at(np.zeros(18), np.eye(18))
    track = _followed(None, None, found, 7)
    assert track.experience.scales is found.scales
    assert (track.time_ns, track.share, *track.process_noise_scale) == (7, 1.0, 1.0, 1.0)


def test_the_share_of_inliers_follows_tracked_frames_slowly():
    assert followed(1.0).share == pytest.approx(0.7 * 1.0 + 0.3 * 0.2)
    assert followed(1.0, tracked=False).share == pytest.approx(0.2)
