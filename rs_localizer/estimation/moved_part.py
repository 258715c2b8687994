# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The part of a map that lies elsewhere than the map says, from what frames leave of its points.

Let a part ``P`` of the landmarks be shifted by ``d``. A frame is then off by

    e_i = J_i d [i in P] + B_i m + S_i c + noise

``J`` is the derivative by the landmark's place, ``m`` the error of the frame's motion, and ``c``
the smooth error of its image: a lens, or a map that is bent. Both are free in every frame and are
projected out. What is left after that stays with the landmarks only if the map has a step. Shifts
of all landmarks, each its own, say how much stays; one part with one shift must explain it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.rig import Exposure
from rs_localizer.core.shake import shake_at
from rs_localizer.core.state import MOTION_PARAMETERS, MOVE
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.linear_fit import DEGREE
from rs_localizer.estimation.points import find_usable, packed
from rs_localizer.estimation.prior import state_in
from rs_localizer.estimation.projection import linearized

# Landmarks that are compared: more take longer than they are worth.
_MOST = 60
# Rows of a frame for each column that is projected out: with fewer, hardly anything is left.
_ROWS_PER_COLUMN = 2
# Combinations of columns that are shorter than this, of the longest, are none.
_LEAST_COLUMN = 1e-3
# The prior of the landmarks' own shifts, as a part of their mean information: none to speak of.
_RIDGE = 1e-4
# A landmark's direction must vary by so much (rad, rms): dirt on a lens stays where it is.
_LEAST_VIEW = 0.01
# What stays with landmarks over what noise lets stay. Right maps have 0.8 to 1.3, as have all wrong
# lenses of benchmarks.kinds; half a map that is off by 1 cm has 60 to 200.
_STAYS = 3.0
# Share of what stays that one part explains. The best split of normal variates explains 2 / pi of
# them, a wrong part of a map that has a right one up to 0.87, and the right part more than 0.99.
_EXPLAINED = 0.9
# Declared deviations of two landmarks within which they are no two parts.
_DECLARED = 3.0 * math.sqrt(2.0)
# Parts from which the search starts, beyond these quantiles along the axes and their diagonals.
_QUANTILES, _STARTS = (0.2, 0.35, 0.5, 0.65, 0.8), 6
_ALONG = np.array([
    (x, y, z) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0) for z in (-1.0, 0.0, 1.0)
])[14:]  # fmt: skip


class Look(NamedTuple):
    """A frame without what its motion and its smooth error explain."""

    points: Array  # (n,3) m
    rays: Array  # (n,2)
    by_place: Array  # (n,2,3) px per m, derivatives of the errors by the places in the map
    taken: Array  # (n,2,q) orthonormal columns that are projected out
    left: Array  # (n,2) px, errors without them


class MovedPart(NamedTuple):
    """Landmarks that lie elsewhere, together."""

    points: Array  # (m,3) as the map has them
    way: Array  # (3,) m, from there to where they are
    compared: int  # landmarks among which they were found


def look_at(exposure: Exposure, found: Estimate, points: Array, pixels: Array) -> Look | None:
    """Return a frame's inliers without what its motion and its image explain; None if too few."""
    usable = find_usable(exposure, points, pixels, [len(pixels)], None)
    seen, own = packed(exposure, points, usable), usable.indices
    state = state_in(found, usable.centre)
    lines = linearized(seen.packed, len(seen), state, shake_at(usable.tau[own], found.shake))
    places, by_motion = points[own], lines.by_motion
    x, y = lines.image.T
    terms = np.stack(
        [x**i * y**j for i in range(DEGREE + 1) for j in range(DEGREE + 1 - i)], axis=1
    )
    nothing = np.zeros_like(terms)
    smooth = np.concatenate(
        [np.stack([terms, nothing], axis=1), np.stack([nothing, terms], axis=1)], axis=2
    )
    columns = np.concatenate([by_motion[:, :, :MOTION_PARAMETERS], smooth], axis=2)
    count, width = len(places), columns.shape[2]
    if 2 * count < _ROWS_PER_COLUMN * width:
        return None
    flat = columns.reshape(2 * count, width)
    if not (np.isfinite(flat).all() and np.isfinite(lines.errors).all()):
        return None
    taken, sizes, _ = np.linalg.svd(
        flat / np.maximum(np.linalg.norm(flat, axis=0), 1e-12), full_matrices=False
    )
    taken = taken[:, sizes > _LEAST_COLUMN * sizes[0]]
    off = -lines.errors.ravel()
    off -= taken @ (taken.T @ off)
    by_place = -by_motion[:, :, MOVE] @ found.rotation
    return Look(places, lines.image, by_place, taken.reshape(count, 2, -1), off.reshape(count, 2))


def moved_part(looks: Sequence[Look], map_deviation: float) -> MovedPart | None:
    """Return the part of the map that looks show elsewhere; None if they show no such part.

    Args:
        looks: of several frames.
        map_deviation: m, as declared.
    """
    every = np.concatenate([look.points for look in looks])
    points, which = np.unique(every, axis=0, return_inverse=True)
    which = which.ravel()
    if not _view_moved(looks, which, len(points)):
        return None
    size = 3 * len(points)
    flat, towards = np.zeros((size, size)), np.zeros((len(points), 3))
    information = flat.reshape(len(points), 3, len(points), 3)
    squared, freedom, first = 0.0, 0, 0
    for look in looks:
        own = which[first : first + len(look.points)]
        first += len(own)
        rows = np.swapaxes(look.by_place, 1, 2)
        taken = (rows @ look.taken).reshape(3 * len(own), -1)
        places = (3 * own[:, None] + np.arange(3)).ravel()
        flat[np.ix_(places, places)] -= taken @ taken.T
        information[own, :, own, :] += rows @ look.by_place
        towards[own] += np.einsum("nra,nr->na", look.by_place, look.left)
        squared += float(np.sum(look.left**2))
        freedom += 2 * len(own) - look.taken.shape[2]
    target = towards.ravel()
    ridge = _RIDGE * float(np.trace(flat)) / size
    inverse = np.linalg.inv(flat + ridge * np.eye(size))
    shifts = inverse @ target
    stays = float(2.0 * shifts @ target - shifts @ flat @ shifts)
    fitted = size - ridge * float(np.trace(inverse))
    variance = (squared - stays) / max(freedom - fitted, 1.0)
    if freedom <= fitted or stays < _STAYS * fitted * variance:
        return None
    gain, part, way = max(
        (_grown(information, towards, start) for start in _starts(information, towards, points)),
        key=lambda found: found[0],
    )
    if gain < _EXPLAINED * (stays - fitted * variance):
        return None
    if float(np.linalg.norm(way)) <= _DECLARED * map_deviation:
        return None
    if 2 * np.count_nonzero(part) > len(points):  # which of two parts has moved is not told
        part, way = ~part, -way
    return MovedPart(points[part], way, len(points))


def _view_moved(looks: Sequence[Look], which: IntArray, count: int) -> bool:
    """Return whether landmarks were seen in several directions, so that a lens errs otherwise."""
    rays, seen = np.concatenate([look.rays for look in looks]), np.bincount(which, minlength=count)
    squares = np.zeros(count)
    for axis in rays.T:
        mean = np.bincount(which, axis, count) / seen
        squares += np.bincount(which, (axis - mean[which]) ** 2, count) / seen
    return math.sqrt(float(np.median(squares))) >= _LEAST_VIEW


def _shift(information: Array, towards: Array, part: BoolArray) -> tuple[float, Array]:
    """Return what one shift of a part explains, and the shift (3,)."""
    one = part.astype(np.float64)
    inside = np.tensordot(one, np.tensordot(information, one, (2, 0)), (0, 0))
    target = towards[part].sum(axis=0)
    way: Array = np.linalg.lstsq(inside, target, rcond=None)[0]
    return float(target @ way), way


def _starts(information: Array, towards: Array, points: Array) -> list[BoolArray]:
    """Return the sides of planes through the map that explain most."""
    away = points - points.mean(axis=0)
    values, axes = np.linalg.eigh(away.T @ away)
    places = away @ axes / np.sqrt(np.maximum(values, _RIDGE * values[-1]))
    sides = [
        place > edge for place in (places @ _ALONG.T).T for edge in np.quantile(place, _QUANTILES)
    ]
    sides = [side for side in sides if side.any() and not side.all()]
    sides.sort(key=lambda side: -_shift(information, towards, side)[0])
    return sides[:_STARTS]


def _grown(information: Array, towards: Array, part: BoolArray) -> tuple[float, BoolArray, Array]:
    """Return the gain of a part, the part and its way, once no landmark is better elsewhere."""
    gain, way = _shift(information, towards, part)
    while True:
        target = towards @ way
        products = np.tensordot(np.tensordot(information, way, (3, 0)), way, (1, 0))
        inside = part.astype(np.float64)
        for _ in range(2 * len(part)):
            better = 2.0 * (target - products @ inside) * (1.0 - 2.0 * inside)
            better -= np.diag(products)
            best = int(np.argmax(better))
            if better[best] <= 0.0:
                break
            inside[best] = 1.0 - inside[best]
        other = inside > 0.5
        if not other.any() or other.all():
            return gain, part, way
        more, other_way = _shift(information, towards, other)
        if more <= gain * (1.0 + _RIDGE):
            return gain, part, way
        gain, part, way = more, other, other_way


def chosen(points: Array, inliers: BoolArray, before: Sequence[Look]) -> IntArray:
    """Return the indices of inliers to look at: those seen before, and others up to the most."""
    rows = np.flatnonzero(inliers)
    known = {tuple(point) for look in before for point in look.points.tolist()}
    again = np.array([tuple(point) in known for point in points[rows].tolist()], np.bool_)
    new = rows[~again]
    few = max(min(len(new), _MOST - len(known)), 0)
    return np.sort(np.r_[rows[again], new[np.linspace(0, len(new) - 1, few).astype(int)]])
