# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Minimal solvers for thousands of samples at once: the paper's problem as a call."""

import os
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.core.arrays import Array, real
from rs_localizer.solvers.batch import MODEL_SIZE, unpack
from rs_localizer.solvers.table import SOLVERS, find_solver


def solve_minimal(
    name: str,
    points: ArrayLike,
    rays: ArrayLike,
    tau: ArrayLike,
    rotation: ArrayLike | None = None,
    iterations: int = 5,
    as_published: bool = False,
    threads: int = 1,
    bound: float | None = None,
) -> tuple[Array, Array, Array, Array]:
    """Solve many minimal samples at once.

    Args:
        name: of the solver, see :data:`rs_localizer.solvers.table.SOLVERS`.
        points: (h,n,3) world points, n the solver's sample size.
        rays: (h,n,2) undistorted bearings ``x/z, y/z``.
        tau: (h,n) row times, see :mod:`rs_localizer.core.shutter`.
        rotation: initial rotation camera_from_map, (3,3) or (h,3,3); identity by default. The
            rolling-shutter solvers need it to tens of degrees; ``p3p`` ignores it.
        iterations: of the iterative solvers, at most: each sample stops where it converges.
        as_published: r6p_vcwt with v^ frozen and r9p with its gauge free, as in the paper;
            otherwise relinearised, and with ``trace(R_RS) = 0``.
        threads: how many parts of a large batch run side by side; 0 = one per core.
        bound: of ``r6p`` alone: solutions have a ``|v|``, the tangent of the angle to the initial
            rotation, below this (1 by default, 45 degrees).

    Returns:
        rotations (h,k,3,3), translations (h,k,3), w (h,k,3) and t (h,k,3) of model A,
        ``lambda x = exp(tau [w]x) R X + C + tau t``, per unit of ``tau``; NaN where a sample has
        fewer than k solutions. For ``p3p``, w and t are zero.

    Raises:
        ValueError: unknown solver, wrong shapes, fewer than one iteration, threads below 0, or a
            bound that is none, or of another solver than ``r6p``.
    """
    solver, row = find_solver(name), SOLVERS[name]
    points = np.ascontiguousarray(points, dtype=np.float64)
    rays = np.ascontiguousarray(rays, dtype=np.float64)
    tau = np.ascontiguousarray(tau, dtype=np.float64)
    n = solver.sample_size
    h = len(points)
    if points.shape != (h, n, 3) or rays.shape != (h, n, 2) or tau.shape != (h, n):
        raise ValueError(
            f"{name} takes points (h,{n},3), rays (h,{n},2) and tau (h,{n}); "
            f"got {points.shape}, {rays.shape} and {tau.shape}"
        )
    initial = np.eye(3) if rotation is None else np.ascontiguousarray(rotation, dtype=np.float64)
    if initial.shape not in ((3, 3), (h, 3, 3)):
        raise ValueError(f"rotation must be (3,3) or ({h},3,3), got {initial.shape}")
    real("iterations", iterations, "1 or more", 1)
    real("threads", threads, "0 (all cores) or more", 0)
    if bound is not None and not (row.bounded and bound > 0.0):
        raise ValueError(f"bound is that of r6p, above 0, got {bound} for {name}")
    samples = np.arange(h * n, dtype=np.int64).reshape(h, n)
    solve = solver.solve_as_published if as_published else solver.solve
    if bound is not None:
        solve = partial(solve, bound=bound)
    initial = initial.reshape(-1, 3, 3)
    k = solver.solutions
    rotations, translations = np.empty((h, k, 3, 3)), np.empty((h, k, 3))
    w, t = np.empty((h, k, 3)), np.empty((h, k, 3))

    def solve_part(first: int, end: int) -> None:
        models = np.empty((k, MODEL_SIZE, end - first))
        solve(
            points.reshape(-1, 3),
            rays.reshape(-1, 2),
            tau.ravel(),
            samples[first:end],
            initial[first:end] if len(initial) > 1 else initial,
            iterations,
            models,
        )
        unpack(models, first, rotations, translations, w, t)

    bounds = range(0, h, -(-h // (threads or os.cpu_count() or 1)) or 1)
    if len(bounds) <= 1:
        if h > 0:
            solve_part(0, h)
    else:  # kernels release the interpreter's lock
        with ThreadPoolExecutor(len(bounds)) as pool:
            ends = [*bounds[1:], h]
            list(pool.map(solve_part, bounds, ends))
    return rotations, translations, w, t
