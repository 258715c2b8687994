"""Shaking and fields: their columns, how large they are, and what they do to the covariance."""

import itertools

import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy.stats import multivariate_normal, norm

from rs_localizer.core.model_error import (
    Columns,
    columns_of,
    evidence_of_sizes,
    neighbours_agree,
    possible,
    project_out,
    shake_at,
    shake_basis,
    shake_in_the_middle,
    sizes_of,
    with_model_error,
    with_prior,
)
from rs_localizer.core.prior import motion_terms

from .projection import polynomials

COUNT, DEGREES, FIELD = 40, 6, 20
SHAKE = 3 * (DEGREES - 1)
DEVIATION = 0.3  # px
# Polynomials of the image, from the constant to the cubic ones, and the sizes of each degree.
PLACES = [(i, degree - i) for degree in range(4) for i in range(degree + 1)]
DEGREE_SIZES = np.array([1.0, 0.2, 0.5, 0.25])


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
    series = np.vstack([np.zeros((2, 7)), np.eye(7)])
    np.testing.assert_allclose(values, legendre.legval(0.0, series), atol=1e-15)
    np.testing.assert_allclose(slopes, 2 * legendre.legval(0.0, legendre.legder(series)))


def frame(seed=0):
    """Random lines of a frame: errors, by_motion, by_turn, tau, rays, inliers."""
    rng = np.random.default_rng(seed)
    return (
        DEVIATION * rng.normal(size=(COUNT, 2)),
        rng.normal(size=(COUNT, 2, 18)) * 10.0 ** rng.uniform(0, 3, 18),
        600.0 * rng.normal(size=(COUNT, 2, 3)),
        rng.uniform(-0.5, 0.5, COUNT),
        rng.uniform(-0.5, 0.6, (COUNT, 2)),
        rng.uniform(size=COUNT) < 0.9,
    )


def design(errors, by_motion, by_turn, tau, rays, inliers, shake=True, field=True):
    """All columns as a plain matrix (2 n, m), and the errors (2 n,)."""
    parts = [by_motion]
    if shake:
        turned = np.einsum("nk,nca->ncka", polynomials(tau, DEGREES - 1), by_turn)
        parts.append(turned.reshape(COUNT, 2, -1))
    if field:
        low, high = rays[inliers].min(axis=0), rays[inliers].max(axis=0)
        x, y = ((2 * rays - low - high) / (high - low)).T
        orders = np.array(PLACES)
        sizes = DEGREE_SIZES[orders.sum(axis=1)] * np.sqrt(np.prod(2 * orders + 1, axis=1))
        series = np.eye(4)[:, orders.T]  # (4, 2, 10)
        terms = sizes * legendre.legval(x, series[:, 0]).T * legendre.legval(y, series[:, 1]).T
        terms /= np.sqrt(np.sum((1 + np.arange(4)) * DEGREE_SIZES**2))
        parts.append(np.einsum("nk,cd->ncdk", terms, np.eye(2)).reshape(COUNT, 2, -1))
    whole = np.concatenate(parts, axis=2)[inliers]
    return whole.reshape(-1, whole.shape[2]), errors[inliers].ravel()


@pytest.mark.parametrize(("shake", "field"), itertools.product([False, True], repeat=2))
def test_columns_are_those_of_a_plain_design_matrix(shake, field):
    lines = frame()
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
    grid = np.linspace(-1, 1, 81)
    rays = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    many = len(rays)
    nothing = np.zeros((many, 2)), np.zeros((many, 2, 18)), np.zeros((many, 2, 3)), np.zeros(many)
    found = columns_of(*nothing, rays, np.ones(many, dtype=bool), 0, True)
    mean = found.products[18:, 18:] / many
    assert np.trace(mean) == pytest.approx(2.0, rel=0.05)  # two directions
    degrees = np.tile([sum(place) for place in PLACES], 2)
    for degree, size in enumerate(DEGREE_SIZES):
        expected = 2 * (degree + 1) * size**2 / np.sum((1 + np.arange(4)) * DEGREE_SIZES**2)
        assert np.diag(mean)[degrees == degree].sum() == pytest.approx(expected, rel=0.06)


TERMS = motion_terms((0.2, 0.1), (0.05, 0.03))
STATE = np.concatenate([np.eye(3).ravel(), np.zeros(3), 0.01 * np.arange(12)])
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


def marginal(matrix, errors, group, size, beside=(), beside_size=0.0, noise=DEVIATION):
    """Dense logarithm of the density of the errors, the prior motion and its zero mean in it."""
    poses = 1e6  # px: what no prior holds is nearly free
    spread = np.concatenate([np.full(6, poses**2), 1.0 / PRECISIONS[6:18]])
    spread[:6] /= np.sum(matrix[:, :6] ** 2, axis=0)
    centre = np.concatenate([np.zeros(6), STATE[12:]])
    covariance = noise**2 * np.eye(len(errors)) + (matrix[:, :18] * spread) @ matrix[:, :18].T
    for columns, deviation in ((group, size), (beside, beside_size)):
        part = matrix[:, columns]
        covariance += deviation**2 * part @ part.T
    # The errors are linear in the motion, whose mean by the prior is ``-centre`` away.
    mean = -matrix[:, :18] @ centre
    return multivariate_normal(mean, covariance, allow_singular=True).logpdf(errors)


GROUPS = {"shake": np.arange(18, 18 + SHAKE), "field": np.arange(18 + SHAKE, 18 + SHAKE + FIELD * 2 // 2)}  # fmt: skip
