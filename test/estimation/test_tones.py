"""Tones that shake a camera: found, followed, and not found where there are none."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import multivariate_normal

from benchmarks.frames.conditions import named
from benchmarks.frames.judged import judge
from rs_localizer.core.shake import shake_at
from rs_localizer.core.state import step_between
from rs_localizer.estimation.columns import Columns
from rs_localizer.estimation.modes import Inliers
from rs_localizer.estimation.posterior import maximum_a_posteriori
from rs_localizer.estimation.refine import apply_step
from rs_localizer.estimation.settling import settle
from rs_localizer.estimation.spectrum import CYCLES, SWINGS, loudest, powers, spectrum
from rs_localizer.estimation.tone_mixture import averaged
from rs_localizer.estimation.tone_search import find_tones
from rs_localizer.estimation.tones import Tones, fitted, seen_at

from .projection import jacobian_of
from .test_settling import ASSUMED, PRIOR, frame

THRESHOLD = 2.0
SWING = np.radians(0.3) * np.array([[0.6, 0.8, 0.3], [-0.8, 0.6, 0.2]])


def waves(tau, cycles, swings):
    """Turn and rate (n,6) of a tone."""
    angle = 2.0 * np.pi * cycles * tau[:, None]
    turn = np.cos(angle) * swings[0] + np.sin(angle) * swings[1]
    rate = np.cos(angle) * swings[1] - np.sin(angle) * swings[0]
    return np.column_stack([turn, 2.0 * np.pi * cycles * rate])


def shaken(seed, cycles=4.0, swings=SWING, noise=0.2, wrong=0, count=80):
    """Observations of a tone beside a motion, and the motion (24,)."""
    observations, state = frame(
        seed, 0.02, noise, count, swing=lambda tau: waves(tau, cycles, swings)[:, :3]
    )
    if wrong:
        rng = np.random.default_rng(seed)
        points = observations.points.copy()
        points[:wrong] += rng.uniform(-2.0, 2.0, (wrong, 3))
        observations = type(observations).of(
            points, observations.rays, observations.tau, jacobian_of(observations.rays),
            observations.row_time_gradient,
        )  # fmt: skip
    return observations, state


def mixture_of(observations, start):
    best = maximum_a_posteriori(observations, start, PRIOR, THRESHOLD)
    inliers = Inliers(observations, best, PRIOR, ASSUMED)
    return find_tones(inliers, best, inliers.examined(best.state, PRIOR, 6), THRESHOLD).mixture


def angle_off(found, state, cycles, swings, tau):
    """Orientation error (n,) at rows: of state and shaking against motion and tone."""
    turned = shake_at(tau, found.shake)[:, :3]

    def orientations(turn, motion):
        moved = tau[:, None] * motion[12:15] + 0.5 * tau[:, None] ** 2 * motion[18:21]
        return (
            Rotation.from_rotvec(-turn)
            * Rotation.from_rotvec(-moved)
            * Rotation.from_matrix(motion[:9].reshape(3, 3))
        )

    truth = orientations(waves(tau, cycles, swings)[:, :3], state)
    return (orientations(turned, found.state) * truth.inv()).magnitude()


@pytest.mark.parametrize("cycles", [2.2, 6.0])
def test_a_tone_is_followed_through_all_rows(cycles):
    observations, state = shaken(3, cycles)
    found = mixture_of(observations, state)
    assert found.certain
    assert found.best.tones.cycles[0] == pytest.approx(cycles, abs=0.03)
    settled = settle(observations, state, PRIOR, THRESHOLD, ASSUMED)
    tau = np.linspace(-0.4, 0.4, 41)
    off = angle_off(settled, state, cycles, SWING, tau)
    assert np.sqrt(np.mean(off**2)) < np.radians(0.06)  # of 0.3 that it swings
    assert settled.inliers.all()
    assert settled.noise == pytest.approx(0.2, rel=0.25)


def test_wrong_matches_stay_outside():
    observations, state = shaken(5, wrong=40, count=120)
    found = mixture_of(observations, state).best
    assert found.inliers[40:].all()
    assert found.inliers[:40].sum() <= 3


def test_a_second_tone_is_found_beside_the_first():
    def both(tau):
        return (waves(tau, 3.0, SWING) + waves(tau, 6.5, 0.4 * SWING[::-1]))[:, :3]

    observations, state = frame(4, 0.02, 0.1, 100, swing=both)
    found = mixture_of(observations, state)
    assert np.sort(found.best.tones.cycles) == pytest.approx([3.0, 6.5], abs=0.05)


def test_the_region_holds_the_pose():
    """At the middle row, where the tone is somewhere on its swing."""
    squared = []
    for seed in range(10):
        observations, state = shaken(seed, noise=0.5)
        found = averaged(mixture_of(observations, state), settle_none(observations, state))
        step = np.zeros(18)
        step[:3], step[6:9] = SWING[0], 2.0 * np.pi * 4.0 * SWING[1]
        error = step_between(found.state, apply_step(state, step))[:12]
        squared.append(error @ np.linalg.solve(found.covariance[:12, :12], error))
    assert 6.0 < np.median(squared) < 17.0  # 11.3 of twelve parameters
    assert max(squared) < 40.0


def settle_none(observations, state):
    return maximum_a_posteriori(observations, state, PRIOR, THRESHOLD)


def test_noise_is_hardly_ever_a_tone():
    found = [mixture_of(*frame(seed, 0.02, 0.5, 80)) for seed in range(40)]
    assert sum(one is not None for one in found) <= 3
    assert not any(one.certain for one in found if one)


def test_derivatives_of_state_and_shaking():
    tones = Tones(frame(0, 0.02, 0.0)[1], np.array([2.0, 5.5]), np.stack([SWING, -2.0 * SWING]),
                  np.ones(2))  # fmt: skip
    degrees, h = tones.degrees, 1e-6

    def moved(step):
        other = Tones(
            apply_step(tones.beside, step[:18]), tones.cycles + step[30:],
            tones.swings + step[18:30].reshape(2, 2, 3), tones.sizes,
        )  # fmt: skip
        away = step_between(tones.state, other.state)
        return np.concatenate([away, other.coefficients(degrees).ravel()])

    numeric = np.stack([(moved(h * e) - moved(-h * e)) / (2.0 * h) for e in np.eye(32)], axis=1)
    # To first order in the swings: they turn the axes of the other parameters.
    np.testing.assert_allclose(tones.by_parameters(degrees)[18:], numeric[18:], atol=1e-5)
    np.testing.assert_allclose(tones.by_parameters(degrees)[:18], numeric[:18], atol=0.5)


def test_columns_are_derivatives_of_the_errors():
    observations, state = shaken(1, noise=0.0)
    tones = Tones(state, np.array([4.0]), SWING[None], np.ones(1))
    seen, h = seen_at(observations, tones), 1e-5

    def errors(index, sign):
        step = sign * h * np.eye(25)[index]
        return seen_at(
            observations,
            Tones(apply_step(state, step[:18]), tones.cycles + step[24],
                  tones.swings + step[18:24].reshape(1, 2, 3), np.ones(1)),
        ).errors  # fmt: skip

    turns = np.abs(seen.columns[..., :3]).max()
    for index in [0, 1, 2, 6, 18, 19, 20, 21, 22, 23, 24]:
        numeric = (errors(index, 1.0) - errors(index, -1.0)) / (2.0 * h)
        # Those of tones to first order in the swings, which turn each other's axes.
        tolerance = 0.02 if index < 18 else 0.1
        assert np.abs(seen.columns[..., index] - numeric).max() < tolerance * turns


def test_the_spectrum_is_that_of_whole_matrices():
    """Evidence of Gaussian coefficients, the noise profiled, on points in the middle of bins."""
    rng = np.random.default_rng(0)
    count, base, freedom = 60, 4, 100.0
    tau = (rng.choice(96, count, replace=False) + 0.5) / 96 - 0.5
    columns, by_turn = rng.normal(size=(count, 2, base)), 500.0 * rng.normal(size=(count, 2, 3))
    errors = rng.normal(size=(count, 2))
    chosen = rng.uniform(size=count) < 0.9
    x, e = columns[chosen].reshape(-1, base), errors[chosen].ravel()
    known = Columns(x.T @ x + np.eye(base), -x.T @ e, float(e @ e), 0)
    found = spectrum(errors, columns, by_turn, tau, chosen, known, freedom, 1.0)
    for m in (0, 7, 28):
        angle = 2.0 * np.pi * CYCLES[m] * tau[chosen, None, None]
        wave = np.concatenate([np.cos(angle) * by_turn[chosen], np.sin(angle) * by_turn[chosen]], 2)
        wave = wave.reshape(-1, 6)
        rest = np.linalg.inv(np.eye(len(e)) + x @ x.T)  # what the base columns leave, prior 1
        for s in (1, 3):
            variance = 1.0
            for _ in range(3):
                spread = np.linalg.inv(rest) + SWINGS[s] ** 2 / variance * wave @ wave.T
                left = e @ np.linalg.solve(spread, e)
                volume = np.linalg.slogdet(spread @ rest)[1]
                variance = left / freedom
            expected = -0.5 * (freedom * np.log(variance) + volume)
            assert found[m, s] == pytest.approx(expected, abs=1e-6)


def test_loudness_is_that_of_chance_without_a_tone():
    """The loudest of some eight independent chi-squared variables of six."""
    rng = np.random.default_rng(1)
    tau, by_turn = rng.uniform(-0.5, 0.5, 100), rng.normal(size=(100, 2, 3))
    chosen = np.ones(100, dtype=bool)
    quiet = [loudest(rng.normal(size=(100, 2)), by_turn, tau, chosen) for _ in range(200)]
    assert 9.0 < np.median(quiet) < 13.0
    swung = np.einsum("nij,nj->ni", by_turn, np.sin(30.0 * tau)[:, None] * [1.0, 0.5, -0.5])
    assert loudest(rng.normal(size=(100, 2)) + swung, by_turn, tau, chosen) > 30.0
    assert loudest(np.zeros((100, 2)), by_turn, tau, chosen) == 0.0


def test_powers_are_worth_what_gaussian_swings_make_probable():
    """Where waves are square to each other, as at even rows: against the normal density."""
    rng = np.random.default_rng(5)
    tau = (np.arange(96) + 0.5) / 96.0 - 0.5
    by_turn = np.einsum("nl,la->nla", np.ones((96, 2)), [[30.0, 0.0, 0.0], [0.0, 20.0, 0.0]])
    errors = rng.normal(size=(96, 2)) * [1.2, 0.8]
    found = powers(errors, by_turn, tau, np.ones(96, dtype=bool))
    variance = np.mean(errors**2)
    for m in (4, 20):
        angle = 2.0 * np.pi * CYCLES[m] * tau
        wave = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        for s in range(1, len(SWINGS)):
            expected = 0.0
            for line, known in enumerate((30.0, 20.0)):
                spread = variance * np.eye(96) + (SWINGS[s] * known) ** 2 * wave @ wave.T
                densities = [
                    multivariate_normal.logpdf(errors[:, line], cov=matrix)
                    for matrix in (spread, variance * np.eye(96))
                ]
                expected += densities[0] - densities[1]
            assert found.likelihood[m, s - 1] == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_few_points_cannot_tell():
    observations, state = shaken(2, count=11)
    tones = Tones.none(state).with_one(4.0, 0.003)
    assert fitted(observations, tones, 20.0, PRIOR, THRESHOLD) is None


def test_large_fast_shaking_is_followed_through_the_whole_method():
    """One degree at 200 Hz: seven pixels, six times in a readout."""
    found = judge(named("sine/1deg/200Hz/0.3px"), 15, 8, {})
    assert found.localized.all()
    assert np.mean(found.inside("pose")) > 0.85
    assert np.median(found.of("deg")) < 0.02  # deg
