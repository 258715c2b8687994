"""The normal equations of keypoints along a spline, compiled."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.simd.jit import kernel
from rs_localizer.trajectory.sight_kernels import (
    Curve,
    Row,
    Sights,
    Terms,
    differentiate,
    make_row,
)
from rs_localizer.trajectory.spline_kernels import CONTROL, LOCAL


class Normal(NamedTuple):
    """Normal equations: a band for the controls, a dense border for what all images share.

    What the stamp of each image is off (one number) stands beside them until it is eliminated; it
    touches the w controls that act during the image.
    """

    band: Array  # (6 w, 6 n) lower band, as LAPACK stores it
    cross: Array  # (6 n, b)
    corner: Array  # (b, b) lower triangle
    slope: Array  # (6 n,)
    border_slope: Array  # (b,)
    image_first: IntArray  # (g,) first control of each image
    image_controls: Array  # (g, 6 w)
    image_border: Array  # (g, b)
    image_information: Array  # (g,)
    image_slope: Array  # (g,)


@kernel
def border_of(sights: Sights, terms: Terms, n: int, row: Row, columns: IntArray,
               border: Array) -> int:  # fmt: skip
    """Fill the columns of the border that keypoint n touches, rising, and its derivatives
    (2,...) by them; returns their number.
    """
    count = len(row.by_shared[0])
    for k in range(count):
        columns[k] = k
        border[0, k], border[1, k] = row.by_shared[0, k], row.by_shared[1, k]
    slot = sights.slots[n] if terms.point_column >= 0 else -1
    if slot < 0:
        return count
    base, arm = terms.point_column + terms.point_width * slot, sights.arms[n]
    for i in range(3):
        columns[count + i] = base + i
        for r in range(2):
            border[r, count + i] = row.by_landmark[r, i]
    if terms.point_width == 3:
        return count + 3
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        columns[count + 3 + i] = base + 3 + i
        for r in range(2):
            g = row.by_landmark[r]
            border[r, count + 3 + i] = arm[a] * g[b] - arm[b] * g[a]
    return count + 6


@kernel
def accumulate(curve: Curve, sights: Sights, terms: Terms, normal: Normal) -> float:
    """Add the keypoints' part to the normal equations; returns its cost."""
    row = make_row(sights, terms)
    rows, error, late = row.by_controls, row.error, row.by_time
    most = row.by_shared.shape[1] + 6
    columns, border = np.empty(most, np.int64), np.empty((2, most))
    cost = 0.0
    for n in range(len(sights.first)):
        weight, spent = differentiate(curve, sights, terms, n, row)
        cost += spent
        if weight == 0.0:
            continue
        count, image = border_of(sights, terms, n, row, columns, border), sights.frames[n]
        base = CONTROL * sights.first[n]
        for a in range(LOCAL):
            x, y = weight * rows[0, a], weight * rows[1, a]
            normal.slope[base + a] += x * error[0] + y * error[1]
            for b in range(a + 1):
                normal.band[a - b, base + b] += x * rows[0, b] + y * rows[1, b]
            for k in range(count):
                normal.cross[base + a, columns[k]] += x * border[0, k] + y * border[1, k]
            if terms.stamps_free:
                place = base + a - CONTROL * normal.image_first[image]
                normal.image_controls[image, place] += x * late[0] + y * late[1]
        if terms.stamps_free:
            x, y = weight * late[0], weight * late[1]
            normal.image_information[image] += x * late[0] + y * late[1]
            normal.image_slope[image] += x * error[0] + y * error[1]
            for k in range(count):
                normal.image_border[image, columns[k]] += x * border[0, k] + y * border[1, k]
        for k in range(count):
            x, y = weight * border[0, k], weight * border[1, k]
            normal.border_slope[columns[k]] += x * error[0] + y * error[1]
            for j in range(k + 1):  # columns rise
                normal.corner[columns[k], columns[j]] += x * border[0, j] + y * border[1, j]
    return cost
