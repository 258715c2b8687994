# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Corners of markers from the edges that meet in them, to a few hundredths of a pixel.

Across each side of a black square the profile of the image is sampled, as far as motion smears the
edge (:func:`edge_points`). A straight line through the points of the edge (a
parabola for a long side, which lens and shutter bend) meets that of the next side in the corner.
Unlike the search for a corner's own gradients this has no bias: blur rounds a corner off, but moves
no edge. Two rounds: the first finds how much the edges are blurred, and gets near.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array, Array3, ByteArray2, Out
from rs_localizer.native import entry, inlined, kernel

# px between the samples of a profile; more for one that reaches farther than this many steps.
_STEP, _MOST_STEPS = 0.5, 7
_LEAST_RISE = 10.0  # gray levels from black to white
SEEN, VARIANCE, BLACK, WHITE, CUT = range(5)
"""Numbers of the rises by :func:`edge_points`: how many, and of those the means of the variance
(px^2), of the levels at foot and top, and the share that goes on beyond its profile."""


@kernel
def edge_points(
    image: NDArray[np.uint8],
    a: Array,
    b: Array,
    half: float,
    levels: tuple[float, float],
    s: Array,
    e: Array,
) -> Array:
    """Find points of the edge near the side from a to b, sharp or smeared by motion.

    A pixel's light is its integral, and motion smears an edge evenly to both sides of where it is
    in the middle of the exposure: the centroid of the slope stays where it was. It is right as
    long as the profile shows the whole rise. Blurred by more than a cell, the black border never
    gets black: what lies inside cuts the foot of the rise off. Around half way between black and
    white, as the rest of the marker shows them, it is still the edge's own.

    Args:
        image: (h,w) gray.
        a, b: (2,) px; white is to the left of the way from a to b as an image shows it.
        half: px that the profiles reach to either side.
        levels: half way between black and white, and how far around it rises are the edge's
            own; NaN: all the way.
        s: (n,) places along the side, from -1 in a to 1 in b.
        e: (n,) out: px from the side to the white; NaN: no edge.

    Returns:
        (5,) the rises, see :data:`SEEN`.
    """
    dx, dy = b[0] - a[0], b[1] - a[1]
    length = math.sqrt(dx * dx + dy * dy)
    nx, ny = dy / length, -dx / length  # outward: corners go clockwise, and y is down
    step = max(_STEP, half / _MOST_STEPS)
    profile, rises = np.empty(2 * math.ceil(half / step) + 1), np.zeros(5)
    reach = step * (len(profile) // 2)
    for k in range(len(s)):
        share = 0.5 + 0.5 * s[k]
        x, y = a[0] + share * dx, a[1] + share * dy
        e[k] = math.nan
        if _sample(image, x - reach * nx, y - reach * ny, step * nx, step * ny, profile):
            e[k] = step * _edge(profile, levels, step, rises) - reach
    if rises[SEEN] > 0.0:
        count = rises[SEEN]
        for i in range(1, len(rises)):
            rises[i] /= count
    return rises


@inlined
def _sample(
    image: NDArray[np.uint8], x: float, y: float, dx: float, dy: float, profile: Array
) -> bool:
    """Sample grey levels along a line from a point; return False if they leave the image."""
    last = len(profile) - 1
    if _outside(image, x, y) or _outside(image, x + last * dx, y + last * dy):
        return False
    for k in range(len(profile)):
        u, v = x + k * dx, y + k * dy
        column, row = int(u), int(v)
        fx, fy = u - column, v - row
        above = (1.0 - fx) * image[row, column] + fx * image[row, column + 1]
        below = (1.0 - fx) * image[row + 1, column] + fx * image[row + 1, column + 1]
        profile[k] = (1.0 - fy) * above + fy * below
    return True


@kernel
def _outside(image: NDArray[np.uint8], x: float, y: float) -> bool:
    height, width = image.shape
    return not (0.0 <= x < width - 1.0 and 0.0 <= y < height - 1.0)


@inlined
def _edge(profile: Array, levels: tuple[float, float], step: float, rises: Array) -> float:
    """Return the place (samples) of the steepest unbroken rise, and add it to the rises; or NaN.

    Any weight but the slope itself draws an edge along a row of pixels to their middle or rim, by
    up to 0.15 px.
    """
    steepest, at = 0.0, 0
    for k in range(1, len(profile)):
        if profile[k] - profile[k - 1] > steepest:
            steepest, at = profile[k] - profile[k - 1], k
    first, last = at, at
    while first > 0 and profile[first - 1] < profile[first]:
        first -= 1
    while last + 1 < len(profile) and profile[last + 1] > profile[last]:
        last += 1
    rise = profile[last] - profile[first]
    if rise < _LEAST_RISE:
        return math.nan
    moment, square = 0.0, 0.0
    for k in range(first + 1, last + 1):
        share, offset = (profile[k] - profile[k - 1]) / rise, k - 0.5 - at
        moment += share * offset
        square += share * offset * offset
    rises[SEEN] += 1.0
    rises[VARIANCE] += step * step * (square - moment * moment)
    rises[BLACK] += profile[first]
    rises[WHITE] += profile[last]
    rises[CUT] += first == 0 or last == len(profile) - 1
    middle, around = levels
    around = min(around, middle - profile[first], profile[last] - middle)
    if not around > 0.0:
        return float(at + moment)
    moment = 0.0
    for k in range(first + 1, last + 1):
        low, high = max(profile[k - 1], middle - around), min(profile[k], middle + around)
        if low < high:
            share = (0.5 * (low + high) - profile[k - 1]) / (profile[k] - profile[k - 1])
            moment += (high - low) * (k - 1 + share)
    return float(moment / (2.0 * around))


# Most points along a side, of each round: the first only has to get near.
_POINTS = (12, 32)
# Half the length of a profile, in cells of the marker (it must stay within the black border and
# the white rim) and in px (a start may be off by one; more only adds noise). Where most rises go
# on beyond it, it is made longer, up to a whole cell.
_HALF_CELLS = 0.6
_HALF_LEAST, _HALF_MOST, _LONGER = 1.5, 3.5, 1.5
# A sharp edge has this variance (px^2) from the pixels and from sampling between them, and this
# width (px) from foot to top. A rise is whole if it is not wider than this share of a cell.
_SHARP_VARIANCE, _SHARP_WIDTH, _WHOLE = 0.4, 2.0, 0.9
# For an edge that is not whole, this share of the way from black to white counts, to either side of
# its middle.
_AROUND = 0.3
# Parts of a side next to its ends are left out, where the next side is mixed in: as a share, and
# in px across that side, beside half of what motion smears it; never more than so much.
_END_SHARE, _END_PIXELS, _MOST_END_SHARE, _LEAST_SINE = 0.1, 2.0, 0.3, 0.1
_LEAST_POINTS = 4
# A shorter side of this many points is a parabola where that leaves less, by this many variances.
# Of a fisheye (f = 260 px, sides of 35 px, noise of 3 gray levels) straight lines lay corners 0.150
# px too far outside; with 8 and 20 variances 0.003 and 0.009. Points share pixels, so that straight
# sides (18 to 38 px) may look bent: errors of 0.042, 0.030, 0.0241 px with 2, 8, 20, of lines alone
# 0.0236.
_PARABOLA_FROM, _LEAST_TO_BEND, _WORTH = 40.0, 8, 20.0  # px, points, noise variances
# Points this far from the curve (px, or in terms of the others' distance) belong to something
# else that covers the side.
_OUTLIER_LEAST, _OUTLIER_FACTOR = 0.35, 2.5
# A corner that ends up farther from its start (in cells, and px) is none.
_MOST_MOVE_CELLS, _MOST_MOVE_PIXELS = 0.7, 2.0


@kernel
def _fit(s: Array, e: Array, used: NDArray[np.bool_], parabola: bool, c: Array) -> int:
    """Fit e = c0 + c1 s + c2 s^2 to the used points by least squares; return their number."""
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


@inlined
def _depth(q: Array, at: int) -> float:
    """Return the smaller distance (px) of the far corners from the side that starts at ``at``."""
    a, b = q[at], q[(at + 1) % 4]
    dx, dy = b[0] - a[0], b[1] - a[1]
    c, d = q[(at + 2) % 4], q[(at + 3) % 4]
    far = min(dx * (c[1] - b[1]) - dy * (c[0] - b[0]), dx * (d[1] - a[1]) - dy * (d[0] - a[0]))
    return float(far / math.sqrt(dx * dx + dy * dy))


@kernel
def _end(q: Array, before: int, at: int, width: float, length: float) -> float:
    """Return the share of a side that the next side, smeared over a width, disturbs."""
    after = (at + 1) % 4
    ux, uy = q[at, 0] - q[before, 0], q[at, 1] - q[before, 1]
    vx, vy = q[after, 0] - q[at, 0], q[after, 1] - q[at, 1]
    sine = abs(ux * vy - uy * vx) / (math.hypot(ux, uy) * math.hypot(vx, vy))
    share = (_END_PIXELS + 0.5 * width) / (max(sine, _LEAST_SINE) * length)
    return float(max(_END_SHARE, min(share, _MOST_END_SHARE)))


@kernel
def _width(rises: Array) -> float:
    """Return the width (px) of motion's smear of an edge, whose variance is width^2 / 12."""
    return math.sqrt(12.0 * max(rises[VARIANCE] - _SHARP_VARIANCE, 0.0))


@inlined
def _levels(rises: Array, at: int, cell: float) -> tuple[float, float]:
    """Return the level half way up the edge of a side, and the range around it; else NaN.

    Where its rises (4,5) of the round before are whole.
    """
    none = (math.nan, math.nan)
    for k in range(4):
        if rises[k, SEEN] == 0.0:
            return none
    left, across, right = (at + 1) % 4, (at + 2) % 4, (at + 3) % 4
    # The darkest side shows black. White may vary over the marker, but sides that face each other
    # have as much of it as the other two, unless something dark beyond the rim takes from it.
    black, white = rises[:, BLACK].min(), rises[:, WHITE]
    own = white[at] + max(0.5 * (white[left] + white[right] - white[at] - white[across]), 0.0)
    shown = (rises[at, WHITE] - rises[at, BLACK]) / (own - black)
    if _width(rises[at]) / shown + _SHARP_WIDTH < _WHOLE * cell:
        return none
    return 0.5 * (black + own), _AROUND * (own - black)


@inlined
def _side(
    image: NDArray[np.uint8],
    q: Array,
    at: int,
    cells: int,
    most_points: int,
    before: Array,
    rises: Array,
    c: Array,
) -> bool:
    """Fit the edge near the side that corner ``at`` begins.

    Offsets c0 + c1 s + c2 s^2 outward, s in -1..1. ``before`` (4,5) are the rises of the last
    round, ``rises`` (5,) those of this one.
    """
    a, b, last = q[at], q[(at + 1) % 4], (at + 3) % 4
    length = math.hypot(b[0] - a[0], b[1] - a[1])
    if not length > 1.0:
        return False
    start = _end(q, last, at, _width(before[last]), length)
    end = _end(q, at, (at + 1) % 4, _width(before[(at + 1) % 4]), length)
    count = min(max(int(length * (1.0 - start - end)), 0), most_points)
    if count < _LEAST_POINTS:
        return False
    s, e = np.linspace(2.0 * start - 1.0, 1.0 - 2.0 * end, count), np.empty(count)
    cell = _depth(q, at) / cells
    levels = _levels(before, at, cell)
    half = min(max(_HALF_CELLS * cell, _HALF_LEAST), _HALF_MOST)
    rises[:] = edge_points(image, a, b, half, levels, s, e)
    while rises[CUT] * rises[SEEN] > count // 2 and half < cell:
        half = min(_LONGER * half, cell)
        rises[:] = edge_points(image, a, b, half, levels, s, e)
    return _fit_twice(s, e, length >= _PARABOLA_FROM, c)


@kernel
def _left(s: Array, e: Array, used: NDArray[np.bool_], c: Array) -> float:
    """Return the sum of squared residuals of the used points."""
    squares = 0.0
    for k in range(len(s)):
        if used[k]:
            squares += (e[k] - c[0] - c[1] * s[k] - c[2] * s[k] * s[k]) ** 2
    return squares


@inlined
def _fit_twice(s: Array, e: Array, parabola: bool, c: Array) -> bool:
    """Fit the points that are no NaN, then those that are near the first fit."""
    count, used = len(s), ~np.isnan(e)
    if _fit(s, e, used, parabola, c) < max(_LEAST_POINTS, count // 2):
        return False
    most = max(_OUTLIER_LEAST, _OUTLIER_FACTOR * math.sqrt(_left(s, e, used, c) / used.sum()))
    for k in range(count):
        if used[k]:
            used[k] = abs(e[k] - c[0] - c[1] * s[k] - c[2] * s[k] * s[k]) <= most
    n = _fit(s, e, used, parabola, c)
    if n >= _LEAST_TO_BEND and not parabola:
        bent = np.empty(3)
        _fit(s, e, used, True, bent)
        straight, left = _left(s, e, used, c), _left(s, e, used, bent)
        if (straight - left) * (n - 3) > _WORTH * left:
            c[:] = bent
    return n >= max(_LEAST_POINTS, count // 2)


@inlined
def _corner(q: Array, at: int, before: Array, after: Array) -> tuple[float, float]:
    """Return the intersection of the tangents of two sides at their common corner."""
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


def refine(image: NDArray[np.uint8], quads: Array, cells: int) -> NDArray[np.bool_]:
    """Move the corners of markers to where their sides meet, in place.

    Args:
        image: (h,w) gray, C-contiguous.
        quads: (m,4,2) corners, clockwise as seen in the image, within a pixel or so.
        cells: along a side of each.

    Returns:
        (m,4): which corners were found; the others are left at their start.
    """
    # Whether an image may be written depends on where it came from. Numba would compile a kernel
    # for either kind, and the two might round differently.
    pixels = image.view()
    pixels.flags.writeable = False
    refined: NDArray[np.bool_] = _refine(pixels, quads, cells)
    return refined


@entry
def _refine(image: ByteArray2, quads: Out[Array3], cells: int) -> NDArray[np.bool_]:
    refined = np.zeros((len(quads), 4), np.bool_)
    curves = np.empty((4, 3))
    good = np.empty(4, np.bool_)
    moved = np.empty((4, 2))
    for m in range(len(quads)):
        q = quads[m].copy()
        before, rises = np.zeros((4, 5)), np.zeros((4, 5))
        for most_points in _POINTS:
            for s in range(4):
                good[s] = _side(image, q, s, cells, most_points, before, rises[s], curves[s])
            for k in range(4):
                refined[m, k] = good[k] and good[(k + 3) % 4]
                moved[k] = q[k]
                if refined[m, k]:
                    x, y = _corner(q, k, curves[(k + 3) % 4], curves[k])
                    moved[k, 0], moved[k, 1] = x, y
            q[:] = moved
            before[:] = rises
        dx, dy = quads[m, 1, 0] - quads[m, 0, 0], quads[m, 1, 1] - quads[m, 0, 1]
        most = max(_MOST_MOVE_PIXELS, _MOST_MOVE_CELLS * math.sqrt(dx * dx + dy * dy) / cells)
        for k in range(4):
            dx, dy = q[k, 0] - quads[m, k, 0], q[k, 1] - quads[m, k, 1]
            # Comparison with NaN is false.
            refined[m, k] = refined[m, k] and dx * dx + dy * dy <= most * most
            if refined[m, k]:
                quads[m, k] = q[k]
    return refined
