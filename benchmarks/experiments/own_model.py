# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""R9P scored by its own model, which is no rigid motion.

    lambda x = (I + [v]x) R0 X + C + r (R_RS R0 X + t)

with a free 3x3 matrix R_RS (Kukelova, Albl, Sugimoto, Pajdla, ACCV 2018, sec. 4). Taking a motion
from it leaves out what of R_RS no rotation can follow, and most of its inliers with it. A model
is kept as the matrix (3,8) that takes ``(X, 1, r X, r)`` to the camera. Errors are measured as
those of motions (:mod:`rs_localizer.estimation.residuals`): where the model puts the point on the
image, at the row that sees it there.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.simd.tracing import LANES, Lanes, Vector, traced
from rs_localizer.core.so3 import hat
from rs_localizer.estimation.observations import Observations
from rs_localizer.solvers.batch import MODEL_SIZE, Sample, gather, inputs, scatter
from rs_localizer.solvers.r9p import SAMPLE_SIZE, unknowns

# As of motions: nearer to the pace of the rows any row sees the point, and the second look is taken
# no farther away.
_LEAST_PACE = 0.1
_FARTHEST_LOOK = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class FreeMotion:
    """How points reach the camera, row by row, when nothing says that the way is a rotation."""

    model: Array  # (3,8), see the module

    def at_rows(self, tau: Array) -> tuple[Array, Array]:
        """Matrices (n,3,3) and translations (n,3) at row times (n,); no rotations."""
        rows = self.model[:, :4] + np.multiply.outer(tau, self.model[:, 4:])
        return rows[:, :, :3], rows[:, :, 3]

    def squared_errors(self, observations: Observations, by_ray: Array) -> Array:
        """Squared reprojection errors (n,) in raw pixels; infinite behind the camera.

        Args:
            by_ray: (n,2,2) derivatives of the pixels by the rays.
        """
        errors: Array = _squared_errors(
            self.model, observations.points, observations.rays, observations.tau, by_ray,
            observations.mounts.gradients[0], 2,
        )  # fmt: skip
        return errors


def solve_all(
    observations: Observations, samples: IntArray, rotation: Array, as_published: bool
) -> Array:
    """Models (h,3,8) of samples (h,9) from an initial rotation (3,3); NaN where there is none."""
    found = np.empty((MODEL_SIZE, len(samples)))
    _solve_free(
        observations.points, observations.rays, observations.tau, samples, rotation[None],
        as_published, found,
    )  # fmt: skip
    v, translation, drift = found[:9].reshape(3, 3, -1).transpose(0, 2, 1)
    matrices = (np.eye(3) + np.array([hat(x) for x in v])) @ rotation
    swept = found[9:].T.reshape(-1, 3, 3) @ rotation
    return np.concatenate([matrices, translation[..., None], swept, drift[..., None]], axis=2)


def best_free_motion(
    models: Array, observations: Observations, by_ray: Array, scale: float
) -> FreeMotion | None:
    """Of models (h,3,8) the one with the least squared error, truncated at ``scale`` px."""
    costs = _costs(
        models, observations.points, observations.rays, observations.tau, by_ray,
        observations.mounts.gradients[0], scale,
    )  # fmt: skip
    best = int(np.argmin(costs))
    return FreeMotion(models[best]) if np.isfinite(costs[best]) else None


_INPUTS = inputs(SAMPLE_SIZE)


def _unknowns_of(values: list[Lanes], *, fix_trace: bool) -> Vector:
    v, c, t, matrix = unknowns(Sample(values, SAMPLE_SIZE), fix_trace=fix_trace)
    return [*v, *c, *t, *(x for row in matrix for x in row)]


_lanes = traced(lambda values: _unknowns_of(values, fix_trace=True), _INPUTS)
_lanes_as_published = traced(lambda values: _unknowns_of(values, fix_trace=False), _INPUTS)


@kernel
def _solve_free(
    points: Array, rays: Array, tau: Array, samples: Any, rotations: Array, as_published: bool,
    models: Array,
) -> None:  # fmt: skip
    """The unknowns themselves: models (18,h) are v, C, t and R_RS, in the initial rotation's frame.

    Row-major. Arguments otherwise as in :mod:`rs_localizer.solvers.batch`.
    """
    work = np.empty(_INPUTS * LANES)
    model = np.empty(MODEL_SIZE * LANES)
    for start in range(0, len(samples), LANES):
        gather(points, rays, tau, samples, rotations, start, work)
        if as_published:
            _lanes_as_published(work, model)
        else:
            _lanes(work, model)
        scatter(model, 0, start, models)


@kernel
def _costs(
    models: Array, points: Array, rays: Array, tau: Array, by_ray: Array, gradient: Array,
    scale: float,
) -> Array:  # fmt: skip
    """Truncated squared errors (h,) of all models; infinite where there is none."""
    costs = np.empty(len(models))
    for h in range(len(models)):
        costs[h] = np.inf
        if np.isfinite(models[h]).all():
            errors = _squared_errors(models[h], points, rays, tau, by_ray, gradient, 1)
            costs[h] = np.minimum(errors, scale * scale).sum()
    return costs


@kernel
def _squared_errors(
    model: Array, points: Array, rays: Array, tau: Array, by_ray: Array, gradient: Array, looks: int
) -> Array:
    errors = np.empty(len(points))
    at, rate = np.empty(3), np.empty(3)
    for i in range(len(points)):
        for k in range(3):
            at[k], rate[k] = model[k, 3], model[k, 7]
            for j in range(3):
                at[k] += model[k, j] * points[i, j]
                rate[k] += model[k, 4 + j] * points[i, j]
        x, y, shift = 0.0, 0.0, 0.0
        for _ in range(looks):
            r = tau[i] + shift
            z = at[2] + r * rate[2]
            u, v = (at[0] + r * rate[0]) / z, (at[1] + r * rate[1]) / z
            by_row_u, by_row_v = (rate[0] - u * rate[2]) / z, (rate[1] - v * rate[2]) / z
            # Seen from here, the point was less far on at the measured row.
            off_u = u - rays[i, 0] - shift * by_row_u
            off_v = v - rays[i, 1] - shift * by_row_v
            x = by_ray[i, 0, 0] * off_u + by_ray[i, 0, 1] * off_v
            y = by_ray[i, 1, 0] * off_u + by_ray[i, 1, 1] * off_v
            by_row_x = by_ray[i, 0, 0] * by_row_u + by_ray[i, 0, 1] * by_row_v
            by_row_y = by_ray[i, 1, 0] * by_row_u + by_ray[i, 1, 1] * by_row_v
            pace = 1.0 - gradient[0] * by_row_x - gradient[1] * by_row_y
            if not (z > 0.0 and pace > _LEAST_PACE):
                x, y = np.inf, np.inf
                break
            lag = (gradient[0] * x + gradient[1] * y) / pace
            x, y = x + by_row_x * lag, y + by_row_y * lag
            shift = gradient[0] * x + gradient[1] * y
            shift = min(max(shift, -_FARTHEST_LOOK), _FARTHEST_LOOK)
        errors[i] = x * x + y * y
    return errors
