# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The compiled parts of the readout watch, against the same in plain NumPy."""

import numpy as np
import projector
import pytest

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.trajectory.online_readout import single_image_likelihood
from rs_localizer.trajectory.readout_equations import SIDE, Equations, View, equation, score


def covariance(rng: np.random.Generator, size: int) -> Array:
    root = rng.normal(size=(size, 2 * size))
    scale = 10.0 ** rng.uniform(-2.0, 0.0, size)
    return root @ root.T * np.outer(scale, scale)


def equations(rng: np.random.Generator, count: int) -> Equations:
    both = np.array([covariance(rng, 2 * SIDE) for _ in range(count)])
    x = rng.normal(size=(count, SIDE))
    parts = both[:, :SIDE, :SIDE], both[:, SIDE:, :SIDE], both[:, SIDE:, SIDE:]
    return Equations(
        x, 0.03 * x + 0.1 * rng.normal(size=x.shape), *map(np.ascontiguousarray, parts)
    )


def plain_score(of: Equations, value: float) -> tuple[Array, float, float]:
    motion = np.diag(np.square([1.0, 1.0, 1.0, 0.5, 0.5, 0.5]))
    error = of.y - value * of.x
    mixed = np.swapaxes(of.yx, 1, 2) - value * of.xx
    weights = np.linalg.inv(of.yy - value * (of.yx + np.swapaxes(of.yx, 1, 2)) + value**2 * of.xx)
    squared = np.einsum("ni,nij,nj->n", error, weights, error)
    scale = max(1.0, float(np.median(squared)) / 5.35)
    robust = np.minimum(1.0, np.sqrt(12.6 * scale / np.maximum(squared, 1e-12)))
    taken = mixed @ weights
    left = of.xx - taken @ np.swapaxes(mixed, 1, 2)
    shrink = motion @ np.linalg.inv(motion + left)
    way = np.einsum("nij,nj->ni", shrink, of.x - np.einsum("nij,nj->ni", taken, error))
    weights *= (robust / scale)[:, None, None]
    pulled = np.einsum("nij,nj->ni", weights, way)
    noise = float(np.einsum("nij,njk,nki->", weights, shrink, left))
    return np.sum(pulled * error, axis=1), float(np.sum(pulled * of.x)) - noise, noise


@pytest.mark.parametrize("value", [0.0, 0.03, -0.2])
def test_the_score_is_that_of_plain_matrices(value):
    of = equations(np.random.default_rng(0), 40)
    of.y[7] *= 100.0  # an outlier
    terms, slope, noise = plain_score(of, value)
    found = score(of, value)
    np.testing.assert_allclose(found.terms, terms, rtol=1e-8, atol=1e-10 * np.abs(terms).max())
    assert (found.slope, found.noise) == pytest.approx((slope, noise), rel=1e-8)


def test_a_covariance_that_is_none_is_seen():
    of = equations(np.random.default_rng(0), 5)
    of.yy[2] = -np.eye(SIDE)
    assert np.isnan(score(of, 0.0).slope)


def test_the_equation_of_three_views_holds_for_a_steady_turn():
    """A camera that turns and travels steadily in its own axes: y = T x with T = 1 / rate."""
    rng = np.random.default_rng(1)
    turn, travel, readout = rng.normal(0.0, 0.3, 3), rng.normal(0.0, 0.3, 3), 0.02
    start, views, times = so3.exp(rng.normal(size=3)), [], (-0.03, 0.0, 0.05)
    for time in times:
        fine = np.linspace(0.0, time, 2001)
        path = np.array([so3.exp(turn * t) @ travel for t in fine])
        motion = readout * np.concatenate([turn, travel])
        way = np.mean(0.5 * (path[1:] + path[:-1]), axis=0) * time
        views.append(View(start @ so3.exp(turn * time), start @ way, motion, covariance(rng, 12)))
    of = Equations(*np.zeros((2, 1, SIDE)), *np.zeros((3, 1, SIDE, SIDE)))
    equation(*views, times[1] - times[0], times[2] - times[1], of, 0)
    np.testing.assert_allclose(of.y[0], readout * of.x[0], atol=1e-6)
    spans = np.array([-1.0, 0.0, 1.0]) / (times[2] - times[0])
    ratio = (times[2] - times[1]) / (times[1] - times[0])
    simpson = np.array([2.0 - ratio, 2.0 + ratio + 1.0 / ratio, 2.0 - 1.0 / ratio]) / 6.0
    expected = np.zeros((12, 12))
    for view, span, share in zip(views, spans, simpson, strict=True):
        turned = np.kron(np.eye(4), views[1].rotation.T @ view.rotation)
        turned[:3, :3] = turned[6:9, 6:9] = np.eye(3)
        lift = np.kron(np.diag([span, share]), np.eye(SIDE)) @ turned
        expected += lift @ view.covariance @ lift.T
    found = np.block([[of.xx[0], of.yx[0].T], [of.yx[0], of.yy[0]]])
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("direction", ["top_to_bottom", "right_to_left"])
def test_an_image_alone_finds_its_motion_and_says_how_well(direction):
    """Many noisy images of one motion: the steps scatter as their covariance says."""
    rng = np.random.default_rng(2)
    camera = Camera(
        projector.WIDTH, projector.HEIGHT, projector.K, projector.D, scan_direction=direction
    )
    true = Motion(so3.exp(0.1 * rng.normal(size=3)), rng.normal(0.0, 0.1, 3),
                  rng.normal(0.0, 0.05, 3), rng.normal(0.0, 0.02, 3))  # fmt: skip
    points = np.column_stack([rng.uniform(-1.0, 1.0, (80, 2)), rng.uniform(2.0, 4.0, 80)])
    exact, _ = project_rolling(camera, true.at_rows, points)
    shown = camera.inside(exact)
    points, exact = points[shown], exact[shown]
    distances = []
    for _ in range(60):
        noisy = exact + rng.normal(0.0, 0.3, exact.shape)
        step, spread = single_image_likelihood(camera, true, points, noisy)
        distances.append(step @ np.linalg.solve(spread, step))
    # Chi-squared of 12 degrees of freedom, but that the noise is an estimate.
    assert np.mean(distances) == pytest.approx(12.0, rel=0.2)
    step, _ = single_image_likelihood(camera, true, points, exact)
    assert np.abs(step).max() < 1e-9
    assert single_image_likelihood(camera, true, points[:12], exact[:12]) is None
