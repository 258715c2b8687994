# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Planes, which a single rolling-shutter image hardly determines: no collapsed motion may pass."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from benchmarks.frames.conditions import named
from benchmarks.frames.judged import far_off, judge
from rs_localizer.estimation import acceptance

from .moving import AT_REST, error_of, pinhole, squared

CAMERA = pinhole(1207.0, 1000, 1000, readout_time=0.0)


def plane_frame(seed, tilt, size):
    """A plane 2 to 3 m away, tilted (deg) about a random axis, seen by a camera at rest."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi)
    tilted = Rotation.from_rotvec(np.radians(tilt) * np.array([np.cos(angle), np.sin(angle), 0.0]))
    flat = np.column_stack([rng.uniform(-size, size, (300, 2)), np.zeros(300)])
    in_camera = tilted.apply(flat) + np.array([0.0, 0.0, rng.uniform(2.0, 3.0)])
    rotation, translation = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3)
    points = (in_camera - translation) @ rotation
    pixels = CAMERA.project(in_camera) + rng.normal(size=(300, 2))
    seen = np.flatnonzero(CAMERA.inside(pixels))[:50]
    still = replace(AT_REST, rotation=rotation, translation=translation)
    return points[seen], pixels[seen], still


def turn_between(estimate, motion):
    return np.degrees(np.linalg.norm(error_of(estimate, motion)[:3]))


@pytest.fixture(scope="module")
def small_planes():
    """Planes of 0.2 m, 2 to 3 m away, that lean by 20 deg: noise hides which way they lean."""
    localizer = rsl.Localizer(CAMERA)
    frames = [plane_frame(seed, 20.0, 0.1) for seed in range(60)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(acceptance, "MOST_TURN", 1.0)
        return [(localizer.localize(points, pixels), points, pixels, true)
                for points, pixels, true in frames]  # fmt: skip


def test_a_mirrored_pose_is_never_published(small_planes):
    localizer, inside = rsl.Localizer(CAMERA), []
    for result, points, pixels, true in small_planes:
        published = localizer.localize(points, pixels)
        assert not published or turn_between(published, true) < 10.0
        if result:
            inside.append(squared(error_of(result, true)[:3], result.covariance) < 7.8)
    assert len(inside) > 50
    assert np.mean(inside) > 0.85  # of 95 %, as leans of 20 deg are no Gaussian


def test_a_prediction_says_which_of_both_poses_it_is(small_planes):
    localizer, helped = rsl.Localizer(CAMERA), 0
    for _, points, pixels, true in small_planes:
        if not localizer.localize(points, pixels):
            spread = np.repeat([np.radians(5.0), 0.1, np.radians(1.0), 0.01], 3) ** 2
            prior = rsl.Prior(motion=true, covariance=np.diag(spread))
            tracked = localizer.localize(points, pixels, prior=prior)
            assert not tracked or turn_between(tracked, true) < 10.0
            helped += bool(tracked)
    assert helped > 5


def test_tracked_plane_does_not_lock_in_on_a_lean():
    # Frames in a row agree on a lean that noise made; half know it well enough to be published.
    judged = judge(named("locks/0.2m/tilt 0/1px"), 60, 3, {})
    assert judged.localized.mean() > 0.35
    assert judged.inside("pose").mean() > 0.85
    assert far_off(judged)[judged.localized].mean() < 0.02
