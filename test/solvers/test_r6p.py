# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""R6P against an oracle in NumPy that shares neither algebra nor numerics with it.

The oracle evaluates the fifteen minors by ``np.linalg.det`` at points and fits the quartics to
the values, multiplies by a random combination of v's components, takes eigenvectors of the dense
matrix, and polishes in all twelve unknowns of the camera model itself.
"""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.solvers import r6p
from rs_localizer.solvers.minimal import solve_minimal

BOUND = 1.0
MONOMIALS = sorted(
    (m for m in itertools.product(range(5), repeat=3) if sum(m) <= 4), key=lambda m: (sum(m), m)
)
MINORS = list(itertools.combinations(range(6), 4))


def residuals(p, v, c, w, t):
    """The model of the solver: two rows of ``[x]x`` times the camera points, (h,12)."""
    turned = p.points + np.cross(v[:, None], p.points)
    r = p.tau[..., None]
    seen = turned + r * np.cross(w[:, None], turned) + c[:, None] + r * t[:, None]
    return (seen[..., :2] - p.rays * seen[..., 2:]).reshape(len(v), 12)


def by_coordinate(p, unknowns):
    """Exact Jacobian (h,12,n) of residuals that are affine in every single coordinate."""
    at = residuals(p, *np.moveaxis(unknowns.reshape(-1, 4, 3), 1, 0))
    columns = [
        residuals(p, *np.moveaxis((unknowns + e).reshape(-1, 4, 3), 1, 0)) - at for e in np.eye(12)
    ]
    return at, np.stack(columns, axis=-1)


def matrices(p, v):
    """A(v) (h,6,4) for one v: the equations that no C and t can change, by columns w and 1."""
    h = len(p.points)
    v = np.broadcast_to(v, (h, 3))

    def bracket(w, c, t):
        return residuals(p, v, *(np.broadcast_to(x, (h, 3)) for x in (c, w, t)))

    zero, axes = np.zeros(3), np.eye(3)
    constant = bracket(zero, zero, zero)
    lateral = [bracket(zero, e, zero) - constant for e in axes]
    lateral += [bracket(zero, zero, e) - constant for e in axes]
    free = np.linalg.qr(np.stack(lateral, axis=-1), mode="complete")[0][..., 6:]
    columns = [bracket(e, zero, zero) - constant for e in axes] + [constant]
    return free.swapaxes(1, 2) @ np.stack(columns, axis=-1)


def oracle(p, rng):
    """Real solutions with |v| < BOUND: samples (m,), v (m,3)."""
    h = len(p.points)
    nodes = rng.uniform(-1, 1, (70, 3))
    a = np.stack([matrices(p, v) for v in nodes], axis=1)
    a /= np.sqrt((a**2).sum(axis=(1, 2, 3), keepdims=True))
    values = np.stack([np.linalg.det(a[:, :, rows]) for rows in MINORS], axis=-1)
    monomials = np.prod(nodes[:, None] ** np.array(MONOMIALS), axis=-1)
    quartics = (np.linalg.pinv(monomials) @ values).swapaxes(1, 2)  # (h,15,35)
    reduction = -np.linalg.solve(quartics[..., 20:], quartics[..., :20])
    multiplication = np.zeros((h, 20, 20))
    for weight, axis in zip(rng.normal(size=3), np.eye(3, dtype=int), strict=True):
        for i, m in enumerate(MONOMIALS[:20]):
            j = MONOMIALS.index(tuple(np.add(m, axis)))
            multiplication[:, i] += weight * (np.eye(20)[j] if j < 20 else reduction[:, j - 20])
    values, vectors = np.linalg.eig(multiplication)
    sample, number = np.nonzero(np.abs(values.imag) < 1e-6)
    vector = vectors[sample, :, number].real
    v = vector[:, [MONOMIALS.index(tuple(e)) for e in np.eye(3, dtype=int)]] / vector[:, :1]
    near = np.linalg.norm(v, axis=1) < 1.1 * BOUND
    sample, v = sample[near], v[near]
    one = SimpleNamespace(points=p.points[sample], rays=p.rays[sample], tau=p.tau[sample])
    unknowns = np.concatenate([v, np.zeros((len(v), 9))], axis=1)
    rest = by_coordinate(one, unknowns)  # at fixed v the model is linear in C, w and t
    start = -np.linalg.pinv(rest[1][..., 3:]) @ rest[0][..., None]
    unknowns[:, 3:] = start[..., 0]
    for _ in range(5):
        value, jacobian = by_coordinate(one, unknowns)
        step = (np.linalg.pinv(jacobian) @ value[..., None])[..., 0]
        unknowns = unknowns - step
    found, shift = unknowns[:, :3], np.linalg.norm(unknowns[:, :3] - v, axis=1)
    good = np.abs(residuals(one, *np.moveaxis(unknowns.reshape(-1, 4, 3), 1, 0))).max(1) < 1e-9
    good &= (np.linalg.norm(step, axis=1) < 1e-6 * np.linalg.norm(unknowns, axis=1)) & (shift < 0.1)
    good &= np.linalg.norm(found, axis=1) < BOUND
    return sample[good], found[good]


def directions(rng, length):
    vector = rng.normal(size=(len(length), 3))
    return vector * (length / np.linalg.norm(vector, axis=1))[:, None]


def problems(h, seed, *, physical, rotation=30.0, translation=0.3, error=6.0, noise=0.0):
    """The paper's set-up (theory.md, sec. 6), row times those of the image rows.

    Points in [-1, 1]^3, distance 2 to 3, 45 degrees of view, motions up to ``rotation`` degrees
    and ``translation``, an initial rotation that is up to ``error`` degrees off; ``physical``
    has exact rotations, otherwise the double-linearised model is the truth.
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
        r = tau[..., None]
        if physical:
            placed = points @ Rotation.from_rotvec(v).as_matrix().swapaxes(1, 2)
            turns = Rotation.from_rotvec((r * w[:, None]).reshape(-1, 3))
            placed = turns.apply(placed.reshape(-1, 3)).reshape(h, 6, 3)
        else:
            placed = points + np.cross(v[:, None], points)
            placed = placed + r * np.cross(w[:, None], placed)
        seen = placed + c[:, None] + r * t[:, None]
        rays = seen[..., :2] / seen[..., 2:]
        previous, tau = tau, scale * rays[..., 1]
    settled = np.abs(tau - previous).max(axis=1) < 1e-13
    assert settled.mean() > 0.98
    rays = rays + noise / scale / 1000 * rng.normal(size=rays.shape)
    problem = SimpleNamespace(
        points=points, rays=rays, tau=scale * rays[..., 1] if noise else tau,
        start=start, v=v, c=c, w=w, t=t,
    )  # fmt: skip
    return SimpleNamespace(**{name: x[settled] for name, x in vars(problem).items()})


def solutions(p, limit=1e-9):
    """Samples (m,) and v (m,3), before I + [v]x is replaced by the nearest rotation."""
    found = r6p.find_solutions(p.points, p.rays, p.tau, BOUND)
    of = found.sample
    one = SimpleNamespace(points=p.points[of], rays=p.rays[of], tau=p.tau[of])
    assert np.abs(residuals(one, found.v, found.c, found.w, found.t)).max() < limit
    return of, found.v


def distances(sample, v, others, other_v):
    """How far each v is from the nearest of the other v of the same sample."""
    order = np.argsort(others, kind="stable")
    others, other_v = others[order], other_v[order]
    begin, end = np.searchsorted(others, sample), np.searchsorted(others, sample, "right")
    return np.array(
        [
            np.linalg.norm(other_v[i:j] - x, axis=1).min(initial=np.inf)
            for i, j, x in zip(begin, end, v, strict=True)
        ]
    )


FAMILIES = {
    "paper": {"physical": True},
    "noisy": {"physical": True, "noise": 1.0},
    "model": {"physical": False},
    "slow": {"physical": True, "rotation": 3.0, "translation": 0.03, "noise": 1.0},
    "far": {"physical": False, "error": 30.0},
    "still": {"physical": True, "rotation": 0.0, "translation": 0.0, "error": 0.0},
    "random": None,
}


@pytest.mark.parametrize("family", FAMILIES)
def test_all_real_solutions_are_found_and_nothing_else(family):
    if FAMILIES[family] is None:  # bearings that fit no motion at all
        rng = np.random.default_rng(6)
        p = SimpleNamespace(
            points=rng.uniform(-1, 1, (1000, 6, 3)),
            rays=rng.uniform(-0.5, 0.5, (1000, 6, 2)),
            tau=rng.uniform(-0.5, 0.5, (1000, 6)),
        )
    else:
        p = problems(1000, 7, **FAMILIES[family])
    expected = oracle(p, np.random.default_rng(8))
    found = solutions(p)
    assert len(expected[0]) > 0.05 * len(p.points)
    assert (np.linalg.norm(found[1], axis=1) < BOUND).all()
    assert np.mean(distances(*expected, *found) < 1e-6) >= 0.999
    assert np.mean(distances(*found, *expected) < 1e-6) >= 0.999
    # Each of them once.
    assert abs(len(found[0]) - len(expected[0])) <= 0.001 * len(expected[0])


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
