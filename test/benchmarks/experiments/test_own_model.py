"""R9P by its own model, against a camera of the test's own that sees points through any matrix."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.experiments import methods as m
from benchmarks.experiments.own_model import FreeMotion, solve_all
from benchmarks.experiments.plain_ransac import PlainRansac, observe
from rs_localizer.core.camera import Camera

FOCAL, SIZE = 900.0, (1920, 1080)
CENTRE = 0.5 * (np.array(SIZE) - 1.0)
CAMERA = Camera(*SIZE, np.array([[FOCAL, 0, CENTRE[0]], [0, FOCAL, CENTRE[1]], [0, 0, 1.0]]))
START = Rotation.from_rotvec([0.3, -0.5, 1.1]).as_matrix()


def scene(seed: int, count: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """A model (3,8) with a sheared, shrinking R_RS of trace 0, and centred points before it."""
    rng = np.random.default_rng(seed)
    shear = 0.2 * rng.normal(size=(3, 3))
    shear -= np.trace(shear) / 3.0 * np.eye(3)
    x, y, z = 0.05 * rng.normal(size=3)
    near = np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    model = np.column_stack(
        [near @ START, [0.1, -0.1, 3.0], shear @ START, 0.2 * rng.normal(size=3)]
    )
    points = rng.uniform(-1.0, 1.0, (count, 3)) @ START
    return model, points - points.mean(axis=0)


def seen(model: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Pixels (n,2), each at the row that sees it there."""
    r = np.zeros(len(points))
    for _ in range(200):
        x = points @ (model[:, :3]).T + model[:, 3]
        x = x + r[:, None] * (points @ model[:, 4:7].T + model[:, 7])
        pixels = FOCAL * x[:, :2] / x[:, 2:] + CENTRE
        r = pixels[:, 1] / (SIZE[1] - 1.0) - 0.5
    return pixels


@pytest.mark.parametrize("seed", range(4))
def test_errors_are_distances_in_the_image(seed: int) -> None:
    model, points = scene(seed)
    pixels = seen(model, points)
    off = np.random.default_rng(seed).normal(size=pixels.shape)
    for size in (0.0, 1.0):
        observations = observe(CAMERA, points, pixels + size * off)
        by_ray = CAMERA.pixel_jacobian(observations.rays)
        errors = np.sqrt(FreeMotion(model).squared_errors(observations, by_ray))
        expected = size * np.linalg.norm(off, axis=1)
        np.testing.assert_allclose(errors, expected, rtol=2e-3, atol=1e-9)


def test_rows_are_those_of_the_equation() -> None:
    model, points = scene(1)
    tau = np.linspace(-0.5, 0.5, len(points))
    matrices, translations = FreeMotion(model).at_rows(tau)
    for x, r, matrix, translation in zip(points, tau, matrices, translations, strict=True):
        expected = model @ np.concatenate([x, [1.0], r * x, [r]])
        np.testing.assert_allclose(matrix @ x + translation, expected, atol=1e-12)


def test_what_lies_behind_the_camera_is_no_inlier() -> None:
    model, points = scene(2)
    observations = observe(CAMERA, points, seen(model, points))
    by_ray = CAMERA.pixel_jacobian(observations.rays)
    assert np.isinf(FreeMotion(-model).squared_errors(observations, by_ray)).all()


@pytest.mark.parametrize("as_published", [True, False])
def test_nine_points_give_their_model(as_published: bool) -> None:
    model, points = scene(3)
    observations = observe(CAMERA, points, seen(model, points))
    samples = np.random.default_rng(0).permuted(np.tile(np.arange(60), (5, 1)), axis=1)[:, :9]
    models = solve_all(observations, np.ascontiguousarray(samples), START, as_published)
    # Up to the scale that the rows leave where nothing moves, and here something does.
    np.testing.assert_allclose(models, np.broadcast_to(model, (5, 3, 8)), atol=1e-6)


@pytest.mark.parametrize("method", [m.R9P, m.R9P_OURS], ids=lambda method: method.name)
def test_ransac_counts_what_no_motion_could_explain(method: m.Method) -> None:
    model, points = scene(4)
    rng = np.random.default_rng(4)
    pixels = seen(model, points) + 0.1 * rng.normal(size=(60, 2))
    pixels[:12] = rng.uniform(0.0, 1000.0, (12, 2))
    search = PlainRansac.of(CAMERA, points, pixels, 300, 4.0, seed=0)
    best = search.best(method, START)
    assert 45 <= best.inliers <= 50
    assert search.best(m.VCWT, START).inliers < 30
    assert best.poses_at is not None
    tau = pixels[12:, 1] / (SIZE[1] - 1.0) - 0.5
    matrices, translations = best.poses_at(tau)
    x = np.einsum("nij,nj->ni", matrices, points[12:] - points.mean(axis=0)) + translations
    off = FOCAL * x[:, :2] / x[:, 2:] + CENTRE - pixels[12:]
    assert np.median(np.abs(off)) < 1.0


def test_too_few_points_give_nothing() -> None:
    model, points = scene(5, count=8)
    best = PlainRansac.of(CAMERA, points, seen(model, points), 10, 4.0, seed=0).best(m.R9P, START)
    assert (best.poses_at, best.inliers) == (None, 0)
