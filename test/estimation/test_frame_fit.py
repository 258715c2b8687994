# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""One fit of motion, in-frame turn and smooth error, against plain NumPy."""

import itertools

import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy.spatial.transform import Rotation

from rs_localizer.core.rig import Mounts
from rs_localizer.core.scales import SCALES
from rs_localizer.core.shake import FUNCTIONS, shake_at
from rs_localizer.estimation.frame_fit import (
    SMOOTH_TERMS,
    TURNS,
    _by_scales,
    _of_scales,
    at_speed,
    fit_frame,
    full_prior,
    neighbours_agree,
    products_of,
    smooth_at,
    smooth_terms,
    with_scales,
)
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.posterior import maximum_a_posteriori
from rs_localizer.estimation.prior import add_prior, motion_terms, terms_at
from rs_localizer.estimation.refine import apply_step
from rs_localizer.estimation.residuals import Lines, linearized

from .frames import PRIOR, distance, frame, observe
from .projection import gradient, jacobian_of, pixels_of, project, row_time, scene, shake, waves

COUNT, NOISE = 60, 0.3  # px
IMAGE = np.zeros((0, 0))  # smooth errors are of the image
# Polynomials of the image, from the constant to the cubic ones, and the sizes of each degree.
PLACES = [(i, degree - i) for degree in range(4) for i in range(degree + 1)]
DEGREE_SIZES = np.array([1.0, 1.0, 0.5, 0.25])
TERMS = motion_terms((0.2, 0.1), (0.05, 0.03))
STATE = np.concatenate([np.eye(3).ravel(), np.zeros(3), 0.002 * np.arange(12)])
GROUPS = np.concatenate([np.repeat(np.arange(SCALES - 1), 6), np.full(2 * SMOOTH_TERMS, 14)])


def lines_of(seed=0, count=COUNT):
    """Random lines of a frame, and the inliers."""
    rng = np.random.default_rng(seed)
    lines = Lines(
        NOISE * rng.normal(size=(count, 2)),
        rng.normal(size=(count, 2, 18)) * 10.0 ** rng.uniform(0, 3, 18),
        600.0 * rng.normal(size=(count, 2, 3)),
        rng.uniform(-0.5, 0.5, count),
        rng.uniform(-0.5, 0.6, (count, 2)),
    )
    return lines, rng.uniform(size=count) < 0.9


def polynomials(rays, inliers):
    """(n,10) over the part of the image that the inliers fill."""
    low, high = rays[inliers].min(axis=0), rays[inliers].max(axis=0)
    x, y = ((2 * rays - low - high) / (high - low)).T
    orders = np.array(PLACES)
    sizes = DEGREE_SIZES[orders.sum(axis=1)] * np.sqrt(np.prod(2 * orders + 1, axis=1))
    series = np.eye(4)[:, orders.T]  # (4, 2, 10)
    terms = sizes * legendre.legval(x, series[:, 0]).T * legendre.legval(y, series[:, 1]).T
    return terms / np.sqrt(np.sum((1 + np.arange(4)) * DEGREE_SIZES**2))


def design(lines, inliers, turns=True, smooth=True):
    """All columns of the inliers as a plain matrix (2 n, m), and the errors (2 n,)."""
    errors, by_motion, by_turn, tau, rays = lines
    parts = [by_motion]
    if turns:
        turned = np.einsum("nk,nca->ncka", waves(tau, FUNCTIONS), by_turn)
        parts.append(turned.reshape(len(tau), 2, -1))
    if smooth:
        each = np.einsum("nk,cd->ncdk", polynomials(rays, inliers), np.eye(2))
        parts.append(each.reshape(len(tau), 2, -1))
    whole = np.concatenate(parts, axis=2)[inliers]
    return whole.reshape(-1, whole.shape[2]), errors[inliers].ravel()


@pytest.mark.parametrize(("turns", "smooth"), itertools.product([False, True], repeat=2))
def test_products_are_those_of_a_plain_design_matrix(turns, smooth):
    lines, inliers = lines_of()
    found = products_of(lines, inliers, lines.errors, turns, smooth, IMAGE)
    matrix, errors = design(lines, inliers, turns, smooth)
    scale = np.sqrt(np.sum(matrix**2, axis=0))
    np.testing.assert_allclose(
        found.products / np.outer(scale, scale), (matrix / scale).T @ (matrix / scale), atol=1e-12
    )
    np.testing.assert_allclose(found.with_errors / scale, -errors @ (matrix / scale), atol=1e-12)
    assert found.squared_errors == pytest.approx(errors @ errors)


def test_a_smooth_error_has_a_mean_square_of_its_scale_over_the_image():
    """The terms are orthogonal over a square."""
    grid = np.linspace(-1.0, 1.0, 201)
    image = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    terms, mean = np.empty(SMOOTH_TERMS), np.zeros((SMOOTH_TERMS, SMOOTH_TERMS))
    for ray in image:
        smooth_terms(ray, np.array([-1.0, -1.0]), np.array([1.0, 1.0]), terms)
        mean += np.outer(terms, terms) / len(image)
    assert np.trace(mean) == pytest.approx(1.0, rel=0.03)
    np.testing.assert_allclose(mean - np.diag(np.diag(mean)), 0.0, atol=0.01)


def test_the_smooth_error_of_all_points_is_that_of_its_polynomials():
    lines, inliers = lines_of(1)
    coefficients = np.random.default_rng(2).normal(size=(2, SMOOTH_TERMS))
    found = smooth_at(lines, inliers, coefficients.ravel(), IMAGE)
    expected = polynomials(lines.image, inliers) @ coefficients.T
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_the_prior_is_of_the_motion_without_its_turn():
    """Slope and information against finite differences of the cost, by motion and coefficients."""
    rng = np.random.default_rng(3)
    turns = 1e-4 * rng.normal(size=(FUNCTIONS, 3))
    whole, along, cost = full_prior(TERMS, STATE, turns, 18 + TURNS)

    def cost_at(step):
        other = turns + step[18:].reshape(FUNCTIONS, 3)
        return full_prior(TERMS, apply_step(STATE, step[:18]), other, 18 + TURNS)[2]

    # What the frame calls its velocity in the middle row is the motion's and the waves'.
    rate = STATE[12:15] - (np.pi * np.arange(1, 15)) @ turns[1::2]
    velocities = np.concatenate([rate, STATE[15:]])
    deviations = np.repeat([0.2, 0.1, 0.05, 0.03], 3)
    assert cost == pytest.approx(np.sum((velocities / deviations) ** 2))
    h = 1e-4
    units = np.eye(18 + TURNS)
    slope = np.array([(cost_at(h * e) - cost_at(-h * e)) / (4.0 * h) for e in units])
    np.testing.assert_allclose(along, slope, atol=1e-6 * np.abs(slope).max())
    chosen = rng.choice(18 + TURNS, 40, replace=False)
    chosen[:3] = 6, 18 + 3, 18 + 9  # rate about x, and two sines about x
    for i, j in itertools.product(chosen[:12], chosen):
        step = 1e-3 * units[i], 1e-3 * units[j]
        second = sum(
            a * b * cost_at(a * step[0] + b * step[1])
            for a, b in itertools.product((1, -1), repeat=2)
        )
        assert whole[i, j] == pytest.approx(second / 8e-6, abs=1e-4 * np.abs(whole).max())


@pytest.mark.parametrize("speed", [0.3, 0.03, 0.0])
def test_a_slower_motion_is_the_same_fit_under_another_prior(speed):
    """State, covariance and evidence against those of whole matrices, the noise being known."""
    rng = np.random.default_rng(5)
    size, terms = 18 + TURNS, motion_terms((0.2, 0.1), (0.05, 0.03))
    half = rng.normal(size=(size, size)) * 10.0 ** rng.uniform(-3.0, -1.0, size)
    half[:, 18:] *= 1e-2
    before, turns = half.T @ half, 1e-4 * rng.normal(size=(FUNCTIONS, 3))
    state = np.append(STATE[:12], rng.normal(size=12) * np.repeat([0.2, 0.1, 0.05, 0.03], 3))
    by_smooth = rng.normal(size=(size, 4)) * 0.3 * np.sqrt(np.diag(before))[:, None]
    found = at_speed(state, turns, before, by_smooth, 1e12, terms, speed, False)
    before = before + by_smooth @ by_smooth.T
    # What is known better: rates of the motion without its waves, and what follows them.
    own, slower = (
        np.diag(one.informations[0])[6:] for one in (terms, terms_at(terms, speed, False))
    )
    chosen, more = slower > own, slower - own
    without = np.eye(size)[6:18]
    without[:3, 18:] = -np.kron(np.ravel([[0.0, np.pi * k] for k in range(1, 15)]), np.eye(3))
    without, more = without[chosen], more[chosen]
    values = np.concatenate([np.zeros(6), state[12:], turns.ravel()])
    mean, spread = without @ values, without @ before @ without.T + np.diag(1.0 / more)
    gain = np.linalg.solve(spread, without @ before).T
    step, covariance = -gain @ mean, before - gain @ without @ before
    # Of what is the same in other frames it keeps as little as before.
    left = by_smooth - gain @ (without @ by_smooth)
    covariance -= left @ left.T
    deviations = np.sqrt(np.diag(before))
    np.testing.assert_allclose(
        found[2] / np.outer(deviations, deviations),
        covariance / np.outer(deviations, deviations), atol=1e-9,
    )  # fmt: skip
    np.testing.assert_allclose(found[0], apply_step(state, step[:18]), atol=1e-9)
    np.testing.assert_allclose(found[1].ravel(), turns.ravel() + step[18:], atol=1e-12)
    if speed > 0.0:
        # The mean of the ratio of both priors over the fit: Gaussian integrals.
        volumes = np.linalg.slogdet(np.eye(len(more)) + without @ before @ without.T * more)[1]
        volumes += np.sum(np.log(own[chosen] / slower[chosen]))
        assert found[3] == pytest.approx(
            -0.5 * (mean @ np.linalg.solve(spread, mean) + volumes), rel=1e-6
        )
    else:
        np.testing.assert_allclose(
            without @ np.concatenate([np.zeros(6), found[0][12:], found[1].ravel()]), 0.0, atol=1e-9
        )


HYPER_MEAN, HYPER_PRECISION = np.full(SCALES, np.log(3e-4)), np.full(SCALES, 0.2)
HYPER_MEAN[-1] = np.log(0.03)


def solved(lines, inliers, log_scales, rounds):
    normal = products_of(lines, inliers, lines.errors, True, True, IMAGE)
    information, slope, _ = full_prior(TERMS, STATE, np.zeros((FUNCTIONS, 3)), 18 + TURNS + 20)
    result = with_scales(
        normal, information, slope, np.zeros(TURNS + 20), log_scales, HYPER_MEAN,
        HYPER_PRECISION, NOISE, 2 * int(inliers.sum()), rounds,
    )  # fmt: skip
    return result, information, slope


def posterior(matrix, errors, information, slope, scales):
    """Mean and covariance of all parameters, by whole matrices."""
    ridge = np.zeros(matrix.shape[1])
    ridge[18:] = np.exp(-2.0 * scales[GROUPS])
    covariance = np.linalg.inv(matrix.T @ matrix / NOISE**2 + information + np.diag(ridge))
    return covariance @ (-matrix.T @ errors / NOISE**2 - slope), covariance


def test_at_held_scales_it_is_the_gaussian_posterior():
    lines, inliers = lines_of(4)
    scales = np.random.default_rng(0).uniform(np.log(1e-4), np.log(1e-2), SCALES)
    scales[-1] = np.log(0.5)
    found, information, slope = solved(lines, inliers, scales, 1)
    matrix, errors = design(lines, inliers)
    mean, covariance = posterior(matrix, errors, information, slope, scales)
    deviations = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(found.values / deviations, mean / deviations, atol=1e-5)
    np.testing.assert_allclose(
        found.covariance / np.outer(deviations, deviations),
        covariance / np.outer(deviations, deviations), atol=1e-5,
    )  # fmt: skip
    ridge = np.exp(-2.0 * scales[GROUPS])
    of_points = [np.sum((1.0 - ridge * np.diag(covariance)[18:])[g == GROUPS]) for g in range(15)]
    np.testing.assert_allclose(found.decided, of_points, atol=1e-4)
    left = errors + matrix @ mean
    assert found.left == pytest.approx(left @ left, rel=1e-6)
    assert found.prior_cost == pytest.approx(np.sum(ridge * mean[18:] ** 2), rel=1e-5)
    used = np.trace(covariance @ matrix.T @ matrix) / NOISE**2
    assert found.freedom == pytest.approx(max(len(errors) - used, 1.0), rel=1e-5)


def shaken_lines(seed):
    """Lines with an in-frame turn at two frequencies and a smooth error in them."""
    lines, inliers = lines_of(seed, 120)
    matrix, _ = design(lines, inliers)
    coefficients, rng = np.zeros(matrix.shape[1]), np.random.default_rng(seed)
    coefficients[18 + 12 : 18 + 18] = 3e-3 * rng.normal(size=6)
    coefficients[18 + 48 : 18 + 54] = 1e-3 * rng.normal(size=6)
    coefficients[18 + TURNS :] = 0.5 * rng.normal(size=20)
    lines.errors[inliers] -= (matrix @ coefficients).reshape(-1, 2)
    return lines, inliers, coefficients[18:]


def test_scales_are_where_their_probability_is_largest():
    """The slope of the dense Gaussian's log evidence and of the hyperprior is zero there."""
    lines, inliers, _ = shaken_lines(5)
    found, information, slope = solved(lines, inliers, np.full(SCALES, np.log(5e-3)), 200)
    matrix, errors = design(lines, inliers)

    def log_probability(scales):
        mean, covariance = posterior(matrix, errors, information, slope, scales)
        left = errors + matrix @ mean
        step = np.concatenate([mean[:18], mean[18:]])
        prior = step @ information @ step + 2.0 * slope @ step
        prior += np.sum(mean[18:] ** 2 * np.exp(-2.0 * scales[GROUPS]))
        volume = np.linalg.slogdet(covariance)[1] - 2.0 * np.sum(scales[GROUPS])
        hyper = np.sum(HYPER_PRECISION * (scales - HYPER_MEAN) ** 2)
        hyper += np.sum(np.diff(scales[:-1]) ** 2)  # neighbouring frequencies are alike
        return -0.5 * (left @ left / NOISE**2 + prior - volume + hyper)

    h = 1e-3
    best = found.log_scales
    for g in range(SCALES):
        if found.decided[g] < 0.5:
            continue  # columns of a negligible scale are left out
        e = h * np.eye(SCALES)[g]
        uphill = (log_probability(best + e) - log_probability(best - e)) / (2.0 * h)
        assert uphill == pytest.approx(0.0, abs=0.05)
    assert np.argmax(found.log_scales[:-1]) in (2, 8)


def fitted(observations, start, scales=(5e-3, 0.3), hyper=0.2, turns=True, smooth=True,
           bend=IMAGE):  # fmt: skip
    """``scales``: of turns and smooth error, where the fit starts."""
    first = np.full(SCALES, np.log(scales[0]))
    first[-1] = np.log(scales[1])
    mean = HYPER_MEAN if hyper < 1.0 else first
    return fit_frame(
        observations.packed, len(observations), start, PRIOR, 2.0,
        30.0, 2.0, first, mean, np.full(SCALES, hyper), turns, smooth, bend, 25,
    )  # fmt: skip


@pytest.mark.parametrize("direction", ["top_to_bottom", "right_to_left"])
def test_a_motion_with_an_in_frame_turn_is_recovered_without_noise(direction):
    state, points = scene(direction, 1, 150, speed=0.03, acceleration=0.0)
    coefficients = np.zeros((FUNCTIONS, 3))
    rng = np.random.default_rng(0)
    coefficients[[4, 5, 10, 11]] = 0.003 * rng.normal(size=(4, 3))
    rays, _ = project(state, points, direction, coefficients)
    observations = Observations.of(
        points,
        rays,
        row_time(pixels_of(rays), direction),
        jacobian_of(rays),
        Mounts.one(gradient(direction)),
    )
    start = apply_step(state, 0.002 * rng.normal(size=18))
    fit = fitted(observations, start, smooth=False)
    assert fit.finite
    assert fit.inliers.all()
    assert fit.noise < 0.02
    tau = np.linspace(-0.42, 0.42, 41)  # rows that see points

    def orientations(state, turn):
        moved = tau[:, None] * state[12:15] + 0.5 * tau[:, None] ** 2 * state[18:21]
        return (
            Rotation.from_rotvec(-turn)
            * Rotation.from_rotvec(-moved)
            * Rotation.from_matrix(state[:9].reshape(3, 3))
        )

    found = orientations(fit.state, shake_at(tau, fit.turns)[:, :3])
    off = (found * orientations(state, shake(tau, coefficients)).inv()).magnitude()
    assert np.sqrt(np.mean(off**2)) < np.radians(0.005)  # it swings by half a degree
    assert set(np.argsort(fit.log_scales[:-1])[-2:]) == {2, 5}


def test_without_anything_to_explain_the_fit_is_the_plain_one():
    """At scales that are held to nothing: state, covariance, noise and inliers."""
    for seed in range(3):
        observations, truth = frame(seed, 0.05, 0.5, 80)
        plain = maximum_a_posteriori(observations, truth, PRIOR, 2.0)
        fit = fitted(observations, truth, (1e-6, 1e-6), 1e6)
        np.testing.assert_array_equal(fit.inliers, plain.inliers)
        assert fit.noise == pytest.approx(plain.noise, rel=0.01)
        assert distance(plain, fit.state, slice(0, 18)) < 0.02
        scale = np.sqrt(np.diag(plain.covariance))
        np.testing.assert_allclose(
            fit.covariance[:18, :18] / np.outer(scale, scale),
            plain.covariance / np.outer(scale, scale), atol=0.03,
        )  # fmt: skip


@pytest.mark.parametrize("seed", range(4))
def test_a_small_plane_is_fitted_from_another_lean(seed):
    """The valley of lean and velocities bends: full steps leave it, and lose all points."""
    rng = np.random.default_rng(seed)
    points = np.append(rng.uniform(-0.1, 0.1, (40, 2)), np.zeros((40, 1)), axis=1)
    tilted = Rotation.from_rotvec([0.3, 0.1, 0.0])
    state = np.concatenate([tilted.as_matrix().ravel(), [0.0, 0.0, 2.0], np.zeros(12)])
    state[12:18] = 0.05 * rng.normal(size=6)
    observations = observe(state, points, 1.0, rng)
    start = state.copy()
    axis = rng.normal(size=2)
    lean = Rotation.from_rotvec([*(0.35 * axis / np.linalg.norm(axis)), 0.0])
    start[:9], start[12:] = (lean * tilted).as_matrix().ravel(), 0.0
    fit = fitted(observations, start, turns=False, smooth=False)
    assert fit.finite
    assert fit.inliers.all()
    assert np.sum(fit.squared_errors) < np.sum(observations.squared_errors(state))


def test_scales_cost_what_is_known_of_them_and_gain_what_is_not():
    """The hyperprior's Gaussian, and Laplace's volume, with plain matrices."""
    rng = np.random.default_rng(5)
    scales, precision = rng.normal(size=SCALES), rng.uniform(0.2, 4.0, SCALES)
    mean, decided = rng.normal(size=SCALES), rng.uniform(0.0, 5.0, SCALES)
    chain = np.diff(np.eye(SCALES - 1), axis=0)  # neighbouring frequencies, to a factor of e
    alike = np.zeros((SCALES, SCALES))
    alike[:-1, :-1] = chain.T @ chain
    for first, last in ((0, SCALES), (0, SCALES - 1), (SCALES - 1, SCALES)):
        part = slice(first, last)
        before = (np.diag(precision) + alike)[part, part]
        away, differences = (
            (scales - mean)[part],
            (chain @ scales[:-1])[: last if first == 0 else 0],
        )
        cost, volume, spread = _of_scales(scales - mean, scales, precision, decided, first, last)
        expected = np.sum(precision[part] * away**2) + np.sum(differences**2)
        assert cost == pytest.approx(expected)
        after = before + 2.0 * np.diag(decided[part])
        expected = np.linalg.slogdet(before)[1] - np.linalg.slogdet(after)[1]
        assert volume == pytest.approx(expected)
        np.testing.assert_allclose(spread, np.linalg.inv(after), atol=1e-12)


def test_scales_that_are_not_known_move_the_motion_as_differences_say():
    lines, inliers = lines_of(4)
    scales = np.random.default_rng(0).uniform(np.log(1e-4), np.log(1e-2), SCALES)
    scales[-1] = np.log(0.5)
    found, information, slope = solved(lines, inliers, scales, 1)
    matrix, errors = design(lines, inliers)

    def mean(change):
        return posterior(matrix, errors, information, slope, scales + change)[0][: 18 + TURNS]

    steps = 1e-4 * np.eye(SCALES)[:-1]
    slopes = np.array([(mean(step) - mean(-step)) / 2e-4 for step in steps]).T
    half = np.random.default_rng(1).normal(size=(SCALES, SCALES))
    spread = half @ half.T
    expected = slopes @ spread[:-1, :-1] @ slopes.T
    added = _by_scales(found.covariance[: 18 + TURNS], found.values[18:], scales, GROUPS, spread)
    size = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        added / np.outer(size, size), expected / np.outer(size, size), atol=1e-3
    )


def test_too_few_points_are_no_fit():
    observations, truth = frame(0, 0.02, 0.3, 5)
    assert not fitted(observations, truth).finite


@pytest.mark.parametrize("of_map", [False, True], ids=["image", "map"])
def test_the_covariance_is_beside_the_smooth_error_and_allows_for_it(of_map):
    """That of the noise and of what the prior allows, of a best motion that weighs both."""
    observations, state = frame(2, 0.02, NOISE)
    bend = np.ascontiguousarray(observations.points[:, :2]) if of_map else IMAGE
    scale = 0.01 if of_map else 0.7
    fit = fitted(observations, state, (5e-3, scale), 1e9, turns=False, bend=bend)
    assert fit.inliers.all()
    lines = linearized(
        observations.packed, len(observations), fit.state,
        np.zeros((len(observations), 6)),
    )  # fmt: skip
    matrix, _ = design(lines, fit.inliers, turns=False, smooth=not of_map)
    motion, smooth = matrix[:, :18], matrix[:, 18:]
    if of_map:  # a point that moves by (x, y) times a coefficient along each axis of the camera
        moved = -lines.by_motion[:, :, 3:6]
        smooth = np.einsum("nka,nb->nkba", moved, bend).reshape(len(motion), -1)
    information, slope = np.zeros((18, 18)), np.zeros(18)
    add_prior(PRIOR, fit.state, 1.0, information, slope)
    inverse = np.linalg.inv(fit.noise**2 * np.eye(len(motion)) + scale**2 * smooth @ smooth.T)
    whole = np.linalg.inv(motion.T @ inverse @ motion + information)
    gain = whole @ motion.T @ inverse
    own = fit.noise**2 * gain @ gain.T + whole @ information @ whole
    deviations = np.sqrt(np.diag(own))
    np.testing.assert_allclose(fit.covariance / np.outer(deviations, deviations),
                               own / np.outer(deviations, deviations), atol=0.02)  # fmt: skip
    assert (np.diag(whole)[:6] > 1.2 * np.diag(own)[:6]).any()


def test_neighbours_agree_where_errors_are_shared_and_not_where_they_are_noise():
    rng = np.random.default_rng(5)
    tau, everything = rng.uniform(-0.5, 0.5, 60), np.ones(60, dtype=bool)
    rays = np.column_stack([rng.uniform(-0.6, 0.6, 60), tau])
    noise = np.array(
        [neighbours_agree(rng.normal(size=(60, 2)), tau, rays, everything) for _ in range(3000)]
    )
    assert abs(noise.mean()) < 0.1
    assert noise.std() == pytest.approx(1.0, abs=0.06)
    shared = np.column_stack([np.sin(9 * tau), np.cos(9 * tau)]) + rng.normal(size=(60, 2))
    assert neighbours_agree(shared, tau, rays, everything) > 2.5
    # Rows that do not count stand between no neighbours.
    strewn = np.where(np.arange(60)[:, None] % 3, shared, 100.0 * rng.normal(size=(60, 2)))
    counting = np.arange(60) % 3 > 0
    assert neighbours_agree(strewn, tau, rays, counting) == pytest.approx(
        neighbours_agree(strewn[counting], tau[counting], rays[counting], everything[counting])
    )
    assert neighbours_agree(shared, tau, rays, ~everything) == 0.0
    # Nor do those that stand together in the image.
    corner = np.where(np.arange(60)[:, None] == 0, 1.0, 0.001 * rays)
    assert abs(neighbours_agree(shared, tau, corner, everything)) < 2.0
