"""Corners of markers from the edges that meet in them, to a few hundredths of a pixel.

Across each side of a black square the profile of the image is sampled; the middle of its rise is
a point of the edge. A straight line through these points (a parabola for a long side, which lens
and shutter bend) meets that of the next side in the corner. Unlike the search for a corner's own
gradients this has no bias: blur rounds a corner off, but moves no edge.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.core.lanes.jit import kernel

# Most points along a side, of each round: the first only has to get near.
_POINTS = (12, 32)
# Half the length of a profile, in cells of the marker (it must stay within the black border and
# the white rim) and in px (a start may be off by one, and blur needs room; more only adds noise).
_HALF_CELLS = 0.6
_HALF_LEAST, _HALF_MOST = 1.5, 3.5
_STEP = 0.5  # px between the samples of a profile
_MOST_SAMPLES = 2 * math.ceil(_HALF_MOST / _STEP) + 1
# Parts of a side next to its ends are left out: blur mixes in the other side.
_END_SHARE, _END_PIXELS = 0.1, 2.0
_LEAST_POINTS = 4
_LEAST_RISE = 10.0  # gray levels from black to white
_PARABOLA_FROM = 40.0  # px
# Points this far from the curve (px, or in terms of the others' distance) belong to something
# else that covers the side.
_OUTLIER_LEAST, _OUTLIER_FACTOR = 0.35, 2.5
# A corner that ends up farther from its start (in cells, and px) is none.
_MOST_MOVE_CELLS, _MOST_MOVE_PIXELS = 0.7, 2.0


@kernel
def _outside(image: NDArray[np.uint8], x: float, y: float) -> bool:
    height, width = image.shape
    return not (0.0 <= x < width - 1.0 and 0.0 <= y < height - 1.0)


@kernel
def _edge_at(
    image: NDArray[np.uint8],
    x: float,
    y: float,
    nx: float,
    ny: float,
    half: float,
    profile: Array,
) -> float:
    """How far along the normal, from black to white, the edge is from a point; NaN: none.

    The centroid of the steepest unbroken rise: a pixel's light is its integral, which leaves the
    centroid of the slope where it was, however sharp the edge. Any weight but the slope itself
    draws an edge along a row of pixels to their middle or rim, by up to 0.15 px.
    """
    steps = math.ceil(half / _STEP)
    reach = steps * _STEP
    if _outside(image, x - reach * nx, y - reach * ny):
        return math.nan
    if _outside(image, x + reach * nx, y + reach * ny):
        return math.nan
    steepest, at, count = 0.0, 0, 2 * steps + 1
    for k in range(count):
        offset = k * _STEP - reach
        u, v = x + offset * nx, y + offset * ny
        column, row = int(u), int(v)
        fx, fy = u - column, v - row
        above = (1.0 - fx) * image[row, column] + fx * image[row, column + 1]
        below = (1.0 - fx) * image[row + 1, column] + fx * image[row + 1, column + 1]
        profile[k] = (1.0 - fy) * above + fy * below
        if k > 0 and profile[k] - profile[k - 1] > steepest:
            steepest, at = profile[k] - profile[k - 1], k
    first, last = at, at
    while first > 0 and profile[first - 1] < profile[first]:
        first -= 1
    while last + 1 < count and profile[last + 1] > profile[last]:
        last += 1
    rise = profile[last] - profile[first]
    if rise < _LEAST_RISE:
        return math.nan
    moment = 0.0
    for k in range(first + 1, last + 1):
        moment += (profile[k] - profile[k - 1]) * ((k - 0.5) * _STEP - reach)
    return float(moment / rise)


@kernel
def _fit(s: Array, e: Array, used: NDArray[np.bool_], parabola: bool, c: Array) -> int:
    """Least squares of e = c0 + c1 s + c2 s^2 over the used points; how many those are."""
    n, s1, s2, s3, s4, e0, e1, e2 = 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(s)):
        if used[k]:
            n += 1
            t = s[k]
            s1 += t
            s2 += t * t
            s3 += t * t * t
            s4 += t * t * t * t
            e0 += e[k]
            e1 += t * e[k]
            e2 += t * t * e[k]
    if n < _LEAST_POINTS:
        return n
    # Gauss elimination of the normal equations, without the last row for a line.
    a11, a12, b1 = s2 - s1 * s1 / n, s3 - s1 * s2 / n, e1 - s1 * e0 / n
    a22, b2 = s4 - s2 * s2 / n, e2 - s2 * e0 / n
    c[2] = 0.0
    if parabola:
        c[2] = (b2 - a12 * b1 / a11) / (a22 - a12 * a12 / a11)
    c[1] = (b1 - a12 * c[2]) / a11
    c[0] = (e0 - s1 * c[1] - s2 * c[2]) / n
    return n


@kernel
def _side(
    image: NDArray[np.uint8],
    ax: float,
    ay: float,
    bx: float,
    by: float,
    cells: int,
    most_points: int,
    c: Array,
) -> bool:
    """Fit the edge near the side from a to b: offsets c0 + c1 s + c2 s^2 outward, s in -1..1."""
    dx, dy = bx - ax, by - ay
    length = math.sqrt(dx * dx + dy * dy)
    if not length > 1.0:
        return False
    nx, ny = dy / length, -dx / length  # outward: corners go clockwise, and y is down
    half = min(max(_HALF_CELLS * length / cells, _HALF_LEAST), _HALF_MOST)
    margin = max(_END_SHARE, _END_PIXELS / length)
    count = min(max(int(length * (1.0 - 2.0 * margin)), 0), most_points)
    if count < _LEAST_POINTS:
        return False
    s, e, profile = np.empty(count), np.empty(count), np.empty(_MOST_SAMPLES)
    used = np.empty(count, np.bool_)
    for k in range(count):
        share = margin + (1.0 - 2.0 * margin) * k / (count - 1)
        s[k] = 2.0 * share - 1.0
        e[k] = _edge_at(image, ax + share * dx, ay + share * dy, nx, ny, half, profile)
        used[k] = not math.isnan(e[k])
    parabola = length >= _PARABOLA_FROM
    if _fit(s, e, used, parabola, c) < max(_LEAST_POINTS, count // 2):
        return False
    squares, n = 0.0, 0
    for k in range(count):
        if used[k]:
            squares += (e[k] - c[0] - c[1] * s[k] - c[2] * s[k] * s[k]) ** 2
            n += 1
    most = max(_OUTLIER_LEAST, _OUTLIER_FACTOR * math.sqrt(squares / n))
    for k in range(count):
        if used[k]:
            used[k] = abs(e[k] - c[0] - c[1] * s[k] - c[2] * s[k] * s[k]) <= most
    return _fit(s, e, used, parabola, c) >= max(_LEAST_POINTS, count // 2)


@kernel
def _corner(q: Array, at: int, before: Array, after: Array) -> tuple[float, float]:
    """Where the tangents of two sides meet, taken at the sides' ends in this corner."""
    p, r = (at + 3) % 4, (at + 1) % 4
    # The side that ends here, at s = 1.
    ux, uy = q[at, 0] - q[p, 0], q[at, 1] - q[p, 1]
    length = math.sqrt(ux * ux + uy * uy)
    nx, ny = uy / length, -ux / length
    offset = before[0] + before[1] + before[2]
    slope = 2.0 * (before[1] + 2.0 * before[2])  # per whole side: s is 2 long
    px, py = q[at, 0] + offset * nx, q[at, 1] + offset * ny
    tx, ty = ux + slope * nx, uy + slope * ny
    # The one that starts here, at s = -1.
    vx, vy = q[r, 0] - q[at, 0], q[r, 1] - q[at, 1]
    length = math.sqrt(vx * vx + vy * vy)
    mx, my = vy / length, -vx / length
    offset = after[0] - after[1] + after[2]
    slope = 2.0 * (after[1] - 2.0 * after[2])
    rx, ry = q[at, 0] + offset * mx, q[at, 1] + offset * my
    wx, wy = vx + slope * mx, vy + slope * my
    cross = tx * wy - ty * wx
    share = ((rx - px) * wy - (ry - py) * wx) / cross
    return px + share * tx, py + share * ty


@kernel
def refine(image: NDArray[np.uint8], quads: Array, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Move the corners of markers to where their sides meet, in place.

    Args:
        image: (h,w) gray, C-contiguous.
        quads: (m,4,2) corners, clockwise as seen in the image, within a pixel or so.
        cells: (m,) cells along a side.

    Returns:
        (m,4): which corners were found; the others are left at their start.
    """
    found = np.zeros((len(quads), 4), np.bool_)
    curves = np.empty((4, 3))
    good = np.empty(4, np.bool_)
    moved = np.empty((4, 2))
    for m in range(len(quads)):
        q = quads[m].copy()
        for most_points in _POINTS:
            for s in range(4):
                e = (s + 1) % 4
                good[s] = _side(
                    image, q[s, 0], q[s, 1], q[e, 0], q[e, 1], cells[m], most_points, curves[s]
                )
            for k in range(4):
                found[m, k] = good[k] and good[(k + 3) % 4]
                moved[k] = q[k]
                if found[m, k]:
                    x, y = _corner(q, k, curves[(k + 3) % 4], curves[k])
                    moved[k, 0], moved[k, 1] = x, y
            q[:] = moved
        dx, dy = quads[m, 1, 0] - quads[m, 0, 0], quads[m, 1, 1] - quads[m, 0, 1]
        most = max(_MOST_MOVE_PIXELS, _MOST_MOVE_CELLS * math.sqrt(dx * dx + dy * dy) / cells[m])
        for k in range(4):
            dx, dy = q[k, 0] - quads[m, k, 0], q[k, 1] - quads[m, k, 1]
            # Comparison with NaN is false.
            found[m, k] = found[m, k] and dx * dx + dy * dy <= most * most
            if found[m, k]:
                quads[m, k] = q[k]
    return found
