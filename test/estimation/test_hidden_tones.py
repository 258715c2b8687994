"""Tones that hide: among few points, in the noise, and beside louder ones."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, norm

from rs_localizer.core.state import step_between
from rs_localizer.estimation.modes import Inliers
from rs_localizer.estimation.posterior import maximum_a_posteriori
from rs_localizer.estimation.refine import apply_step
from rs_localizer.estimation.settling import settle
from rs_localizer.estimation.spectrum import CYCLES, SWINGS, spread_by_tones
from rs_localizer.estimation.tone_mixture import averaged
from rs_localizer.estimation.tone_search import find_tones

from .projection import jacobian_of
from .test_settling import ASSUMED, PRIOR, frame
from .test_tones import SWING, THRESHOLD, mixture_of, settle_none, shaken, waves

FIVE_SIGMA = chi2.isf(2.0 * norm.sf(5.0), 12)


def squared_distance(found, state, tones):
    """Of the motion (12 parameters) at the middle row to the truth: tones of cycles and swings."""
    step = np.zeros(18)
    for cycles, swings in tones:
        step[:3] += swings[0]
        step[6:9] += 2.0 * np.pi * cycles * swings[1]
    error = step_between(found.state, apply_step(state, step))[:12]
    return error @ np.linalg.solve(found.covariance[:12, :12], error)


@pytest.mark.parametrize(("count", "wrong"), [(16, 0), (20, 4)])
def test_a_tone_is_followed_by_few_points(count, wrong):
    """Six pixels, where points within four may count as inliers of a motion alone."""
    squared, noises = [], []
    for seed in range(10):
        observations, state = shaken(seed, 3.0, 2.0 * SWING, 0.5, wrong, count)
        start = maximum_a_posteriori(observations, state, PRIOR, 4.0 * THRESHOLD)
        found = settle(observations, start.state, PRIOR, THRESHOLD, ASSUMED)
        if found.strangers:
            continue  # refused
        assert found.inliers[wrong:].sum() > count - wrong - 2
        squared.append(squared_distance(found, state, [(3.0, 2.0 * SWING)]))
        noises.append(found.noise)
    assert len(squared) > 5
    assert max(squared) < FIVE_SIGMA
    assert np.median(squared) < 17.0
    # Of 32 errors the prior decides some, and 25 parameters by far not as many degrees of freedom.
    assert np.sqrt(np.mean(np.square(noises))) == pytest.approx(0.5, rel=0.25)


def unheard(seed, swings, noise=1.0):
    """What hidden tones add to the turn's variance, in units of that without."""
    observations, state = shaken(seed, 4.0, swings, noise)
    best = maximum_a_posteriori(observations, state, PRIOR, THRESHOLD)
    inliers = Inliers(observations, best, PRIOR, ASSUMED)
    heard = find_tones(inliers, best, inliers.examined(best.state, PRIOR, 6), THRESHOLD)
    if heard.unheard is None:
        return 0.0 if heard.mixture is None else np.nan
    assert np.linalg.eigvalsh(heard.unheard).min() > -1e-12
    return np.trace(heard.unheard[:3, :3]) / np.trace(best.covariance[:3, :3])


def test_the_covariance_has_room_for_tones_that_noise_hides():
    still = np.array([unheard(seed, 0.0 * SWING) for seed in range(60)])
    hidden = np.array([unheard(seed, 0.12 * SWING) for seed in range(60)])
    assert np.isnan(still).sum() <= 4
    assert np.nanmean(still) < 0.06  # three hundredths of a deviation
    assert np.nanmax(still) < 0.6
    assert np.isnan(hidden).sum() > 20  # these are found
    assert np.nanmean(hidden) > 1.2 * np.nanmean(still)


def test_what_a_tone_adds_is_that_of_whole_matrices():
    """Second moments, about the best motion without a tone, of Gaussian motions with one."""
    rng = np.random.default_rng(2)
    count, noise = 50, 0.7
    tau = (rng.choice(96, count, replace=False) + 0.5) / 96 - 0.5
    columns, by_turn = rng.normal(size=(count, 2, 18)), 500.0 * rng.normal(size=(count, 2, 3))
    chosen = rng.uniform(size=count) < 0.9
    known = 0.3 * np.eye(18)  # prior information
    x = columns[chosen].reshape(-1, 18)
    information = x.T @ x / noise**2 + known
    errors = noise * rng.normal(size=(count, 2))
    # Errors at the best motion have nothing along its columns, but for the prior: none here.
    flat = errors[chosen].ravel()
    errors[chosen] = (flat - x @ np.linalg.lstsq(x, flat, rcond=None)[0]).reshape(-1, 2)
    evidence = np.full((len(CYCLES), len(SWINGS)), -50.0)
    evidence[:, 0] = 100.0  # of no tone, which is another's business
    evidence[3, 2], evidence[17, 4] = 0.0, np.log(3.0)
    expected = np.zeros((18, 18))
    for m, s, probability in [(3, 2, 0.25), (17, 4, 0.75)]:
        angle = 2.0 * np.pi * CYCLES[m] * tau[chosen, None, None]
        wave = np.concatenate([np.cos(angle) * by_turn[chosen], np.sin(angle) * by_turn[chosen]], 2)
        both = np.concatenate([x, wave.reshape(-1, 6)], axis=1)
        prior = np.zeros((24, 24))
        prior[:18, :18], prior[18:, 18:] = known, np.eye(6) / SWINGS[s] ** 2
        covariance = np.linalg.inv(both.T @ both / noise**2 + prior)
        mean = -covariance @ both.T @ errors[chosen].ravel() / noise**2
        middle = np.eye(18, 24)  # of the motion together with the tone
        middle[:3, 18:21] = np.eye(3)
        middle[6:9, 21:24] = 2.0 * np.pi * CYCLES[m] * np.eye(3)
        moments = covariance + np.outer(mean, mean)
        expected += probability * middle @ moments @ middle.T
    expected -= np.linalg.inv(information)
    found = spread_by_tones(
        errors, columns, by_turn, tau, chosen, np.linalg.inv(information), noise, evidence
    )
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())


def test_a_further_tone_that_hides_in_the_noise_has_its_room():
    """A tenth of the first one's swing: neither clear nor out of the question."""
    tones = [(3.0, SWING), (6.5, 0.1 * SWING[::-1])]

    def swing(tau):
        return sum(waves(tau, *tone) for tone in tones)[:, :3]

    with_room, without = [], []
    for seed in range(12):
        observations, state = frame(seed, 0.02, 0.5, 80, swing=swing)
        mixture = mixture_of(observations, state)
        first = replace(
            mixture, fits=mixture.fits[:1], probabilities=np.array([1.0 - mixture.none])
        )
        none = settle_none(observations, state)
        with_room.append(squared_distance(averaged(mixture, none), state, tones))
        without.append(squared_distance(averaged(first, none), state, tones))
    assert np.mean(with_room) < 14.0  # 12 parameters
    assert np.mean(without) > 1.4 * np.mean(with_room)


def test_strangers_that_no_tone_explains_are_counted():
    """Eight of 24 points are off by five to ten pixels each on their own; or far off."""
    for seed in range(4):
        observations, state = frame(seed, 0.02, 0.5, 24)
        rng = np.random.default_rng(seed)
        off = rng.normal(size=(8, 2))
        off *= rng.uniform(5.0, 10.0, (8, 1)) / np.linalg.norm(off, axis=1)[:, None] / 590.0
        for factor, strangers in [(1.0, 8), (30.0, 0)]:
            rays = observations.rays.copy()
            rays[:8] += factor * off
            moved = type(observations).of(
                observations.points, rays, observations.tau, jacobian_of(rays),
                observations.row_time_gradient,
            )  # fmt: skip
            found = settle(moved, state, PRIOR, THRESHOLD, ASSUMED)
            assert strangers - 2 <= found.strangers <= strangers


def test_more_tones_than_points_can_tell_are_noticed():
    """Five in a band, where three have as many parameters as there are points; two do not."""
    rng = np.random.default_rng(0)
    band = [(c, rng.normal(size=(2, 3)) * 0.005) for c in (1.1, 1.9, 2.7, 3.4, 4.3)]
    for tones, count, exhausted in [(band, 40, 4), (band[:5:3], 44, 0), (band[2:3], 33, 0)]:

        def swing(tau, tones=tones):
            return sum(waves(tau, *tone) for tone in tones)[:, :3]

        found = []
        for seed in range(4):
            observations, state = frame(seed, 0.02, 0.1, count, swing=swing)
            start = maximum_a_posteriori(observations, state, PRIOR, 4.0 * THRESHOLD)
            settled = settle(observations, start.state, PRIOR, THRESHOLD, ASSUMED)
            found.append(settled.exhausted or settled.strangers > 0 or not settled.determined)
        assert sum(found) == exhausted
