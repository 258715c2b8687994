# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The solvers once more in plain NumPy: one sample, full systems, no elimination by hand.

The equations are written as the camera model says and their coefficients found by setting one
unknown after the other to one, so nothing of the package's algebra is repeated.
"""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation


def skew(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def nearest(matrix):
    u, _, vt = np.linalg.svd(matrix)
    return u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt


def cross_rows(rays, camera_points):
    """The first two rows of ``[x]x p`` for x = (a, b, 1)."""
    return np.concatenate(
        [(skew([a, b, 1.0]) @ p)[:2] for (a, b), p in zip(rays, camera_points, strict=True)]
    )


def linear_least_squares(function, size):
    """The x that minimizes |function(x)| for an affine function."""
    constant = function(np.zeros(size))
    columns = np.stack([function(e) - constant for e in np.eye(size)], axis=1)
    return np.linalg.lstsq(columns, -constant, rcond=None)[0]


def camera_points(points, tau, v, c, w, t, frozen=None):
    """Double-linearised model; ``frozen`` takes the place of v in the product with w."""
    hat = skew(v) if frozen is None else skew(frozen)
    return [
        x + skew(v) @ x + r * skew(w) @ (x + hat @ x) + c + r * t
        for x, r in zip(points, tau, strict=True)
    ]


def vcwt(points, rays, tau, rotation, iterations, as_published):
    points = points @ rotation.T
    v = np.zeros(3)
    for _ in range(iterations):
        frozen = v if as_published else np.zeros(3)

        def residual(x, frozen=frozen, points=points):
            v, c, w, t = x.reshape(4, 3)
            return cross_rows(rays, camera_points(points, tau, v, c, w, t, frozen))

        v, c, w, t = linear_least_squares(residual, 12).reshape(4, 3)
        if not as_published:
            turn = nearest(np.eye(3) + skew(v))
            points, rotation = points @ turn.T, turn @ rotation
    if as_published:
        rotation = nearest(np.eye(3) + skew(v)) @ rotation
    return rotation, c, w, t


def two_step(points, rays, tau, rotation, iterations, first, second):
    """``first`` and ``second``: which of v, c, w, t each step solves for."""
    points = points @ rotation.T
    now = {name: np.zeros(3) for name in "vcwt"}
    for _ in range(iterations):
        for names in (first, second):

            def residual(x, names=names, now=now):
                values = now | dict(zip(names, x.reshape(-1, 3), strict=True))
                return cross_rows(rays, camera_points(points, tau, **values))

            solution = linear_least_squares(residual, 3 * len(names))
            now |= dict(zip(names, solution.reshape(-1, 3), strict=True))
    return nearest(np.eye(3) + skew(now["v"])) @ rotation, now["c"], now["w"], now["t"]


def r9p(points, rays, tau, rotation, iterations, as_published):
    points = points @ rotation.T

    def unpack(x):
        matrix = np.append(x[9:], 0.0 if len(x) == 17 else []).reshape(3, 3)
        if len(x) == 17:
            matrix[2, 2] = -matrix[0, 0] - matrix[1, 1]
        return *x[:9].reshape(3, 3), matrix

    def residual(x):
        v, c, t, matrix = unpack(x)
        return cross_rows(
            rays,
            [
                p + skew(v) @ p + r * matrix @ p + c + r * t
                for p, r in zip(points, tau, strict=True)
            ],
        )

    v, c, t, matrix = unpack(linear_least_squares(residual, 18 if as_published else 17))
    rate = matrix @ np.linalg.inv(np.eye(3) + skew(v))
    skew_part = 0.5 * (rate - rate.T)
    w = np.array([skew_part[2, 1], skew_part[0, 2], skew_part[1, 0]])
    return nearest(np.eye(3) + skew(v)) @ rotation, c, w, t


def oracle(name, points, rays, tau, rotation, iterations, as_published=False):
    """R, C, w, t of one sample."""
    steps = {"r6p_vc_wt": ("vc", "wt"), "r6p_vct_w": ("vct", "w"), "r6p_vct_wt": ("vct", "wt")}
    if name in steps:
        return two_step(points, rays, tau, rotation, iterations, *steps[name])
    solve = {"r6p_vcwt": vcwt, "r9p": r9p}[name]
    return solve(points, rays, tau, rotation, iterations, as_published)


def problem(count, size, turn=0.0, travel=0.0, start_error=0.0, noise=0.0, seed=0):
    """Samples of points in [-1, 1]^3 seen from 2 to 3 away by a camera that turns (model A)."""
    rng = np.random.default_rng(seed)

    def directions(length):
        d = rng.normal(size=(count, 3))
        return length * d / np.linalg.norm(d, axis=1, keepdims=True)

    rotation = Rotation.random(count, random_state=seed).as_matrix()
    c = np.column_stack([rng.uniform(-0.2, 0.2, (count, 2)), rng.uniform(2, 3, count)])
    w, t = directions(turn), directions(travel)
    points = rng.uniform(-1, 1, (count, size, 3))
    tau = rng.uniform(-0.5, 0.5, (count, size))
    start = Rotation.from_rotvec(directions(start_error)).as_matrix() @ rotation
    camera = np.empty((count, size, 3))
    for i in range(count):
        turns = Rotation.from_rotvec(tau[i, :, None] * w[i]).as_matrix()
        camera[i] = np.einsum("nij,nj->ni", turns @ rotation[i], points[i]) + c[i]
        camera[i] += tau[i, :, None] * t[i]
    rays = camera[..., :2] / camera[..., 2:] + noise * rng.normal(size=(count, size, 2))
    return SimpleNamespace(
        points=points, rays=rays, tau=tau, rotation=rotation, c=c, w=w, t=t, start=start
    )


@pytest.fixture
def minimal():
    return SimpleNamespace(problem=problem, oracle=oracle)
