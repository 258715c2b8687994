"""The synthetic scene against the camera equations, point by point."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.experiments.trials import (
    POINTS,
    Setting,
    Trials,
    camera,
    draw_trials,
    random_rotations,
)

MOVING = Setting(angular=25.0, linear=0.2)


def bearings(trials: Trials, i: int, linear_in_camera: bool) -> np.ndarray:
    """Where the truth of frame i puts its points at their own row times."""
    truth = trials.truth
    r, c, w, t = truth.rotation[i], truth.translation[i], truth.w[i], truth.t[i]
    seen = []
    for x, tau in zip(trials.points[i], trials.tau[i], strict=True):
        turn = Rotation.from_rotvec(tau * w)
        if linear_in_camera:
            p = turn.apply(r @ x) + c + tau * t
        else:
            # The centre moves straight: by -tau s in the camera axes of the middle row, where
            # t = s + w x C.
            s = t - np.cross(w, c)
            p = turn.apply(r @ x + c + tau * s)
        seen.append(p[:2] / p[2])
    return np.array(seen)


@pytest.mark.parametrize("drifting", [False, True])
def test_points_are_seen_at_their_own_row(drifting: bool) -> None:
    trials = draw_trials(5, 0, Setting(25.0, 0.2, 0.0, drifting))
    for i in range(5):
        np.testing.assert_allclose(trials.rays[i], bearings(trials, i, drifting), atol=1e-9)


def test_the_scene_is_the_papers() -> None:
    trials = draw_trials(200, 1, MOVING)
    assert trials.points.shape == (200, POINTS, 3)
    assert np.abs(trials.points).max() <= 1.0
    distance = np.linalg.norm(trials.truth.position, axis=1)
    assert distance.min() >= 2.0
    assert distance.max() <= 3.0
    # The camera looks at the centre.
    np.testing.assert_allclose(trials.truth.translation[:, :2], 0.0, atol=1e-12)
    np.testing.assert_allclose(trials.truth.translation[:, 2], distance)
    np.testing.assert_allclose(np.degrees(np.linalg.norm(trials.truth.w, axis=1)), 25.0)
    # 45 degrees from side to side, and rows from -0.5 to 0.5.
    assert np.abs(trials.rays).max() < np.tan(np.radians(22.5)) + 1e-3
    assert np.abs(trials.tau).max() < 0.501
    assert np.ptp(trials.tau) > 0.95


def test_the_camera_has_its_field_of_view() -> None:
    view = camera()
    edges = view.rays(np.array([[-0.5, -0.5], [999.5, 999.5]]))
    np.testing.assert_allclose(np.degrees(np.arctan(edges[1])), 22.5)
    np.testing.assert_allclose(edges[0], -edges[1])


def test_velocity_is_that_of_the_centre() -> None:
    trials = draw_trials(50, 2, MOVING)
    truth = trials.truth
    np.testing.assert_allclose(
        np.linalg.norm(np.cross(truth.w, truth.translation) - truth.t, axis=1), 0.2
    )
    drifting = draw_trials(50, 2, Setting(25.0, 0.2, 0.0, drifting=True))
    np.testing.assert_allclose(np.linalg.norm(drifting.truth.t, axis=1), 0.2)


def test_noise_moves_pixels_and_rows_alike() -> None:
    exact, noisy = (draw_trials(400, 3, Setting(noise=n)) for n in (0.0, 2.0))
    np.testing.assert_array_equal(exact.points, noisy.points)
    focal = camera().K[0, 0]
    assert np.std(focal * (noisy.rays - exact.rays)) == pytest.approx(2.0, rel=0.02)
    np.testing.assert_allclose(
        noisy.tau - exact.tau, focal * (noisy.rays - exact.rays)[..., 1] / 999.0, atol=1e-12
    )


def test_as_many_as_asked_for_and_always_the_same() -> None:
    # Cameras that see too few points are replaced.
    trials = draw_trials(300, 4, Setting(angular=40.0, points=80))
    assert trials.points.shape == (300, 80, 3)
    draw_trials.cache_clear()
    again = draw_trials(300, 4, Setting(angular=40.0, points=80))
    np.testing.assert_array_equal(trials.rays, again.rays)
    assert not np.array_equal(trials.rays, draw_trials(300, 5, Setting(40.0, points=80)).rays)


def test_random_rotations_turn_by_their_angle() -> None:
    turns = Rotation.from_matrix(random_rotations(20, 0, 35.0)).as_rotvec()
    np.testing.assert_allclose(np.degrees(np.linalg.norm(turns, axis=1)), 35.0)
    assert np.linalg.matrix_rank(turns) == 3
