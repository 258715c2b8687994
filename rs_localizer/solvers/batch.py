# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Data of a batch of samples on its way into the lanes and out again.

A kernel keeps its samples in a flat work array of ``LANES`` doubles per value:

    points (3 n) · rays (2 n) · row times (n) · initial rotation (9) · the solver's own state

and writes solutions into ``models`` (solutions, 18, samples): rotation (9, row-major), C (3),
w (3), t (3) in model A, all of them NaN where there is no solution. All kernels have the same
signature, ``(points, rays, tau, samples, rotations, iterations, models)``, see :func:`gather`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array, Array3, Array4, IntArray, Out
from rs_localizer.core.rig import Mounts
from rs_localizer.core.simd.algebra import dot, multiply
from rs_localizer.core.simd.tracing import LANES, Vector, select
from rs_localizer.native import entry, kernel

MODEL_SIZE = 18

# Largest step of v and w together, rad, of a converged sample: a millionth of a pixel, and above
# the rounding of most samples.
_CONVERGED = 1e-9


def inputs(size: int) -> int:
    """Return the number of values before the solver's own state, for samples of ``size`` points."""
    return 6 * size + 9


@kernel
def gather(
    points: Array, rays: Array, tau: Array, samples: Any, rotations: Array, start: int, work: Array
) -> None:
    """Fill the lanes with samples ``start, start + 1, ...``; past the end the last one repeats.

    Points (m,3), rays (m,2) and row times (m,) are picked by ``samples`` (h,n); ``rotations`` is
    (1,3,3), one for all samples, or (h,3,3).
    """
    count, size = samples.shape
    for lane in range(LANES):
        h = min(start + lane, count - 1)
        for i in range(size):
            j = samples[h, i]
            for k in range(3):
                work[(3 * i + k) * LANES + lane] = points[j, k]
            for k in range(2):
                work[(3 * size + 2 * i + k) * LANES + lane] = rays[j, k]
            work[(5 * size + i) * LANES + lane] = tau[j]
        rotation = rotations[min(h, len(rotations) - 1)]
        for k in range(9):
            work[(6 * size + k) * LANES + lane] = rotation[k // 3, k % 3]


@kernel
def scatter(work: Array, offset: int, start: int, model: Array) -> None:
    """Write the lanes' models, which begin at value ``offset``, to columns of ``model`` (18,h)."""
    lanes = min(LANES, model.shape[1] - start)
    for lane in range(lanes):
        finite = True
        for k in range(MODEL_SIZE):
            finite = finite and np.isfinite(work[(offset + k) * LANES + lane])
        for k in range(MODEL_SIZE):
            model[k, start + lane] = work[(offset + k) * LANES + lane] if finite else np.nan


@kernel
def into_rig(models: Array, camera: IntArray, mounts: Mounts) -> None:
    """Turn models (k,18,h) of cameras (h,) into models of their rig.

    A camera's model is ``exp(tau [w]x) R X + C + tau t`` in its axes. The rig has the same model,
    with all four rotated into the axes of the rig and ``C`` moved by the camera's centre.
    """
    turned = np.empty(3)
    for h in range(len(camera)):
        axes, centre = mounts.axes[camera[h]], mounts.centres[camera[h]]
        for s in range(len(models)):
            for column in range(6):
                # Columns of R, and C, w, t.
                first, step = (column, 3) if column < 3 else (3 * column, 1)
                for i in range(3):
                    turned[i] = centre[i] if column == 3 else 0.0
                    for k in range(3):
                        turned[i] += axes[k, i] * models[s, first + step * k, h]
                for i in range(3):
                    models[s, first + step * i, h] = turned[i]


@kernel
def converged(work: Array, change: int) -> bool:
    """Return True if no lane steps any more, by value ``change`` of :meth:`Sample.stepped`."""
    moving = False
    for lane in range(LANES):
        moving = moving or work[change * LANES + lane] > _CONVERGED**2
    return not moving


@entry
def unpack(
    models: Array3,
    first: int,
    rotations: Out[Array4],
    translations: Out[Array3],
    w: Out[Array3],
    t: Out[Array3],
) -> None:
    """Write models (k,18,h) to rows ``first ...`` of rotations (.,k,3,3) and vectors (.,k,3)."""
    for s in range(models.shape[0]):
        for i in range(models.shape[2]):
            row = first + i
            for a in range(3):
                for b in range(3):
                    rotations[row, s, a, b] = models[s, 3 * a + b, i]
                translations[row, s, a] = models[s, 9 + a, i]
                w[row, s, a] = models[s, 12 + a, i]
                t[row, s, a] = models[s, 15 + a, i]


class Sample:
    """The inputs of a traced function by their names."""

    __slots__ = ("points", "rays", "rotation", "state", "tau")

    def __init__(self, values: Sequence[Any], size: int) -> None:
        self.points: list[Vector] = [list(values[3 * i : 3 * i + 3]) for i in range(size)]
        rays = values[3 * size : 5 * size]
        self.rays: list[Vector] = [list(rays[2 * i : 2 * i + 2]) for i in range(size)]
        self.tau: Vector = list(values[5 * size : 6 * size])
        rotation = values[6 * size : 6 * size + 9]
        self.rotation: list[Vector] = [list(rotation[3 * i : 3 * i + 3]) for i in range(3)]
        self.state: Vector = list(values[6 * size + 9 :])

    def rotated_points(self) -> list[Vector]:
        """Return the points in the frame of the initial rotation."""
        return [multiply(self.rotation, x) for x in self.points]

    def with_results(
        self, points: Sequence[Vector], rotation: Sequence[Vector], state: Vector
    ) -> Vector:
        """Return the values in their order again, with what a step has changed."""
        return [
            *(x for point in points for x in point),
            *(x for ray in self.rays for x in ray),
            *self.tau,
            *(x for row in rotation for x in row),
            *state,
        ]

    def stepped(
        self, points: Sequence[Vector], rotation: Sequence[Vector], state: Vector, *steps: Vector
    ) -> Vector:
        """Append steps (rad) and their square to :meth:`with_results` of an iteration.

        A converged sample stays as it is, whatever the others in its lanes do.
        """
        change = sum((dot(step, step) for step in steps), 0.0)
        before = self.with_results(self.points, self.rotation, self.state)
        after = self.with_results(points, rotation, [*state, change])
        moving = self.state[-1] > _CONVERGED**2
        return [
            new if new is old else select(moving, new, old)
            for old, new in zip(before, after, strict=True)
        ]
