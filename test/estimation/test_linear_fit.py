# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The one linear fit, against dense matrices of plain NumPy."""

import math

import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.special import logsumexp

from rs_localizer.core.shake import CYCLES, TYPICAL_SIZES
from rs_localizer.estimation.linear_fit import (
    BLOCKS,
    FACTORS,
    MIDDLE,
    NO_TURN,
    TURNS,
    VIBRATION,
    Linear,
    Noise,
    TurnPrior,
    bend_of,
    fit,
    hidden,
    known_at,
    linear_of,
    moved,
    nothing_shared,
    smooth_columns,
    smooth_error,
    under,
)
from rs_localizer.estimation.prior import add_prior, terms_at
from rs_localizer.estimation.projection import linearized

from .frames import PRIOR, agree, alike, frame

NOISE = 0.4
SIZES = np.linspace(-2.5, 5.5, 11)  # as the module has them
TERMS = terms_at(PRIOR, 0.1, False)


def linearized_frame(seed, noise, count):
    """Observations, their linearization without any vibration, and the true state."""
    observations, truth = frame(seed, 0.05, noise, count)
    return observations, linearized(observations.packed, count, truth, np.zeros((count, 6))), truth


def everything(bent):
    observations, lines, truth = linearized_frame(3, NOISE, 30)
    chosen = ~np.isin(np.arange(30), [4, 17])
    bend = bend_of(observations.points, chosen, 4.0 / 590.0) if bent else np.zeros((30, 0))
    shared = smooth_error(lines, chosen, bend, 0.2)
    columns = smooth_columns(lines.by_motion[chosen], lines.image[chosen], bend[chosen])
    return truth, chosen, lines, shared, columns.reshape(56, -1)


@pytest.mark.parametrize("bent", [False, True])
def test_sizes_are_integrated_as_over_dense_matrices(bent):
    truth, chosen, lines, shared, columns = everything(bent)
    known = known_at(TERMS, truth)
    # One noise for all sizes: it is held, but for rounding.
    noise = Noise(NOISE, 1.0, 12.0)
    found = fit(linear_of(lines, chosen, False, shared), shared, known, noise, NO_TURN, True)
    dense, errors = lines.by_motion[chosen].reshape(56, 18), lines.errors[chosen].ravel()
    information, slope = known.form[:-1, :-1], known.form[:-1, -1]
    logs, steps, covariances = [], [], []

    def at(shared_noise, deviation):
        """Logarithm, step, covariance, and the noise that is left."""
        whole = shared_noise + deviation**2 * np.eye(56)
        inverse = np.linalg.inv(whole)
        of_step = dense.T @ inverse @ dense + information
        pull = dense.T @ inverse @ errors + slope
        step = -np.linalg.solve(of_step, pull)
        rest = deviation**2 * inverse @ (errors + dense @ step)
        cost = errors @ inverse @ errors + known.form[-1, -1] + step @ pull
        cost += np.linalg.slogdet(2.0 * np.pi * whole)[1] + np.linalg.slogdet(of_step)[1]
        taken = 56.0 - deviation**2 * np.trace(inverse)
        left = np.sqrt(rest @ rest / max(56.0 - 12.0 - taken, 5.6))
        return -0.5 * cost, step, np.linalg.inv(of_step), np.clip(left, 0.16 * NOISE, 1.3 * NOISE)

    deviation = None
    for away in SIZES:
        shared_noise = 0.2**2 * np.exp(2.0 * away) * columns @ columns.T
        deviation = deviation or at(shared_noise, NOISE)[3]
        log, step, covariance, deviation = at(shared_noise, deviation)
        logs.append(log - 0.5 * away**2)
        steps.append(step)
        covariances.append(covariance)
    weights = np.exp(np.array(logs) - logsumexp(logs))
    mean = weights @ np.array(steps)
    spread = np.einsum("k,kij->ij", weights, covariances)
    spread += np.einsum("k,ki,kj->ij", weights, steps - mean, steps - mean)
    agree(found.step, found.covariance, mean, spread, atol=0.02)
    expected = logsumexp(logs) - logsumexp(-0.5 * SIZES**2)
    expected += 0.5 * np.log(np.diag(TERMS.informations[0])[6:]).sum()
    assert found.evidence == pytest.approx(expected, abs=0.05)
    sizes = 0.2 * np.exp(SIZES)
    assert found.size == pytest.approx(np.sqrt(weights @ sizes**2), rel=0.05)


def shaking():
    """Truth and linearization of a camera that may shake, and the equations of its fit, in which
    points share no error.
    """
    _, lines, truth = linearized_frame(5, 0.5, 40)
    shared = nothing_shared(40)
    return truth, lines, shared, linear_of(lines, np.ones(40, bool), True, shared)


def whole_waves(lines):
    """Columns (80,84) of cosines and sines beside a motion, and what they add to it (18,84)."""
    angles = 2.0 * np.pi * np.outer(lines.tau, CYCLES)
    waves = np.stack([np.cos(angles) - 1.0, np.sin(angles) - angles], 2).reshape(40, -1)
    middle = np.zeros((18, 28, 3))
    for axis in range(3):
        middle[axis, ::2, axis] = 1.0
        middle[6 + axis, 1::2, axis] = 2.0 * np.pi * CYCLES
    middle = middle.reshape(18, -1)
    turns = (lines.by_turn[:, :, None, :] * waves[:, None, :, None]).reshape(80, -1)
    return turns + lines.by_motion.reshape(80, 18) @ middle, middle


def test_vibration_is_integrated_as_over_dense_matrices():
    """Whole cosines and sines beside a motion of which a prior knows something, at one noise."""
    truth, lines, shared, linear = shaking()
    dense, (turns, middle) = lines.by_motion.reshape(80, 18), whole_waves(lines)
    information, slope = np.zeros((18, 18)), np.zeros(18)
    prior_cost = add_prior(PRIOR, truth, 1.0, information, slope)
    errors = lines.errors.ravel()
    logs, moments = [], []
    freedom, noise = 62.0, 0.5
    white = dense.T @ dense / noise**2 + information
    first = -np.linalg.solve(white, dense.T @ errors / noise**2 + slope)
    bands = np.array([1.0, 2.0, 3.0, 5.0, 1.3, 3.3])[:, None]
    near = np.exp(-0.5 * (np.log(CYCLES / bands) / 0.35) ** 2) + 0.1
    near *= np.sqrt(np.sum(TYPICAL_SIZES**2) / np.sum(near**2, axis=1, keepdims=True))
    axes = [np.ones(3)] * 5 + [np.array([0.1, 0.1, 1.0])] * 2  # the last: about the optical axis
    shapes = zip((TYPICAL_SIZES, *near), axes, strict=True)
    sizes_of = [np.outer(np.repeat(of, 2), axis).ravel() for of, axis in shapes]
    every = [factor * sizes for sizes in sizes_of for factor in FACTORS]
    prior = np.tile(-0.5 * (np.log(FACTORS) / np.log(10.0)) ** 2, 7)
    prior[-2 * len(FACTORS) :] -= 4.0
    prior -= logsumexp(prior)
    rest = errors @ errors / noise**2 + prior_cost + first @ (dense.T @ errors / noise**2 + slope)
    for sizes, before in zip(every, prior, strict=True):
        columns, seen = np.hstack([dense, turns * sizes]), np.hstack([np.eye(18), middle * sizes])
        precision, pull = columns.T @ columns / noise**2, columns.T @ errors / noise**2
        precision += block_diag(information, np.eye(84))  # of the motion, and of each wave
        pull[:18] += slope
        step = -np.linalg.solve(precision, pull)
        left = (errors @ errors / noise**2 + prior_cost + step @ pull) / rest
        volume = np.linalg.slogdet(white)[1] - np.linalg.slogdet(precision)[1]
        logs.append(before + 0.5 * volume - 0.5 * freedom * np.log(left))
        wider = seen @ np.linalg.inv(precision) @ seen.T - np.linalg.inv(white)
        moved_by = seen @ step - first
        moments.append(rest * left / freedom * wider + np.outer(moved_by, moved_by))
    np.testing.assert_allclose(linear.every[:18, :18], dense.T @ dense)
    known = known_at(PRIOR, truth)
    found = fit(linear, shared, known, Noise(noise, 1.0, 18.0), VIBRATION, True)
    assert found.gain == pytest.approx(logsumexp(logs), abs=0.05)
    weights = np.exp(logs - logsumexp(logs))
    np.testing.assert_allclose(found.weights, weights, atol=0.01)
    expected = np.einsum("k,kij->ij", weights, moments)
    # What the motion with its vibration is off by, beyond what it is without.
    whole = np.hstack([np.eye(18), MIDDLE])
    ratio = (found.noise / noise) ** 2
    shown = whole @ found.covariance @ whole.T - ratio * np.linalg.inv(white)
    shown += np.outer(whole @ found.step - first, whole @ found.step - first)
    # Pose and velocities; what truncated combinations lose of accelerations is not asked for.
    poses = expected[:12, :12]
    alike(shown[:12, :12], poses, np.sqrt(np.diag(poses)), atol=0.05)
    every_point = np.ones(40, bool)
    gain, hiding, _ = hidden(lines, every_point, shared, known, noise, freedom, math.inf, VIBRATION)
    assert gain == pytest.approx(found.gain, abs=1e-9)
    alike(hiding, shown[:12, :12], np.sqrt(np.diag(poses)), atol=1e-6)


def test_no_size_that_a_large_vibration_shows_is_left_out():
    """Small sizes of its frequency explain less than another spectrum does."""
    truth, lines, _, _ = shaking()
    (turns, _), known, shared = whole_waves(lines), known_at(PRIOR, truth), nothing_shared(40)
    of_cycles = np.exp(-0.5 * (np.log(CYCLES / 5.0) / 0.2) ** 2)
    wave = np.outer(np.repeat(of_cycles, 2), [1.0, 1.0, 0.0]).ravel()
    wave *= np.random.default_rng(1).normal(size=84)
    wave *= 128.0 * np.linalg.norm(TYPICAL_SIZES) / np.linalg.norm(wave)
    far = lines._replace(errors=lines.errors + (turns @ wave).reshape(40, 2))
    linear = linear_of(far, np.ones(40, bool), True, shared)

    def fitted(odds):
        prior = VIBRATION._replace(odds=odds)
        return fit(linear, shared, known, Noise(0.5, 1.0, 18.0), prior, True)

    count = len(VIBRATION.odds)
    alone = [fitted(np.where(np.arange(count) == k, 0.0, -np.inf)).gain for k in range(count)]
    logs = VIBRATION.odds + alone
    expected = np.exp(logs - logsumexp(logs))
    np.testing.assert_allclose(fitted(VIBRATION.odds).weights, expected, atol=0.01)


@pytest.mark.parametrize("name", ["turn", "shared"])
def test_a_block_that_is_dropped_by_name_leaves_the_fit_without_it(name):
    truth, chosen, lines, shared, _ = everything(False)
    known, noise = known_at(TERMS, truth), Noise(NOISE, 1.0, 12.0)
    both, nothing = linear_of(lines, chosen, True, shared), nothing_shared(28)
    left, turn, less = nothing, VIBRATION, both._replace(beside=np.zeros_like(both.beside[:1]))
    if name == "turn":
        kept = np.delete(np.arange(73), BLOCKS[name])
        left, turn = shared, NO_TURN
        less = Linear(both.every[kept][:, kept].copy(), both.beside[:, kept].copy())
    dropped = fit(less, left, known, noise, turn, True)
    never = linear_of(lines, chosen, name != "turn", left)
    expected = fit(never, left, known, noise, turn, True)
    agree(dropped.step, dropped.covariance, expected.step, expected.covariance, atol=1e-12)
    assert dropped.evidence == pytest.approx(expected.evidence, abs=1e-9)


@pytest.mark.parametrize("speed", [0.0, 0.1, 0.3])
def test_another_prior_of_the_motion_makes_the_fit_that_it_would_have_made(speed):
    truth, _, shared, linear = shaking()
    still = truth.copy()
    still[12:] = 0.0
    linear = moved(linear, np.append(np.zeros(6), np.append(-truth[12:], np.zeros(TURNS))))
    odds = np.full(VIBRATION.odds.shape, -np.inf)
    odds[2] = 0.0
    one, noise = VIBRATION._replace(odds=odds), 0.5
    before, after = known_at(PRIOR, still), known_at(terms_at(PRIOR, speed, False), still)
    for _ in range(20):  # the noise that it finds is the one that the prior was weighed against
        first = fit(linear, shared, before, Noise(noise, 1.0, 18.0), one, True)
        noise = first.noise
    expected = fit(linear, shared, after, Noise(noise, 1.0, 18.0), one, True)
    # Its evidence is of the errors' freedom before the turn, too, takes parameters.
    shown = under(first._replace(freedom=80.0 - 18.0), before, after)
    own = (noise / expected.noise) ** 2 * expected.covariance
    agree(shown.step, shown.covariance, expected.step, own, rtol=1e-3, atol=1e-3)
    assert shown.evidence == pytest.approx(expected.evidence, abs=1e-3)


def test_a_gyroscope_enters_as_mean_and_covariance_of_the_turn_and_what_couples_it():
    """One Gaussian of all 72 unknowns, beside a motion's own prior: one dense solution."""
    truth, _, shared, linear = shaking()
    rng, known = np.random.default_rng(7), known_at(PRIOR, truth)
    mean, factor = np.append(np.zeros(18), 1e-3 * rng.normal(size=TURNS)), np.zeros((72, 72))
    factor[6:9], factor[18:] = rng.normal(size=(3, 72)), rng.normal(size=(54, 72))
    told = 1e5 * factor @ factor.T  # of angular velocities and the turn
    form, place = np.zeros((73, 73)), np.append(np.arange(18), 72)
    form[:72, :72] = told
    form[18:72, 18:72] = 0.0
    form[np.ix_(place, place)] += known.form
    beside = known._replace(form=form)
    prior = TurnPrior.of(told[None, 18:, 18:].copy(), np.zeros(1))
    found = fit(moved(linear, mean), shared, beside, Noise(0.5, 1.0, 18.0), prior, True)
    information, slope = linear.every[:72, :72] / 0.25 + told, linear.every[:72, 72] / 0.25
    slope -= told @ mean
    information[:18, :18] += known.form[:18, :18]
    slope[:18] += known.form[:18, 18]
    expected = (found.noise / 0.5) ** 2 * np.linalg.inv(information)
    away = -np.linalg.solve(information, slope) - mean
    for place in BLOCKS.values():
        own = found.step[place], found.covariance[place, place]
        agree(*own, away[place], expected[place, place], atol=1e-4)
    agree(found.step, found.covariance, away, expected, atol=1e-4)


@pytest.mark.parametrize("noise", [1e-9, 1e-3, 1e6])
@pytest.mark.parametrize("size", [0.0, 1e-200, 1e-9, 1e9, 1e150])
def test_no_size_of_errors_is_an_exception(noise, size):
    truth, lines, shared, _ = shaking()
    known = known_at(PRIOR, truth)
    far = lines._replace(errors=size * lines.errors)
    linear = linear_of(far, np.ones(40, bool), True, shared)
    found = fit(linear, shared, known, Noise(noise, 1.0, 18.0), VIBRATION, True)
    assert found.evidence == -np.inf or np.isfinite(found.step).all()


def test_noise_that_is_not_expected_speaks_for_vibration():
    truth, _, shared, linear = shaking()
    known, one = known_at(PRIOR, truth), TurnPrior.of(VIBRATION.informations[3:4], np.zeros(1))

    def fitted(equations, expected):
        return fit(equations, shared, known, Noise(0.3, 1.0, 18.0, expected), one, True)

    found = fitted(linear, math.inf)
    still = Linear(linear.every.copy(), linear.beside.copy())
    still.every[18:72] = still.every[:, 18:72] = 0.0  # nothing of it shows
    taken = fitted(still, math.inf).noise ** 2 - found.noise**2
    assert taken > 0.0
    for expected in (1.0, 0.1, 0.01):
        gain = fitted(linear, expected).gain - found.gain
        assert gain == pytest.approx(0.5 * taken / expected**2)


def test_products_farther_along_the_tangent_leave_the_same_optimum():
    truth, chosen, lines, shared, _ = everything(False)
    noise, linear = Noise(NOISE, 1.0, 12.0), linear_of(lines, chosen, False, shared)
    known = known_at(TERMS, truth)
    at_once = fit(linear, shared.at(0.2), known, noise, NO_TURN, True)
    step = 1e-3 * np.random.default_rng(0).normal(size=18)
    by = np.eye(19) + np.outer(np.append(step, 0.0), np.eye(19)[18])
    there = known._replace(form=by.T @ known.form @ by)
    farther = fit(moved(linear, step), shared.at(0.2), there, noise, NO_TURN, True)
    alike(farther.step + step, at_once.step, np.sqrt(np.diag(at_once.covariance)), atol=1e-8)
    assert farther.evidence == pytest.approx(at_once.evidence, abs=1e-8)


@pytest.mark.parametrize("bent", [False, True])
def test_combinations_of_columns_are_orthonormal_and_say_the_same(bent):
    *_, shared, columns = everything(bent)
    squares, count = shared.squares, shared.rows.shape[2]
    rows, most = np.zeros((56, len(squares))), squares.max()
    rows[::2, :count], rows[1::2, len(squares) - count :] = shared.rows
    np.testing.assert_allclose(rows.T @ rows, np.eye(len(squares)), atol=1e-9)
    np.testing.assert_allclose((rows * squares) @ rows.T, columns @ columns.T, atol=1e-3 * most)
    assert np.exp(shared.odds).sum() == pytest.approx(1.0)
    # The logarithm of the size is known with a deviation of one.
    assert np.diff(shared.odds) == pytest.approx(-0.5 * np.diff(np.log(shared.sizes / 0.2) ** 2))


def test_a_smooth_error_of_one_pixel_has_a_mean_square_of_one():
    """Over the image of a scene without depth, of u and of v."""
    _, lines, _ = linearized_frame(5, 0.0, 2000)
    shared = smooth_error(lines, np.ones(2000, bool), np.zeros((2000, 0)), 1.0)
    assert 0.5 < np.sum(shared.squares) / 4000 < 2.0
