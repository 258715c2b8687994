"""Whitened rows of keypoints for the numbers that all images share, the motion taken out."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.simd.jit import kernel
from rs_localizer.trajectory.normal_kernels import border_of
from rs_localizer.trajectory.sight_kernels import Curve, Sights, Terms, differentiate, make_row
from rs_localizer.trajectory.spline_kernels import CONTROL, LOCAL


@kernel
def border_rows(
    curve: Curve, sights: Sights, terms: Terms, lifted: Array, first: int, out: Array
) -> None:
    """Fill the rows of as many keypoints as there is room for, from one on; zeros for those that
    do not count.

    Args:
        lifted: (6 n, b) H^-1 C of the bordered system: how the controls follow the border.
        out: (k,2,b + 1) derivatives by the border, the controls following, and the error.
    """
    row = make_row(sights, terms)
    shared = lifted.shape[1]
    most = row.by_shared.shape[1] + 6
    columns, border = np.empty(most, np.int64), np.empty((2, most))
    out[:] = 0.0
    for k in range(len(out)):
        n = first + k
        weight, _ = differentiate(curve, sights, terms, n, row)
        if weight == 0.0:
            continue
        scale, base = np.sqrt(weight), CONTROL * sights.first[n]
        count = border_of(sights, terms, n, row, columns, border)
        for r in range(2):
            mine = out[k, r]
            mine[shared] = scale * row.error[r]
            for j in range(count):
                mine[columns[j]] += scale * border[r, j]
            for a in range(LOCAL):
                x = scale * row.by_controls[r, a]
                for j in range(shared):
                    mine[j] -= x * lifted[base + a, j]
