# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The solvers once more in plain NumPy: one sample, full systems, no elimination by hand.

The equations are written as the camera model says and their coefficients found by setting one
unknown after the other to one, so nothing of the package's algebra is repeated.
"""

from types import SimpleNamespace

import numpy as np
from scipy.spatial.transform import Rotation

# Which of v, c, w, t each step solves for.
STEPS = {"r6p_vcwt": ("vcwt",), "r6p_vc_wt": ("vc", "wt"), "r6p_vct_w": ("vct", "w"),
         "r6p_vct_wt": ("vct", "wt")}  # fmt: skip


def turned_by(v):
    """The rotation nearest to I + [v]x."""
    u, _, vt = np.linalg.svd(np.eye(3) - np.cross(v, np.eye(3)))
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


def misses(rays, seen):
    """Two rows of ``[x]x p`` for each ray (...,n,2) and point (...,n,3) in camera axes."""
    return (seen[..., :2] - rays * seen[..., 2:]).reshape(*rays.shape[:-2], -1)


def seen_by(points, tau, v, c, w, t, held=None):
    """Points (...,n,3) of the double-linearised model; ``held`` is v in the product with w."""
    v, c, w, t = (each[..., None, :] for each in (v, c, w, t))
    turned, r = points + np.cross(v, points), tau[..., None]
    before = turned if held is None else points + np.cross(held, points)
    return turned + r * np.cross(w, before) + c + r * t


def least_squares(function, size):
    """The x that minimizes |function(x)| for an affine function."""
    constant = function(np.zeros(size))
    columns = np.stack([function(e) - constant for e in np.eye(size)], axis=1)
    return np.linalg.lstsq(columns, -constant, rcond=None)[0]


def r6p(points, rays, tau, rotation, iterations, steps, as_published):
    points, now = points @ rotation.T, dict.fromkeys("vcwt", np.zeros(3))
    for _ in range(iterations):
        for names in steps:
            held = now["v"] if names == "vcwt" else None

            def missed(x, names=names, now=now, held=held, points=points):
                values = now | dict(zip(names, x.reshape(-1, 3), strict=True))
                return misses(rays, seen_by(points, tau, **values, held=held))

            solution = least_squares(missed, 3 * len(names)).reshape(-1, 3)
            now = now | dict(zip(names, solution, strict=True))
        if steps == ("vcwt",) and not as_published:
            turn = turned_by(now["v"])
            points, rotation, now = points @ turn.T, turn @ rotation, now | {"v": np.zeros(3)}
    return turned_by(now["v"]) @ rotation, now["c"], now["w"], now["t"]


def r9p(points, rays, tau, rotation, as_published):
    """A matrix takes the place of w; it has no trace but as published."""
    points, r = points @ rotation.T, tau[:, None]

    def unpack(x):
        matrix = np.append(x[9:], 0.0 if len(x) == 17 else []).reshape(3, 3)
        if len(x) == 17:
            matrix[2, 2] = -matrix[0, 0] - matrix[1, 1]
        return *x[:9].reshape(3, 3), matrix

    def missed(x):
        v, c, t, matrix = unpack(x)
        return misses(rays, points + np.cross(v, points) + r * points @ matrix.T + c + r * t)

    v, c, t, matrix = unpack(least_squares(missed, 18 if as_published else 17))
    rate = matrix @ np.linalg.inv(np.eye(3) - np.cross(v, np.eye(3)))
    w = 0.5 * np.array([rate[2, 1] - rate[1, 2], rate[0, 2] - rate[2, 0], rate[1, 0] - rate[0, 1]])
    return turned_by(v) @ rotation, c, w, t


def oracle(name, points, rays, tau, rotation, iterations, as_published=False):
    """R, C, w, t of one sample."""
    if name == "r9p":
        return r9p(points, rays, tau, rotation, as_published)
    return r6p(points, rays, tau, rotation, iterations, STEPS[name], as_published)


def directions(rng, lengths):
    """Vectors (n,3) anywhere, of lengths (n,)."""
    vectors = rng.normal(size=(len(lengths), 3))
    return vectors * (lengths / np.linalg.norm(vectors, axis=1))[:, None]


def problem(count, size, turn=0.0, travel=0.0, start_error=0.0, noise=0.0, seed=0):
    """Samples of points in [-1, 1]^3 seen from 2 to 3 away by a camera that turns (model A)."""
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(count, random_state=seed).as_matrix()
    c = np.column_stack([rng.uniform(-0.2, 0.2, (count, 2)), rng.uniform(2, 3, count)])
    w, t = (directions(rng, np.full(count, length)) for length in (turn, travel))
    points = rng.uniform(-1, 1, (count, size, 3))
    tau = rng.uniform(-0.5, 0.5, (count, size))
    off = directions(rng, np.full(count, start_error))
    turns = Rotation.from_rotvec((tau[..., None] * w[:, None]).reshape(-1, 3)).as_matrix()
    turns = turns.reshape(count, size, 3, 3) @ rotation[:, None]
    camera = np.einsum("hnij,hnj->hni", turns, points) + c[:, None] + tau[..., None] * t[:, None]
    rays = camera[..., :2] / camera[..., 2:] + noise * rng.normal(size=(count, size, 2))
    start = Rotation.from_rotvec(off).as_matrix() @ rotation
    return SimpleNamespace(
        points=points, rays=rays, tau=tau, rotation=rotation, c=c, w=w, t=t, start=start
    )
