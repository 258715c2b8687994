# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Solvers against plain NumPy, planted motions and their authors' solutions."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.solvers import r6p
from rs_localizer.solvers.minimal import solve_minimal
from rs_localizer.solvers.table import SOLVERS, find_solver

from .equations import directions, misses, oracle, problem, seen_by

ROLLING = [name for name, row in SOLVERS.items() if row.rolling_shutter]
LINEAR = [name for name in ROLLING if find_solver(name).solutions == 1]
VARIANTS = [
    (name, as_published)
    for name in LINEAR
    for as_published in ((False, True) if SOLVERS[name].as_published else (False,))
]


def solve(name, p, **options):
    return solve_minimal(name, p.points, p.rays, p.tau, p.start, **options)


@pytest.mark.parametrize("iterations", [1, 4])
@pytest.mark.parametrize(("name", "as_published"), VARIANTS)
def test_every_linear_solver_is_its_numpy_oracle(name, as_published, iterations):
    # Thirteen samples: one full block of lanes and a part of another.
    p = problem(13, find_solver(name).sample_size, 0.1, 0.1, 0.1, noise=1e-3, seed=1)
    found = solve(name, p, iterations=iterations, as_published=as_published)
    for i in range(13):
        sample = p.points[i], p.rays[i], p.tau[i], p.start[i]
        expected = oracle(name, *sample, iterations, as_published)
        for ours, theirs in zip(found, expected, strict=True):
            np.testing.assert_allclose(ours[i, 0], theirs, rtol=1e-6, atol=1e-8)


def test_p3p_finds_the_true_pose_and_only_poses_that_fit():
    p = problem(20_000, 3, seed=7)
    rotation, c, w, t = solve("p3p", p)
    exists = np.isfinite(c).all(axis=2)
    assert (exists == np.isfinite(rotation).all(axis=(2, 3))).all()
    error = np.nanmin(
        np.where(exists, np.abs(rotation - p.rotation[:, None]).max(axis=(2, 3)), np.inf)
        + np.where(exists, np.abs(c - p.c[:, None]).max(axis=2), np.inf),
        axis=1,
    )
    assert np.mean(error < 1e-6) > 0.9995
    seen = np.einsum("hkij,hnj->hkni", rotation, p.points) + c[:, :, None]
    residual = np.abs(seen[..., :2] / seen[..., 2:] - p.rays[:, None]).max(axis=(2, 3))[exists]
    assert np.mean(residual < 1e-9) > 0.9995
    assert (seen[exists][..., 2] > 0).all()
    np.testing.assert_allclose(
        rotation[exists] @ rotation[exists].swapaxes(1, 2),
        np.broadcast_to(np.eye(3), (exists.sum(), 3, 3)), atol=1e-6,
    )  # fmt: skip
    assert (w[exists] == 0).all()
    assert (t[exists] == 0).all()


def test_p3p_finds_the_solutions_that_opencv_finds():
    p = problem(300, 3, seed=8)
    rotation, *_ = solve("p3p", p)
    missing = total = 0
    for points, rays, found in zip(p.points, p.rays, rotation, strict=True):
        _, turns, shifts = cv2.solveP3P(points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_P3P)
        for turn, shift in zip(turns, shifts, strict=True):
            matrix = cv2.Rodrigues(turn)[0]
            seen = points @ matrix.T + shift.T
            off = np.abs(seen[:, :2] / seen[:, 2:] - rays).max()
            if (seen[:, 2] > 0).all() and off < 1e-6:  # others are no solutions at all
                total += 1
                missing += not np.nanmin(np.abs(found - matrix).max(axis=(1, 2))) < 1e-3
    assert total > 500
    assert missing <= 0.005 * total


@pytest.mark.parametrize("name", list(SOLVERS))
def test_turning_the_world_turns_only_the_rotation(name):
    p = problem(9, find_solver(name).sample_size, 0.05, 0.05, 0.05, seed=11)
    turn = Rotation.random(random_state=12).as_matrix()
    rotation, c, w, t = solve(name, p)
    p.points, p.start = p.points @ turn.T, p.start @ turn.T
    for ours, expected in zip(solve(name, p), (rotation @ turn.T, c, w, t), strict=True):
        np.testing.assert_allclose(ours, expected, atol=1e-6)


def degenerate_samples(size, count, seed):
    """Random and adversarial samples: what a robust loop may draw by bad luck."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (count, size, 3))
    points[..., 2] += 2.5
    rays = rng.uniform(-0.5, 0.5, (count, size, 2))
    tau = rng.uniform(-0.5, 0.5, (count, size))
    kind = rng.integers(0, 16, count)
    fits = kind < 6  # rays that belong to the points
    rays[fits] = (points[..., :2] / points[..., 2:])[fits]
    points[kind == 1, :, 2] = 2.0  # coplanar
    points[kind == 2] = points[kind == 2][:, :1] + rng.uniform(size=(1, size, 1)) * [1, 2, 3]
    tau[kind == 3] = 0.25  # equal rows
    points[kind == 4, 1] = points[kind == 4, 0]
    rays[kind == 4, 1] = rays[kind == 4, 0]
    points[kind == 5, ..., 2] *= -1.0  # behind the camera
    points[kind == 6] = 0.0
    rays[kind == 7] = 0.0
    points[kind == 8] *= 1e12
    points[kind == 9] *= 1e-12
    rays[kind == 10] *= 1e9
    points[kind == 11] = points[kind == 11][:, :1]
    points[kind == 12, 0] = np.nan
    rays[kind == 13, 1] = np.inf
    points[kind == 14] *= 1e200
    for values, digits in ((points, 0), (rays, 1), (tau, 1)):
        values[kind == 15] = values[kind == 15].round(digits)
    return points, rays, tau


def models_of(name, *samples):
    """(h,k,18)."""
    models = solve_minimal(name, *samples)
    return np.concatenate([m.reshape(*m.shape[:2], -1) for m in models], axis=2)


@pytest.mark.parametrize("name", list(SOLVERS))
def test_no_sample_breaks_a_solver_or_its_neighbours(name):
    count = 10_000 if name == "r6p" else 100_000  # in NumPy, slower
    samples = degenerate_samples(find_solver(name).sample_size, count, seed=13)
    found = 0
    for part in zip(*(np.array_split(values, 20) for values in samples), strict=True):
        models = models_of(name, *part)  # a warning is an error
        finite = np.isfinite(models)
        assert not np.isinf(models).any()
        # A solution is there or not, never half.
        assert (finite.all(axis=2) == finite.any(axis=2)).all()
        found += finite[..., 0].sum()
    assert found > 0
    # Beside other neighbours in its lanes a sample has the same solutions.
    turned = [values[::-1].copy() for values in part]
    np.testing.assert_array_equal(models_of(name, *turned)[::-1], models)


@pytest.mark.parametrize("name", ["p3p", "r6p_vcwt", "r9p"])
@pytest.mark.parametrize("one_rotation", [True, False])
def test_threads_change_nothing_but_the_time(name, one_rotation):
    p = problem(101, find_solver(name).sample_size, 0.05, 0.05, 0.05, noise=1e-3, seed=14)
    if one_rotation:
        p.start = p.start[0]
    for threads in (0, 2, 7, 200):
        for one, many in zip(solve(name, p), solve(name, p, threads=threads), strict=True):
            np.testing.assert_array_equal(one, many)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"points": np.zeros((2, 5, 3))}, r"takes points \(h,6,3\).* got \(2, 5, 3\)"),
        ({"rotation": np.eye(4)}, r"rotation must be \(3,3\) or \(2,3,3\), got \(4, 4\)"),
        ({"iterations": 0}, "iterations must be 1 or more, got 0"),
        ({"bound": 1.0}, "bound is that of r6p, above 0"),
    ],
)
def test_wrong_input_is_refused_with_what_was_found(changes, said):
    right = {"points": np.zeros((2, 6, 3)), "rays": np.zeros((2, 6, 2)), "tau": np.zeros((2, 6))}
    with pytest.raises(ValueError, match=said):
        solve_minimal("r6p_vcwt", **(right | changes))


def test_relinearising_converges_from_far_where_freezing_does_not():
    p, share = problem(500, 6, np.radians(10), 0.1, np.radians(30), seed=5), {}
    for as_published in (False, True):
        rotation = solve("r6p_vcwt", p, iterations=8, as_published=as_published)[0][:, 0]
        cosine = 0.5 * (np.einsum("hij,hij->h", rotation, p.rotation) - 1.0)
        share[as_published] = np.mean(cosine > np.cos(np.radians(2.0)))
    assert share[False] > 0.85
    assert share[True] < 0.5 * share[False]


@pytest.mark.parametrize(
    ("name", "as_published"), [variant for variant in VARIANTS if variant[0] != "r9p"]
)
def test_iterations_stop_at_convergence(name, as_published):
    p = problem(64, 6, 0.1, 0.05, 0.05, seed=3)
    every = solve(name, p, iterations=2000, as_published=as_published)
    more = solve(name, p, iterations=2500, as_published=as_published)
    still = np.array([
        all(np.array_equal(a[i], b[i]) for a, b in zip(every, more, strict=True))
        for i in range(64)
    ])  # fmt: skip
    assert still.mean() > 0.5
    chosen = {key: values[still] for key, values in vars(p).items()}
    # A million million would take months.
    alone = solve(name, SimpleNamespace(**chosen), iterations=10**12, as_published=as_published)
    for ours, before in zip(alone, every, strict=True):
        np.testing.assert_array_equal(ours, before[still])


def test_joint_gives_the_solutions_of_both():
    p = problem(20, 6, 0.1, 0.1, 0.05, noise=1e-3, seed=9)
    both = solve("joint", p)
    for k, name in enumerate(("r6p_vct_w", "r6p_vcwt")):
        for together, alone in zip(both, solve(name, p), strict=True):
            np.testing.assert_array_equal(together[:, k], alone[:, 0])


BOUND = 1.0


def problems(h, seed, *, rotation=30.0, translation=0.3, error=6.0, noise=0.0):
    """The paper's set-up (theory.md, sec. 6) with the double-linearised model as the truth.

    Points in [-1, 1]^3, distance 2 to 3, 45 degrees of view, row times those of the image rows,
    motions up to ``rotation`` degrees and ``translation``, an initial rotation that is up to
    ``error`` degrees off.
    """
    rng = np.random.default_rng(seed)
    start = Rotation.random(h, random_state=seed).as_matrix()
    points = rng.uniform(-1, 1, (h, 6, 3)) @ start.swapaxes(1, 2)
    v = directions(rng, np.radians(rng.uniform(0, error, h)))
    w = directions(rng, np.radians(rng.uniform(0, rotation, h)))
    t = directions(rng, rng.uniform(0, translation, h))
    c = np.stack([np.zeros(h), np.zeros(h), rng.uniform(2, 3, h)], axis=1)
    scale = 0.5 / np.tan(np.radians(22.5))
    tau = np.zeros((h, 6))
    for _ in range(100):  # until every point is seen by its own row
        seen = seen_by(points, tau, v, c, w, t)
        rays = seen[..., :2] / seen[..., 2:]
        previous, tau = tau, scale * rays[..., 1]
    settled = np.abs(tau - previous).max(axis=1) < 1e-13
    assert settled.mean() > 0.98
    rays = rays + noise / scale / 1000 * rng.normal(size=rays.shape)
    problem = {"points": points, "rays": rays, "tau": tau, "v": v}
    return SimpleNamespace(**{name: x[settled] for name, x in problem.items()})


def solutions(p):
    """Samples (m,) and v (m,3), before I + [v]x is replaced by the nearest rotation."""
    found = r6p.find_solutions(p.points, p.rays, p.tau, BOUND)
    of = found.sample
    seen = seen_by(p.points[of], p.tau[of], found.v, found.c, found.w, found.t)
    assert np.abs(misses(p.rays[of], seen)).max() < 1e-9
    return of, found.v


@pytest.mark.parametrize(
    "family",
    [{}, {"rotation": 3.0, "translation": 0.03}, {"error": 30.0}, {"noise": 1.0},
     {"rotation": 0.0, "translation": 0.0, "error": 0.0}, None],
    ids=["paper", "slow", "far", "noisy", "still", "random"],
)  # fmt: skip
def test_planted_solutions_are_found_and_nothing_but_solutions_each_once(family):
    if family is None:  # bearings that fit no motion at all
        rng = np.random.default_rng(6)
        p = SimpleNamespace(
            points=rng.uniform(-1, 1, (1000, 6, 3)),
            rays=rng.uniform(-0.5, 0.5, (1000, 6, 2)),
            tau=rng.uniform(-0.5, 0.5, (1000, 6)),
        )
    else:
        p = problems(1000, 7, **family)
    of, v = solutions(p)
    assert (np.linalg.norm(v, axis=1) < BOUND).all()
    same = of[:, None] == of
    np.fill_diagonal(same, val=False)
    for i, others in enumerate(same):
        assert np.linalg.norm(v[others] - v[i], axis=1).min(initial=1.0) > 1e-6
    if family is None or "noise" in family:
        assert len(of) > 0.05 * len(p.points)
        return
    planted = np.full(len(p.points), np.inf)
    np.minimum.at(planted, of, np.linalg.norm(v - p.v[of], axis=1))
    assert np.mean(planted < 1e-6) >= 0.999


@pytest.mark.parametrize(("off", "least", "error"), [(0.0, 0.95, 1e-6), (0.02, 0.75, 0.005)])
def test_a_plane_is_solved_near_the_true_orientation(off, least, error):
    """As docs/solvers.md says; the error is that of the model, the square of the angle."""
    rng, count = np.random.default_rng(0), 200
    points = rng.uniform(-1.0, 1.0, (count, 6, 3)) * [1.0, 1.0, 0.0]
    tau = rng.uniform(-0.5, 0.5, (count, 6))
    true = Rotation.from_rotvec(0.4 * rng.normal(size=(count, 3)))
    c, w, t = (rng.normal(0.0, 0.1, (count, 1, 3)) for _ in range(3))
    turned = np.einsum("hij,hnj->hni", true.as_matrix(), points)
    seen = turned + tau[..., None] * (np.cross(w, turned) + t) + c + [0.0, 0.0, 4.0]
    start = (Rotation.from_rotvec(off * np.array([1.0, 0.0, 0.0])) * true).as_matrix()
    rays = seen[..., :2] / seen[..., 2:]
    solutions(SimpleNamespace(points=points @ start.swapaxes(1, 2), rays=rays, tau=tau))
    found = solve_minimal("r6p", points, rays, tau, rotation=start)[0]
    apart = np.linalg.norm(found - true.as_matrix()[:, None], axis=(2, 3))
    solved = np.any(np.isfinite(apart), axis=1)
    assert np.mean(solved) > least
    assert np.quantile(np.nanmin(apart[solved], axis=1), 0.9) < error


ITERATIONS = (1, 2, 5)


@pytest.fixture(scope="module")
def stored():
    """16 samples at 1e-3 of noise; their row time is x."""
    return SimpleNamespace(**np.load(Path(__file__).parent / "authors.npz"))


def models(found):
    """Rotation vectors, C, w and t (n,12) of theirs: v, C, w, t."""
    length = np.linalg.norm(found[:, :3], axis=1, keepdims=True)
    turn = found[:, :3] / length * np.arctan(length)  # of the rotation nearest to I + [v]x
    return np.hstack([turn, found[:, 3:]])


def solved(name, stored, **options):
    """As :func:`models`, (h,k,12)."""
    rotations, *others = solve_minimal(
        name, stored.points, stored.rays, np.ascontiguousarray(stored.rays[..., 0]), **options
    )
    turns = np.full(others[0].shape, np.nan)
    there = np.isfinite(others[0][..., 0])
    turns[there] = Rotation.from_matrix(rotations[there]).as_rotvec()
    return np.concatenate([turns, *others], axis=2)


@pytest.mark.parametrize("k", range(len(ITERATIONS)))
def test_vcwt_as_published_is_the_authors(stored, k):
    ours = solved("r6p_vcwt", stored, iterations=ITERATIONS[k], as_published=True)[:, 0]
    np.testing.assert_allclose(ours, models(stored.iterated[:, k]), rtol=1e-8, atol=1e-9)


def test_the_first_iteration_is_also_that_of_the_relinearized_one(stored):
    ours = solved("r6p_vcwt", stored, iterations=1)[:, 0]
    np.testing.assert_allclose(ours, models(stored.iterated[:, 0]), rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("bound", [0.3, 1.0, 10.0])
def test_r6p_finds_the_authors_solutions_and_no_others(stored, bound):
    ours = solved("r6p", stored, bound=bound)
    theirs = models(stored.solutions)
    near = np.linalg.norm(stored.solutions[:, :3], axis=1) < bound
    for sample in range(len(ours)):
        expected = theirs[near & (stored.sample == sample)]
        found = ours[sample][np.isfinite(ours[sample, :, 0])]
        assert len(found) == len(expected)
        apart = np.abs(found[:, None] - expected).max(axis=2) / (1.0 + np.abs(expected).max(axis=1))
        assert (apart.min(axis=0) < 1e-6).all()
        assert (apart.min(axis=1) < 1e-6).all()
