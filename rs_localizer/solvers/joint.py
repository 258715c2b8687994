# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""joint: both ``r6p_vct_w`` and ``r6p_vcwt`` on every sample; the robust score picks.

The suggestion of Kukelova, Albl, Sugimoto, Pajdla, ACCV 2018, sec. 4.1, for unknown motion: the
first is ahead under pure translation, the second elsewhere. Six points, two solutions.
"""

from __future__ import annotations

from rs_localizer.core.arrays import Array1, Array2, Array3, IntArray2, Out
from rs_localizer.native import entry
from rs_localizer.solvers import r6p_two_step, r6p_vcwt

SAMPLE_SIZE = 6
SOLUTIONS = 2

_solve_vct_w = r6p_two_step.solve_vct_w
_solve_vcwt = r6p_vcwt.solve_batch


@entry
def solve_batch(
    points: Array2, rays: Array2, tau: Array1, samples: IntArray2, rotations: Array3,
    iterations: int, models: Out[Array3],
) -> None:  # fmt: skip
    """Solve a batch; arguments and result as in :mod:`rs_localizer.solvers.batch`."""
    _solve_vct_w(points, rays, tau, samples, rotations, iterations, models[0:1])
    _solve_vcwt(points, rays, tau, samples, rotations, iterations, models[1:2])
