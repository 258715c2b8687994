"""Typical speeds foreseen from the best motion, against those that are fitted."""

import numpy as np
import pytest

from rs_localizer.config import LocalizerConfig
from rs_localizer.core.camera import Camera
from rs_localizer.core.state import step_between
from rs_localizer.estimation.assumptions import assumptions
from rs_localizer.estimation.modes import Inliers
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.posterior import maximum_a_posteriori
from rs_localizer.estimation.prior_terms import terms_at
from rs_localizer.solvers.table import find_solver


def inliers_of(scene, speed, noise):
    camera, motion, points, _, pixels = scene.frame(speed=speed, noise=noise, count=120)
    timed = Camera(camera.width, camera.height, camera.K, camera.D, readout_time=0.03)
    terms, assumed = assumptions(timed, LocalizerConfig(), find_solver("r6p_vcwt"))
    rays, by_ray = camera.rays_and_jacobian(pixels)
    observations = Observations.of(
        points, rays, camera.row_time(pixels), by_ray, camera.row_time_gradient
    )
    best = maximum_a_posteriori(observations, scene.state_of(motion), terms, 2.0)
    frame = Inliers(observations, best, terms, assumed)
    return frame, (best.state, frame.examined(best.state, terms, 6).columns)


@pytest.mark.parametrize("part", [0.0, 0.03, 0.3])
def test_speeds_near_the_best_motion_are_foreseen_and_others_are_fitted(scene, part):
    for speed, foreseen in ((0.0003, True), (0.05, part > 0.0)):
        frame, linear = inliers_of(scene, speed, 0.1)
        terms = terms_at(frame.terms, part, False)
        fitted = frame.mode(linear[0], terms, part)
        frame.linear = linear
        mode = frame.mode(linear[0], terms, part)
        assert np.array_equal(mode.state, fitted.state) != foreseen
        deviations = np.sqrt(np.diag(fitted.covariance)) + 1e-12
        np.testing.assert_array_less(
            np.abs(step_between(mode.state, fitted.state)), 0.05 * deviations
        )
        np.testing.assert_allclose(
            np.sqrt(np.diag(mode.covariance)), np.sqrt(np.diag(fitted.covariance)), rtol=0.05
        )
        assert mode.evidence == pytest.approx(fitted.evidence, abs=0.1)
        assert mode.cost == pytest.approx(fitted.cost, abs=0.1)
