# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What is refused, reason by reason: posteriors that are right but for one thing."""

from dataclasses import replace

import numpy as np
import pytest

from rs_localizer.core.reasons import Reason
from rs_localizer.core.rig import Mounts
from rs_localizer.estimation.acceptance import refusal, uncertain
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.posterior import Mirror, maximum_a_posteriori
from rs_localizer.estimation.prior import motion_terms
from rs_localizer.localizer import Localizer

PRIOR = motion_terms((0.18, 0.09), (0.009, 0.0036))
THRESHOLD = 2.0


@pytest.fixture
def good(scene):
    camera, motion, points, _, measured = scene.frame(noise=0.3, count=40)
    rays = camera.rays(measured)
    observations = Observations.of(
        points, rays, camera.row_time(measured), camera.pixel_jacobian(rays),
        Mounts.one(camera.row_time_gradient),
    )  # fmt: skip
    return observations, maximum_a_posteriori(
        observations, scene.state_of(motion), PRIOR, THRESHOLD
    )


def reason(observations, posterior, rolling=True):
    failure = refusal(
        observations, posterior, 64, min_inliers=12, threshold=THRESHOLD, rolling=rolling
    )
    return None if failure is None else failure.reason


def with_state(posterior, place, values):
    state = posterior.state.copy()
    state[place] = values
    return replace(posterior, state=state)


def test_a_good_posterior_is_accepted(good):
    assert reason(*good) is None


def test_too_few_inliers(good):
    observations, posterior = good
    eleven = np.arange(len(observations)) < 11
    assert reason(observations, replace(posterior, inliers=eleven)) is Reason.TOO_FEW_INLIERS
    behind = np.where(eleven, 0.1, np.inf)
    lost = replace(posterior, inliers=eleven, squared_errors=behind)
    assert reason(observations, lost) is Reason.BEHIND_CAMERA


def test_points_that_do_not_determine_the_motion(good):
    observations, posterior = good
    flat = replace(posterior, smallest_eigenvalue=1e-13)
    assert reason(observations, flat) is Reason.DEGENERATE


@pytest.mark.parametrize("part", ["state", "covariance"])
def test_what_cannot_be_computed_is_no_motion(good, part):
    observations, posterior = good
    lost = getattr(posterior, part).copy()
    lost.flat[-1] = np.nan
    assert reason(observations, replace(posterior, **{part: lost})) is Reason.DEGENERATE


@pytest.mark.parametrize(
    ("rolling", "noise", "expected"),
    [
        (True, 1.45, None), (True, 1.55, Reason.RESIDUAL),
        (False, 1.95, None), (False, 2.05, Reason.RESIDUAL),
    ],
)  # fmt: skip
def test_errors_as_large_as_the_gate(good, rolling, noise, expected):
    observations, posterior = good
    assert reason(observations, replace(posterior, noise=noise), rolling) is expected


def test_errors_that_neighbouring_rows_share(good):
    observations, posterior = good
    shaking = replace(posterior, agreement=4.3)
    assert reason(observations, shaking) is Reason.MODEL_ERROR
    assert reason(observations, replace(posterior, agreement=4.1)) is None
    assert reason(observations, shaking, rolling=False) is None
    # Below a twentieth of the threshold no pose suffers.
    assert reason(observations, replace(shaking, noise=0.09)) is None


def test_points_just_beyond_the_gate(good):
    observations, posterior = good
    assert reason(observations, replace(posterior, near_outliers=5)) is Reason.MODEL_ERROR


def test_errors_that_are_smooth_over_the_image(good):
    observations, posterior = good
    assert reason(observations, replace(posterior, model_error=0.89)) is None
    assert reason(observations, replace(posterior, model_error=0.91)) is Reason.MODEL_ERROR


def test_motions_that_no_camera_makes(good):
    observations, posterior = good
    rolled = with_state(posterior, slice(12, 15), [0.0, 0.0, 1.6])  # about the line of sight
    assert reason(observations, rolled) is Reason.IMPLAUSIBLE
    assert reason(observations, with_state(posterior, slice(12, 15), [0.0, 0.0, 1.4])) is None
    advances = with_state(posterior, slice(15, 18), [0.0, 0.0, 5.0])  # the points are 4 m away
    assert reason(observations, advances) is Reason.IMPLAUSIBLE


def test_an_image_that_moves_along_with_its_rows(good, scene):
    observations, posterior = good
    camera = scene.frame()[0]
    # In a readout the rows pass over the image's height: so does a point of a camera that turns so.
    height = camera.height / camera.focal_length
    along = [with_state(posterior, slice(12, 15), [turn, 0.0, 0.0]) for turn in (height, -height)]
    assert sorted(str(reason(observations, one)) for one in along) == ["None", "implausible"]


@pytest.mark.parametrize(
    ("turn", "covered", "expected"),
    [
        (0.19, False, None), (0.21, False, Reason.MIRRORED),
        (0.34, True, None), (0.36, True, Reason.MIRRORED),
    ],
)  # fmt: skip
def test_a_mirrored_pose_that_fits_as_well(good, turn, covered, expected):
    observations, posterior = good
    step = np.zeros(18)
    step[1] = turn
    doubtful = replace(posterior, mirror=Mirror(step, 1.0, covered))
    assert reason(observations, doubtful) is expected


def test_an_orientation_that_is_hardly_known(scene):
    camera, _, points, _, measured = scene.frame(noise=0.3, count=40)
    found = Localizer(camera).localize(points, measured)
    assert found
    known = found.orientation_deviation
    worst = np.linalg.eigvalsh(found.covariance[:3, :3])[-1]
    assert known == pytest.approx(np.sqrt(worst))
    assert uncertain(found, 1.01 * known) is None
    still = found.still_deviation
    assert still < known
    assert uncertain(found, 0.99 * still).reason is Reason.UNCERTAIN
    told = replace(found, still_deviation=0.1 * known)  # but for what the motion leaves open
    assert uncertain(told, 0.35 * known) is None
    assert uncertain(told, 0.33 * known).reason is Reason.UNCERTAIN
    refused = Localizer(camera, max_orientation_deviation=max(0.001, 0.9 * still))
    if still > 0.0012:
        assert refused.localize(points, measured).reason is Reason.UNCERTAIN
