# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A lens that is off is found with the motion, and nothing else is taken for one.

Frames come from the independent simulator, which shares no line with the estimator.
"""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.frames.conditions import Condition, moving
from benchmarks.frames.generated import generate
from benchmarks.frames.judged import camera_of
from benchmarks.honesty.estimating import believed, estimate, frames_of, scored, truth_of
from benchmarks.independent.cameras import Camera
from benchmarks.independent.motions import hand, vibration
from benchmarks.independent.rotations import logarithm
from benchmarks.independent.scenes import Rich, Wall
from rs_localizer.core.lens import LensError
from rs_localizer.core.reasons import Reason
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.experience import Experience
from rs_localizer.estimation.lens import decided, joined, odds_of, refuted
from rs_localizer.estimation.posterior import Posterior
from rs_localizer.estimation.prior import Prior
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline.pose_at_time import pose_at
from rs_localizer.tracking import Tracker


def frames(make_motions=hand, scene=None, seed=3, length=8):
    return frames_of(Camera(), make_motions, scene or Rich(), 5, seed, length)


def lacking(share):
    """Localizer of a camera without that share of its distortion, and the coefficients."""
    true = Camera()
    corner = 0.5 * np.hypot(true.width, true.height) / true.focal
    k1, k2, p1, p2, _ = true.distortion
    lacks = share * np.array([k1 * corner**2, k2 * corner**4, p1 * corner, p2 * corner])
    localizer = Localizer(believed(true, distortion_off=share))
    return localizer, np.concatenate([lacks, np.zeros(4)])  # focal lengths and centre are right


@pytest.mark.parametrize("share", [0.03, 0.3])
def test_single_frames_find_the_lens_and_their_poses_hold(share):
    seen = frames()
    localizer, lacks = lacking(share)
    results = estimate(seen, localizer, 0.1, tracking=False)
    for frame, found in results.items():
        assert found, found
        off = found.lens.mean - lacks
        assert off @ np.linalg.solve(found.lens.covariance, off) < 26.1  # once in a thousand
        pose, truth = pose_at(found, 0.0), truth_of(seen.middle, frame)
        turn = np.degrees(np.linalg.norm(logarithm(truth.rotation @ pose.rotation.T)))
        assert turn < 0.4  # who does not know the centre of the image, does not know its axis
    found = scored(seen, results, localizer.camera)
    assert found.stamp.inside("pose").sum() >= 4
    assert found.middle.inside("twist").sum() >= 4


def test_right_lenses_shaking_and_bent_walls_are_no_lens():
    right, _ = lacking(0.0)
    for motion, noise in ((hand, 1.0), (lambda n, rng: vibration(n, rng, 1.0, 100.0), 0.1)):
        results = estimate(frames(motion), right, noise, tracking=False)
        assert all(results.values())
        # One frame of five that shakes is taken for a lens by a single image.
        assert sum(result.lens is not None for result in results.values()) <= 1
    # A wall that a lens bends, and one that is rolled up: one looks like the other.
    wall = frames(scene=Wall())
    off, _ = lacking(0.1)
    assert {r.reason for r in estimate(wall, off, 0.1, False).values()} == {Reason.MODEL_ERROR}
    local = (wall.points - wall.middle.position[:, None]) @ wall.middle.rotation
    local[..., 2] += 0.05 * (local[..., 0] / local[..., 2]) ** 2
    bent = local @ np.swapaxes(wall.middle.rotation, 1, 2) + wall.middle.position[:, None]
    results = list(estimate(replace(wall, points=bent), right, 0.1, False).values())
    refused = [result.reason for result in results if not result]
    assert refused == [Reason.MODEL_ERROR] * len(refused)
    assert len(refused) >= 3
    assert not any(result.lens for result in results if result)


def test_a_turn_within_the_frame_is_no_lens():
    """Of 40 frames 23 were found with one: beside the lens a turn was fitted, without it none."""
    condition = Condition("own", "", moving("vibration", degrees=0.3, hertz=50.0), Rich(40), 0.3)
    localizer = Localizer(camera_of(condition, 0))
    found = [localizer.localize(one.points, one.pixels) for one in generate(condition, 20, 5)]
    published = [one for one in found if one]
    assert len(published) > 15
    assert all(one.lens is None for one in published)


def test_a_tracker_learns_what_single_frames_do_not_tell():
    seen = frames(length=24)
    localizer, lacks = lacking(0.03)
    tracker = Tracker(localizer)
    found = [tracker.localize(seen.middle_ns(frame), *seen.seen(frame, 1.0)) for frame in range(24)]
    assert found[0].lens is None
    assert found[-1].lens is not None
    # Where the two powers differ least: at the corners, to half a pixel of 400.
    assert sum(found[-1].lens.mean[:2]) == pytest.approx(sum(lacks[:2]), abs=1.2e-3)


OTHERS = [0.01, 0.01, 0.025, 0.025]  # deviations of focal lengths and centre


def gaussian(mean, deviation):
    """Of focal lengths and centre as little is known as of any calibration."""
    return LensError(
        np.array([*mean, 0.0, 0.0, 0.0, 0.0]), np.diag(np.square([*deviation, *OTHERS])), 400.0
    )


def test_frames_are_joined_by_their_information():
    prior = np.diag(1.0 / np.square([0.05, 0.05, *OTHERS]))
    one, other = gaussian([0.01, 0.0], [0.01, 0.02]), gaussian([0.03, 0.01], [0.02, 0.01])
    both = joined(one, other, 0.5)
    old, new = (np.linalg.inv(lens.covariance) for lens in (one, other))
    np.testing.assert_allclose(
        np.linalg.inv(both.covariance), 0.5 * (old - prior) + (new - prior) + prior
    )
    pulled = 0.5 * old @ one.mean + new @ other.mean
    np.testing.assert_allclose(np.linalg.solve(both.covariance, both.mean), pulled)


def test_odds_are_for_lenses_that_are_off_by_many_deviations():
    assert odds_of(gaussian([0.0, 0.0], [1e-3, 1e-3])) < -1.0
    assert abs(odds_of(gaussian([0.0, 0.0], [0.0499, 0.0499]))) < 0.1  # nothing is known
    assert odds_of(gaussian([0.02, 0.0], [1e-3, 1e-3])) > 100.0


def says(lens=None, used=None):
    return Estimate(
        rotation=np.eye(3), translation=np.zeros(3), angular_velocity=np.zeros(3),
        linear_velocity=np.zeros(3), inliers=np.ones(12, bool), residuals=np.zeros(12),
        joint_covariance=np.eye(18), global_shutter_inliers=12, iterations=0,
        lens=used, of_lens=lens,
    )  # fmt: skip


def test_experience_asks_now_and_then_and_forgets_a_lens_that_frames_do_without():
    experience, asked = Experience.of(says()), []
    for _ in range(33):
        asked.append(experience.prior.asks_lens)
        assert experience.prior.lens is None
        experience = experience.and_of(says())
    assert sum(asked) == 2
    off = gaussian([0.02, 0.0], [1e-3, 1e-3])
    experience = experience.and_of(says(off))
    known = experience.prior.lens
    assert known is not None
    assert experience.and_of(says(None, known)).prior.lens is not None  # says nothing, uses it
    assert experience.and_of(says()).prior.lens is None


@pytest.mark.parametrize(
    ("change", "coefficients"),
    [
        ([[0.0, 0.0, 10.0], [0.0, 0.0, -5.0]], [0.0, 0.0, -10.0, 5.0]),
        ([[0.01, 0.0, 0.0], [0.0, 0.01, 0.0]], [-0.01, -0.01, 0.0, 0.0]),
    ],
    ids=["centre", "focal lengths"],
)
def test_focal_lengths_and_centre_are_found_as_well(change, coefficients):
    """Once they were taken for distortion, with poses beyond any region."""
    right, _ = lacking(0.0)
    camera, seen = right.camera, frames(length=5)
    change = np.array(change)
    change[:, :2] *= np.diag(camera.K)[:2]
    off = replace(camera, K=camera.K + np.vstack([change, np.zeros(3)]))
    results = estimate(seen, Localizer(off), 0.1, tracking=False)
    lenses = [found.lens for found in results.values() if found]
    assert len(lenses) >= 4
    lacks = np.array(coefficients)
    lacks[2:] /= 0.5 * np.hypot(camera.width, camera.height)
    for lens in lenses:
        error = (lens.mean - np.concatenate([np.zeros(4), lacks]))[4:]
        assert error @ np.linalg.solve(lens.covariance[4:, 4:], error) < 18.5
    scores = scored(seen, {k: found for k, found in results.items() if found}, off)
    assert scores.stamp.inside("pose").all()
    assert scores.middle.inside("pose").all()


def test_trackers_do_not_use_a_lens_that_no_lens_is():
    for mean, used in (([0.02, 0.0, 1.4e-3, 0.0], True), ([0.02, 0.0, 0.0, -1.6e-3], False)):
        experience = Experience.of(says(gaussian(mean, [1e-3, 1e-3, 1e-5, 1e-5])))
        assert (experience.prior.lens is not None) == used
        assert experience.prior.asks_lens != used


def test_twelve_points_tell_no_lens():
    """Of 26 numbers, those of motion and lens, 24 equations tell nothing."""
    seen, asked = frames(), Prior(asks_lens=True)
    localizer, _ = lacking(0.0)
    for frame in range(4):
        points, pixels = seen.seen(frame, 0.3)
        many = localizer.localize(points, pixels, prior=asked)
        chosen = np.linspace(0, len(points) - 1, 20).astype(int)
        few = localizer.localize(points[chosen], pixels[chosen], prior=asked)
        assert many.of_lens is not None
        assert not few or few.of_lens is None


def test_a_lens_that_a_frame_contradicts_is_not_believed():
    """Three bad frames may have told of it; the first right one does without."""
    seen = frames()
    localizer, _ = lacking(0.0)
    wrong = gaussian([0.03, 0.0], [1e-3, 1e-3])
    wrong = replace(
        wrong,
        mean=np.concatenate([wrong.mean[:2], np.zeros(6)]),
        covariance=np.diag(np.square([1e-3, 1e-3, 5e-4, 5e-4, *OTHERS])),
    )
    for frame in range(3):
        points, pixels = seen.seen(frame, 0.3)
        found = localizer.localize(points, pixels, prior=Prior(lens=wrong))
        assert found
        assert found.lens is None
    off, _ = lacking(0.3)
    points, pixels = seen.seen(0, 0.3)
    right = off.localize(points, pixels, prior=Prior(asks_lens=True)).lens
    assert right is not None
    assert off.localize(points, pixels, prior=Prior(lens=right)).lens is right


def test_a_frame_contradicts_by_the_residuals_of_all_points():
    assert refuted(np.full(40, 0.6), np.full(40, 0.5), 2.0)
    assert not refuted(np.full(40, 0.5), np.full(40, 0.6), 2.0)
    assert not refuted(np.full(40, 5.0), np.full(40, 4.0), 2.0)  # neither explains anything
    assert not refuted(np.zeros(40), np.zeros(40), 2.0)


def test_errors_beyond_all_numbers_decide_nothing():
    """Of a readout of a second, fits leave what can be computed."""
    before, after = (
        Posterior(
            np.zeros(24), 0.0, np.eye(18), 1.0, 50.0, 1.0, np.ones(40, dtype=bool),
            np.full(40, errors),
        )
        for errors in (1.0, np.inf)
    )  # fmt: skip
    assert decided(before, after, gaussian([0.02, 0.0], [1e-3, 1e-3]), 2.0) is False
