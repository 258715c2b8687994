# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""R6P: planted motions are found, and whatever is found solves the equations.

How many solutions there are, and where, is the authors' to say (``test_authors.py``).
"""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.solvers import r6p
from rs_localizer.solvers.minimal import solve_minimal

from .equations import directions, misses, seen_by

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
