"""Shaking and fields: their columns, how large they are, and what they do to the covariance."""

import itertools

import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy.linalg import null_space
from scipy.spatial import cKDTree

from rs_localizer.core.shake import shake_at, shake_basis, shake_in_the_middle
from rs_localizer.estimation.columns import columns_of, with_prior
from rs_localizer.estimation.evidence import (
    evidence_of_sizes,
    possible,
    project_out,
    sizes_of,
    tridiagonal,
)
from rs_localizer.estimation.model_error import neighbours_agree, shared_errors, with_model_error
from rs_localizer.estimation.prior_terms import motion_terms
from rs_localizer.estimation.residuals import Lines

from .projection import polynomials

COUNT, DEGREES = 40, 6
SHAKE = 3 * (DEGREES - 1)
DEVIATION = 0.3  # px
# Polynomials of the image, from the constant to the cubic ones, and the sizes of each degree.
PLACES = [(i, degree - i) for degree in range(4) for i in range(degree + 1)]
DEGREE_SIZES = np.array([1.0, 1.0, 0.5, 0.25])


@pytest.mark.parametrize("tau", [-0.5, -0.2, 0.0, 0.37, 0.5])
def test_the_shaking_is_a_sum_of_legendre_polynomials(tau):
    values, rates = np.empty(11), np.empty(11)
    shake_basis(tau, 12, values, rates)
    h, here = 1e-6, np.array([tau])
    np.testing.assert_allclose(values, polynomials(here, 11)[0], atol=1e-13)
    ahead, behind = polynomials(here + h, 11), polynomials(here - h, 11)
    np.testing.assert_allclose(rates, (ahead - behind)[0] / (2 * h), atol=1e-6)
    if tau == 0.0:
        np.testing.assert_allclose([values, rates], 0.0, atol=1e-15)


def test_the_shaking_of_many_rows_and_what_is_taken_away_in_the_middle():
    rng = np.random.default_rng(0)
    tau, coefficients = rng.uniform(-0.5, 0.5, 9), rng.normal(size=(7, 3))
    found, h = shake_at(tau, coefficients), 1e-6
    np.testing.assert_allclose(found[:, :3], polynomials(tau, 7) @ coefficients, atol=1e-13)
    ahead, behind = (polynomials(tau + x, 7) @ coefficients for x in (h, -h))
    np.testing.assert_allclose(found[:, 3:], (ahead - behind) / (2 * h), atol=1e-6)
    assert not shake_at(tau, np.zeros((0, 3))).any()
    values, slopes = shake_in_the_middle(7)
    sizes = (3.0 / np.arange(2, 9)) ** 2
    series = np.vstack([np.zeros((2, 7)), np.diag(sizes)])
    np.testing.assert_allclose(values, legendre.legval(0.0, series), atol=1e-15)
    np.testing.assert_allclose(slopes, 2 * legendre.legval(0.0, legendre.legder(series)))


def frame(seed=0, count=COUNT):
    """Random lines of a frame, and the inliers."""
    rng = np.random.default_rng(seed)
    lines = Lines(
        DEVIATION * rng.normal(size=(count, 2)),
        rng.normal(size=(count, 2, 18)) * 10.0 ** rng.uniform(0, 3, 18),
        600.0 * rng.normal(size=(count, 2, 3)),
        rng.uniform(-0.5, 0.5, count),
        rng.uniform(-0.5, 0.6, (count, 2)),
    )
    return lines, rng.uniform(size=count) < 0.9


def design(lines, inliers, shake=True, field=True):
    """All columns as a plain matrix (2 n, m), and the errors (2 n,)."""
    errors, by_motion, by_turn, tau, rays = lines
    parts = [by_motion]
    if shake:
        turned = np.einsum("nk,nca->ncka", polynomials(tau, DEGREES - 1), by_turn)
        parts.append(turned.reshape(len(tau), 2, -1))
    if field:
        low, high = rays[inliers].min(axis=0), rays[inliers].max(axis=0)
        x, y = ((2 * rays - low - high) / (high - low)).T
        orders = np.array(PLACES)
        sizes = DEGREE_SIZES[orders.sum(axis=1)] * np.sqrt(np.prod(2 * orders + 1, axis=1))
        series = np.eye(4)[:, orders.T]  # (4, 2, 10)
        terms = sizes * legendre.legval(x, series[:, 0]).T * legendre.legval(y, series[:, 1]).T
        terms /= np.sqrt(np.sum((1 + np.arange(4)) * DEGREE_SIZES**2))
        parts.append(np.einsum("nk,cd->ncdk", terms, np.eye(2)).reshape(len(tau), 2, -1))
    whole = np.concatenate(parts, axis=2)[inliers]
    return whole.reshape(-1, whole.shape[2]), errors[inliers].ravel()


@pytest.mark.parametrize("count", [COUNT, 700])  # within one chunk, and in three
@pytest.mark.parametrize(("shake", "field"), itertools.product([False, True], repeat=2))
def test_columns_are_those_of_a_plain_design_matrix(shake, field, count):
    lines = frame(count=count)
    found = columns_of(*lines, DEGREES if shake else 0, field)
    matrix, errors = design(*lines, shake=shake, field=field)
    scale = np.sqrt(np.sum(matrix**2, axis=0))
    np.testing.assert_allclose(
        found.products / np.outer(scale, scale), (matrix / scale).T @ (matrix / scale), atol=1e-12
    )
    np.testing.assert_allclose(found.with_errors / scale, -errors @ (matrix / scale), atol=1e-12)
    assert found.squared_errors == pytest.approx(errors @ errors)
    assert found.shake == (SHAKE if shake else 0)


def test_a_field_has_a_mean_square_of_one_over_the_image():
    """The terms are orthogonal over a square."""
    grid = np.linspace(-1, 1, 301)
    rays = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    many = len(rays)
    nothing = np.zeros((many, 2)), np.zeros((many, 2, 18)), np.zeros((many, 2, 3)), np.zeros(many)
    found = columns_of(Lines(*nothing, rays), np.ones(many, dtype=bool), 0, True)
    mean = found.products[18:, 18:] / many
    assert np.trace(mean) == pytest.approx(2.0, rel=0.03)  # two directions
    degrees = np.tile([sum(place) for place in PLACES], 2)
    for degree, size in enumerate(DEGREE_SIZES):
        expected = 2 * (degree + 1) * size**2 / np.sum((1 + np.arange(4)) * DEGREE_SIZES**2)
        assert np.diag(mean)[degrees == degree].sum() == pytest.approx(expected, rel=0.03)


TERMS = motion_terms((0.2, 0.1), (0.05, 0.03))
STATE = np.concatenate([np.eye(3).ravel(), np.zeros(3), 0.002 * np.arange(12)])
PRECISIONS = np.diag(TERMS.informations[0])


def whole(seed=0):
    """Columns with the prior, and the same as one dense matrix whose rows have unit deviation."""
    lines = frame(seed)
    columns = with_prior(columns_of(*lines, DEGREES, True), TERMS, STATE, DEVIATION)
    return columns, *design(*lines)


def test_the_prior_is_weighed_against_the_noise():
    columns, matrix, errors = whole()
    added = np.zeros(matrix.shape[1])
    added[:18] = DEVIATION**2 * PRECISIONS
    np.testing.assert_allclose(columns.products, matrix.T @ matrix + np.diag(added), rtol=1e-9,
                               atol=1e-6)  # fmt: skip
    offset = np.concatenate([np.zeros(6), STATE[12:]])
    expected = -errors @ matrix
    expected[:18] -= DEVIATION**2 * PRECISIONS * offset
    np.testing.assert_allclose(columns.with_errors, expected, rtol=1e-9, atol=1e-7)
    cost = errors @ errors + DEVIATION**2 * offset @ (PRECISIONS * offset)
    assert columns.squared_errors == pytest.approx(cost)


SHAKING, FIELDS = np.arange(18, 18 + SHAKE), np.arange(18 + SHAKE, 38 + SHAKE)


def dense(matrix, errors, noise, *groups):
    """Mahalanobis distance of the errors and log determinant of their covariance, but for poses.

    ``groups``: columns and the standard deviation of their coefficients. What the pose, of which
    nothing is known, could explain is left out of the errors.
    """
    free = null_space(matrix[:, :6].T).T
    # The columns weighed the prior against another noise.
    spread = (noise / DEVIATION) ** 2 / PRECISIONS[6:18]
    covariance = noise**2 * np.eye(len(errors)) + (matrix[:, 6:18] * spread) @ matrix[:, 6:18].T
    for columns, deviation in groups:
        covariance += deviation**2 * matrix[:, columns] @ matrix[:, columns].T
    covariance = free @ covariance @ free.T
    # At the prior's mean the motion is a step of -STATE away.
    off = free @ (errors - matrix[:, 6:18] @ STATE[12:])
    return off @ np.linalg.solve(covariance, off), np.linalg.slogdet(covariance)[1]


def dense_evidence(matrix, errors, freedom, noise, group, size, *beside):
    """As :func:`evidence_of_sizes` defines it: the noise is what the errors leave, three times."""
    for _ in range(3):
        before = noise  # px
        held = [(columns, before / weight) for columns, weight in beside]
        distance, volume = dense(matrix, errors, before, (group, size), *held)
        noise = before * np.sqrt(distance / freedom)
    volume -= dense(matrix, errors, before, *held)[1]
    return -0.5 * (freedom * np.log(noise**2) + volume), noise


@pytest.mark.parametrize("group", [SHAKING, FIELDS], ids=["shake", "field"])
def test_the_evidence_is_that_of_the_dense_gaussian(group):
    columns, matrix, errors = whole()
    order = np.concatenate([np.arange(18), group])
    projected = project_out(
        np.ascontiguousarray(columns.products[np.ix_(order, order)]), columns.with_errors[order],
        columns.squared_errors, len(group),
    )  # fmt: skip
    # What the motion leaves, by the dense formula without any group.
    left, _ = dense(matrix, errors, DEVIATION)
    assert projected.squared_errors == pytest.approx(DEVIATION**2 * left, rel=1e-9)
    sizes, freedom = np.array([1e-6, 1e-4, 1e-2, 1.0]), 60.0
    for size in sizes:
        found = evidence_of_sizes(projected, np.array([size]), freedom, 0.4)
        expected = dense_evidence(matrix, errors, freedom, 0.4, group, size)
        np.testing.assert_allclose(np.ravel(found), expected, rtol=1e-7, atol=1e-6)


def test_sizes_are_weighed_by_their_probabilities():
    evidence, prior = np.array([-700.0, -701.0, -705.0]), np.array([0.5, 0.3, 0.2])
    sizes, noises = np.array([1.0, 2.0, 3.0]), np.array([0.5, 0.4, 0.3])
    weights = prior * np.exp(evidence + 700.0)
    total = weights.sum()
    expected = [weights @ sizes**2 / total, weights @ noises / total, weights[0] / total,
                -700.0 + np.log(total)]  # fmt: skip
    np.testing.assert_allclose(possible(evidence, prior, sizes, noises), expected)


SHAKE_SIZES, FIELD_SIZES = np.array([1e-6, 1e-3]), np.array([0.01, 1.0])
EVEN = np.array([0.5, 0.5])


def log_odds(probability):
    return np.log(probability) - np.log1p(-probability)


@pytest.mark.parametrize("kind", ["shake", "field"])
def test_what_explains_more_is_weighed_first_and_the_other_beside_it(kind):
    lines = frame(3)
    matrix, errors = design(*lines)
    group, size = (SHAKING, 1e-3) if kind == "shake" else (FIELDS, 1.0)
    coefficients = np.random.default_rng(8).normal(size=len(group))
    lines[0].errors[lines[1]] += (size * matrix[:, group] @ coefficients).reshape(-1, 2)
    _, errors = design(*lines)
    columns = with_prior(columns_of(*lines, DEGREES, True), TERMS, STATE, DEVIATION)
    freedom = len(errors) - 6.0
    found = sizes_of(columns, freedom, DEVIATION, SHAKE_SIZES, EVEN, FIELD_SIZES, EVEN)
    assert found.noise == pytest.approx(DEVIATION, rel=0.25)
    least, most = (found.no_shake, found.no_field)[:: 1 if kind == "shake" else -1]
    assert least < 1e-6
    assert most > 0.5

    def evidence(columns, size, noise, *beside):
        return dense_evidence(matrix, errors, freedom, noise, columns, size, *beside)

    first_sizes, other, other_sizes = (
        (SHAKE_SIZES, FIELDS, FIELD_SIZES) if kind == "shake" else
        (FIELD_SIZES, SHAKING, SHAKE_SIZES)
    )  # fmt: skip
    alone = np.array([evidence(group, s, DEVIATION) for s in first_sizes])
    weights = np.exp(alone[:, 0] - alone[:, 0].max())
    weights /= weights.sum()
    of_size, of_noise = np.sqrt(weights @ first_sizes**2), weights @ alone[:, 1]
    assert (found.shake if kind == "shake" else found.field) == pytest.approx(of_size, rel=0.01)
    pair = [evidence(other, s, of_noise, (group, of_noise / of_size))[0] for s in other_sizes]
    # The noise that goes with a size is found by steps, from that of the size before.
    assert log_odds(most) == pytest.approx(pair[0] - pair[1], abs=0.5)


def test_without_shaking_the_field_has_the_evidence_of_its_sizes():
    lines = frame(2)
    columns = with_prior(columns_of(*lines, 0, True), TERMS, STATE, DEVIATION)
    found = sizes_of(columns, 60.0, DEVIATION, SHAKE_SIZES, EVEN, FIELD_SIZES, EVEN)
    matrix, errors = design(*lines)
    evidence = [
        dense_evidence(matrix, errors, 60.0, DEVIATION, FIELDS, size)[0] for size in FIELD_SIZES
    ]
    assert log_odds(found.no_field) == pytest.approx(evidence[0] - evidence[1], abs=0.1)
    assert found.evidence == pytest.approx(np.log(0.5) + np.logaddexp(*evidence), abs=0.1)
    assert (found.shake, found.no_shake) == (0.0, 1.0)


def test_the_covariance_is_that_of_a_best_motion_which_knows_of_no_field():
    columns, matrix, errors = whole()
    noise, shake, field = 0.35, 2e-4, 0.2
    step, covariance = with_model_error(columns, noise, shake, field)
    kept = matrix[:, : 18 + SHAKE]
    ridge = np.zeros(18 + SHAKE)
    ridge[:18] = DEVIATION**2 * PRECISIONS
    ridge[18:] = noise**2 / shake**2
    inverse = np.linalg.inv(kept.T @ kept + np.diag(ridge))
    gain = inverse @ kept.T
    pull = np.zeros(18 + SHAKE)
    pull[:18] = -ridge[:18] * np.concatenate([np.zeros(6), STATE[12:]])
    np.testing.assert_allclose(step, inverse @ pull - gain @ errors, rtol=1e-6, atol=1e-9)
    disturbed = gain @ matrix[:, FIELDS]  # by the field, which the estimate does not allow for
    expected = noise**2 * inverse + field**2 * disturbed @ disturbed.T
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-7
    )


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


@pytest.mark.parametrize("kind", ["shake", "field"])
def test_what_a_frame_says_of_sizes_are_its_likelihoods(kind):
    """Logarithms, less that of the first: of what explains more by itself, and the other beside."""
    lines = frame(3)
    matrix, _ = design(*lines)
    group, size = (SHAKING, 1e-3) if kind == "shake" else (FIELDS, 1.0)
    coefficients = np.random.default_rng(8).normal(size=len(group))
    lines[0].errors[lines[1]] += (size * matrix[:, group] @ coefficients).reshape(-1, 2)
    _, errors = design(*lines)
    columns = with_prior(columns_of(*lines, DEGREES, True), TERMS, STATE, DEVIATION)
    sizes, freedom = np.array([1e-5, 1e-4, 1e-3]) * 10.0 ** (3 * (kind == "field")), 70.0
    tried = {"shake": SHAKE_SIZES, "field": FIELD_SIZES} | {kind: sizes}
    even = {name: np.full(len(each), 1 / len(each)) for name, each in tried.items()}
    found = sizes_of(
        columns, freedom, DEVIATION, tried["shake"], even["shake"], tried["field"], even["field"]
    )
    of_sizes = {"shake": found.of_shake_sizes, "field": found.of_field_sizes}
    expected = np.array(
        [dense_evidence(matrix, errors, freedom, DEVIATION, group, s)[0] for s in sizes]
    )
    # Each begins with the noise of the size before: the third step is nearly there.
    np.testing.assert_allclose(of_sizes[kind], expected - expected[0], rtol=0.02, atol=0.1)
    assert of_sizes[kind][-1] > 5.0
    for name, each in of_sizes.items():
        assert each.shape == tried[name].shape
        assert each[0] == 0.0


def test_errors_are_shared_as_far_as_the_nearest_neighbours_say():
    rng = np.random.default_rng(2)
    rays, everything = rng.uniform(-0.5, 0.5, (80, 2)), np.ones(80, dtype=bool)
    inliers = rng.uniform(size=80) < 0.8
    for correlation in (0.0, 0.5, 0.95):
        # Corners of markers: two near each other, with part of their errors in common.
        rays[1::2] = rays[::2] + 1e-3
        own = rng.normal(size=(80, 2))
        common = np.repeat(rng.normal(size=(40, 2)), 2, axis=0)
        errors = np.sqrt(correlation) * common + np.sqrt(1 - correlation) * own
        for counting in (everything, inliers):
            chosen, at = errors[counting], rays[counting]
            nearest = cKDTree(at).query(at, k=2)[1][:, 1]
            raw = np.sum(chosen * chosen[nearest]) / np.sum(chosen**2)
            expected = np.clip(raw - 1.5 / np.sqrt(2 * len(chosen)), 0.0, 0.9)
            found = shared_errors(errors, rays, counting)
            assert found == pytest.approx(expected)
            assert shared_errors(7.0 * errors, rays - 3.0, counting) == pytest.approx(found)


def test_noise_is_rarely_said_to_be_shared():
    rng = np.random.default_rng(3)
    rays, everything = rng.uniform(-0.5, 0.5, (100, 2)), np.ones(100, dtype=bool)
    found = np.array(
        [shared_errors(rng.normal(size=(100, 2)), rays, everything) for _ in range(300)]
    )
    # Nearest neighbours are often each other's: the correlation scatters by more than one sigma.
    assert np.mean(found > 0.0) < 0.2
    assert found.max() < 0.3
    assert shared_errors(np.zeros((100, 2)), rays, everything) == 0.0
    assert shared_errors(rng.normal(size=(100, 2)), rays, ~everything) == 0.0


@pytest.mark.parametrize("size", [1, 2, 3, 20])
def test_a_tridiagonal_form_has_the_same_eigenvalues_and_solutions(size):
    rng = np.random.default_rng(size)
    root, column = rng.normal(size=(size + 2, size)), rng.normal(size=size)
    matrix = root.T @ root
    lower = np.tril(matrix) + np.triu(np.full((size, size), np.nan), 1)  # the rest is not read
    for side in (column, np.zeros(size)):
        diagonal, beside, length = tridiagonal(lower, side)
        found = np.diag(diagonal) + np.diag(beside[:-1], 1) + np.diag(beside[:-1], -1)
        expected = np.linalg.eigvalsh(matrix)
        np.testing.assert_allclose(np.linalg.eigvalsh(found), expected, atol=1e-12)
        for shift in (0.5, 20.0):
            solved = np.linalg.solve(matrix + shift * np.eye(size), side)
            along = length * np.linalg.solve(found + shift * np.eye(size), np.eye(size)[0])
            assert length * along[0] == pytest.approx(side @ solved, abs=1e-12)
