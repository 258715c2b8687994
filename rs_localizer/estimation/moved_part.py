# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A part of the map that lies elsewhere than the map says: two groups, each consistent.

Let a part ``P`` of the landmarks be shifted by ``d``. A frame is then off by

    e_i = J_i d [i in P] + A_i x + noise

``J`` is the derivative by the landmark's place. ``x`` is the motion of the frame and the smooth
error of its image, each with its prior. One shift and one part must explain more than chance, in
one frame or in some: the evidence of the split, whose labels cost what they tell, beside that of
one group. Which part is where the map says is not told. Either may be, with the share of its
landmarks: a part is one thing, however many of its landmarks a frame shows.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.shake import shake_at
from rs_localizer.core.state import MOVE, PARAMETERS, rotation_of
from rs_localizer.estimation.hypotheses import Posterior
from rs_localizer.estimation.linear_fit import ORDINARY, known_at, smooth_columns
from rs_localizer.estimation.points import Observed
from rs_localizer.estimation.prior import PriorTerms
from rs_localizer.estimation.projection import linearized
from rs_localizer.estimation.robust import LEAST_NOISE, TINY, WIDEST_GATE
from rs_localizer.estimation.search import GLOBAL_SHUTTER_SCALE

# Frames that are compared, and after how many others at most: it takes some 20 ms.
_LOOKS, _RARELY = 4, 60
# Neighbours of a landmark that are compared with it, deviations of chance by which they are alike,
# and landmarks that are enough.
_NEIGHBOURS, _ALIKE, _COMPARED = 4, 2.0, 200
# Splits that chance makes in one search of 1,000.
_LEAST_CHANCE = -math.log(1e-3)
# Declared deviations of two landmarks within which they are no two parts.
_DECLARED = 3.0 * math.sqrt(2.0)
# Parts from which the search starts, beyond these quantiles along the axes and their diagonals.
_QUANTILES, _STARTS = (0.2, 0.35, 0.5, 0.65, 0.8), 1
_ALONG = np.array([
    (x, y, z) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0) for z in (-1.0, 0.0, 1.0)
])[14:]  # fmt: skip
# So many landmarks have a shift, whatever they are.
_OF_SHIFT = 2
# Rounds of labels and fits: they mostly agree after four.
_ROUNDS = 6
# Of diagonals of normal equations, so that rounding leaves them positive.
_RIDGE = 1e-9


class Look(NamedTuple):
    """Errors of a frame's landmarks, linearized at its motion."""

    points: Array  # (n,3) m, as the map has them
    errors: Array  # (n,2) px
    by_place: Array  # (n,2,3) px per m, derivatives of the errors by the places in the map
    columns: Array  # (n,2,p) px, by motion and smooth error
    prior: Array  # (p,p) information on those, times the variance of the noise, if errors are 1 px
    sizes: tuple[float, float]  # px, of the smooth error: as it was found, and as is declared
    inliers: BoolArray  # (n,)
    reach: float  # px, within which a point belongs to a group
    area: float  # px, of the image, where the others are anywhere


class MovedPart(NamedTuple):
    """Landmarks that lie elsewhere, together, or all others do."""

    points: Array  # (m,3) as the map has them
    others: Array  # (n,3) that were compared with them
    way: Array  # (3,) m, from there to where they are, seen from the others

    def at(self, points: Array) -> Array:
        """Return modes (n,3,2) of points (n,3): by how much either group moves if it has moved."""
        every = np.concatenate([self.points, self.others])
        far = np.linalg.norm(points[:, None] - every, axis=2)
        inside = far.argmin(axis=1) < len(self.points)
        share = len(self.points) / len(every)
        moves = [math.sqrt(1.0 - share) * inside, -math.sqrt(share) * ~inside]
        modes: Array = np.stack(moves, axis=1)[:, None, :] * self.way[:, None]
        return modes


def look_at(observed: Observed, posterior: Posterior, terms: PriorTerms) -> Look:
    """Return what a frame leaves of its inliers, and of points near them.

    Args:
        terms: what is known of its motion but for poses of other frames.
    """
    seen, variance = observed.observations, posterior.noise**2
    lines = linearized(seen.packed, len(seen), posterior.state, shake_at(seen.tau, posterior.shake))
    circle = (GLOBAL_SHUTTER_SCALE * observed.assumed.focal_length) ** 2
    near = np.flatnonzero(np.sum(lines.errors**2, axis=1) < circle)  # NaN is not
    by_motion, bend = lines.by_motion[near], np.zeros((len(near), 0))
    if posterior.bend.shape[1]:
        bend = posterior.bend[near]
    smooth = smooth_columns(by_motion, lines.image[near], bend)
    columns = np.concatenate([by_motion[:, :, :PARAMETERS], smooth], axis=2)
    prior, motion = variance * np.eye(columns.shape[2]), slice(0, PARAMETERS)
    prior[motion, motion] = variance * known_at(terms, posterior.state).form[motion, motion]
    sizes = posterior.shared, math.hypot(posterior.declared, ORDINARY)
    return Look(
        observed.points[observed.usable.indices[near]],
        -lines.errors[near],
        -by_motion[:, :, MOVE] @ rotation_of(posterior.state),
        columns,
        prior,
        sizes,
        posterior.inliers[near],
        WIDEST_GATE * posterior.gate,
        float(math.prod(observed.exposure.cameras[0].size)),
    )


class MovedParts:
    """Looks, now and then, whether the frames of a track show a part of the map elsewhere.

    Args:
        map_deviation: m, as declared.
    """

    def __init__(self, map_deviation: float) -> None:
        self._map_deviation = map_deviation
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.part: MovedPart | None = None
        """The part that was last found; None: the frames that were last compared show none."""
        self._looks: list[Look] = []
        self._count, self._next = 0, 1

    def add(self, look: Callable[[], Look], alike: Callable[[], bool]) -> None:
        """Take an accepted frame, and whether errors of neighbours in it are alike."""
        self._count += 1
        if not self._looks:
            if self._count < self._next:
                return
            self._next += min(self._count, _RARELY)
            if not alike():
                self.part = None
                return
        self._looks.append(look())
        if len(self._looks) in (1, _LOOKS):
            self.part = moved_part(self._looks, self._map_deviation)
        if len(self._looks) == _LOOKS:
            self._looks.clear()
            self._next = self._count + min(self._count, _RARELY)


def neighbours_alike(observed: Observed, posterior: Posterior) -> bool:
    """Return whether errors of landmarks that are neighbours are alike, more than by chance.

    Moran's I, of both coordinates: it takes a fraction of what a search for parts does.
    """
    errors, near = _errors(observed, posterior)
    near = near[:: 1 + len(near) // _COMPARED]
    count = len(near)
    if count <= 2 * _NEIGHBOURS:
        return False
    off = errors[near] - errors[near].mean(axis=0)
    places = observed.observations.points[near]
    squares = np.sum(places**2, axis=1)
    far = squares - 2.0 * places @ places.T  # but for a part that is a point's own
    far[np.diag_indices(count)] = np.inf
    beside = np.argpartition(far, _NEIGHBOURS, axis=1)[:, :_NEIGHBOURS]
    products = np.einsum("na,nka->", off, off[beside]) / _NEIGHBOURS
    index = float(products) / max(float(np.sum(off**2)), TINY)
    return index + 1.0 / count > _ALIKE / math.sqrt(2.0 * count * _NEIGHBOURS / 1.5)


def _errors(observed: Observed, posterior: Posterior) -> tuple[Array, IntArray]:
    """Return errors (n,2) px of all points, and which lie near their places."""
    seen = observed.observations
    shake = shake_at(seen.tau, posterior.shake)
    errors: Array = linearized(seen.packed, len(seen), posterior.state, shake).errors
    circle = (GLOBAL_SHUTTER_SCALE * observed.assumed.focal_length) ** 2
    return errors, np.flatnonzero(np.sum(errors**2, axis=1) < circle)  # NaN is not


class _Shifted(NamedTuple):
    """The frames, fitted with one part that is shifted."""

    way: Array  # (3,) m
    costs: Array  # (2,m) px^2 of landmarks that lie where the map has them, or are shifted
    apart: list[Array]  # (2,n) likewise of the points of each frame
    squares: float  # px^2
    freedom: float


class _Split(NamedTuple):
    """Two groups of landmarks."""

    gain: float  # logarithm of their evidence, against one group
    part: BoolArray  # (m,)
    found: BoolArray  # (m,) in either group
    way: Array  # (3,) m


class _Frames(NamedTuple):
    """Frames, and the landmarks that they show."""

    looks: Sequence[Look]
    which: list[IntArray]  # landmarks (n,) of each frame
    points: Array  # (m,3) of the landmarks


def moved_part(looks: Sequence[Look], map_deviation: float, sides: bool = True) -> MovedPart | None:
    """Return the part of the map that lies elsewhere than the rest; None if there is none.

    Args:
        looks: of one frame, or of several.
        map_deviation: m, as declared.
        sides: whether also parts are looked for that have no point which is left out.
    """
    frames = _frames(looks)
    points = frames.points
    kept = [look.inliers for look in looks]
    nothing = np.zeros(len(points), np.bool_)
    alone = _fitted(frames, nothing, kept, declared=False)
    first = _evidence(frames, alone, kept)
    fitting = nothing.copy()
    for own, look in zip(frames.which, looks, strict=True):
        fitting[own[look.inliers]] = True
    starts = [] if fitting.all() else [~fitting]
    if sides:
        starts += _sides(frames, fitting)
    splits = [split for start in starts if (split := _settled(frames, start))]
    best = max(splits, key=lambda split: split.gain, default=None)
    if best is None or best.gain < first + _LEAST_CHANCE:
        return None
    if float(np.linalg.norm(best.way)) <= _DECLARED * map_deviation:
        return None
    part, rest, way = best.part & best.found, ~best.part & best.found, best.way
    if np.count_nonzero(part) > np.count_nonzero(rest):
        part, rest, way = rest, part, -way
    return MovedPart(points[part], points[rest], way)


def _frames(looks: Sequence[Look]) -> _Frames:
    """Number the landmarks of frames."""
    if len(looks) == 1:
        return _Frames(looks, [np.arange(len(looks[0].points))], looks[0].points)
    points, which = np.unique(
        np.concatenate([look.points for look in looks]), axis=0, return_inverse=True
    )
    ends = np.cumsum([len(look.points) for look in looks])[:-1]
    return _Frames(looks, np.split(which.ravel(), ends), points)


def _fitted(
    frames: _Frames, part: BoolArray, kept: Sequence[BoolArray], declared: bool = True
) -> _Shifted:
    """Fit motions, smooth errors and the shift of a part to the points that are kept.

    ``declared``: smooth errors are as large as is declared, and not as without a part.
    """
    information, target, squares, freedom = np.zeros((3, 3)), np.zeros(3), 0.0, 0.0
    solved = []
    for look, own, these in zip(frames.looks, frames.which, kept, strict=True):
        flat, inverse, taken = _beside(look, these, declared)
        shifted = (look.by_place * part[own][:, None, None])[these].reshape(len(flat), 3)
        errors = look.errors[these].ravel()
        by_shift, along = flat.T @ shifted, flat.T @ errors
        beside, back = inverse @ by_shift, inverse @ along
        information += shifted.T @ shifted - by_shift.T @ beside
        target += shifted.T @ errors - by_shift.T @ back
        squares += float(errors @ errors - along @ back)
        freedom += len(errors) - taken
        solved.append((beside, back))
    information += max(_RIDGE * float(np.trace(information)), TINY) * np.eye(3)
    way = np.asarray(np.linalg.solve(information, target), np.float64)
    costs, apart = np.zeros((2, len(part))), []
    for look, own, (beside, back) in zip(frames.looks, frames.which, solved, strict=True):
        left = look.errors - look.columns @ (back - beside @ way)
        each = np.stack([
            np.sum(left**2, axis=1), np.sum((left - look.by_place @ way) ** 2, axis=1)
        ])  # fmt: skip
        np.add.at(costs.T, own, each.T)
        apart.append(each)
    return _Shifted(way, costs, apart, squares - float(target @ way), freedom)


def _beside(look: Look, kept: BoolArray, declared: bool = True) -> tuple[Array, Array, float]:
    """Return columns (2n,p) of motion and smooth error, their covariance, and what they take up."""
    flat = look.columns[kept].reshape(-1, len(look.prior))
    normal, prior = flat.T @ flat, look.prior.copy()
    smooth = np.arange(PARAMETERS, len(prior))
    prior[smooth, smooth] /= max(look.sizes[declared], LEAST_NOISE) ** 2
    weight = normal + prior
    weight[np.diag_indices(len(weight))] *= 1.0 + _RIDGE
    inverse = np.asarray(np.linalg.inv(weight), np.float64)
    return flat, inverse, float(np.sum(inverse * normal))


def _evidence(frames: _Frames, fit: _Shifted, kept: Sequence[BoolArray]) -> float:
    """Return the log evidence of the points that are kept, the others anywhere in an image."""
    variance = max(fit.squares / max(fit.freedom, 1.0), LEAST_NOISE**2)
    each, total = math.log(2.0 * math.pi * variance) + 1.0, 0.0
    for look, these in zip(frames.looks, kept, strict=True):
        inside = np.count_nonzero(these)
        total -= inside * each + (len(these) - inside) * math.log(look.area)
    return total


def _settled(frames: _Frames, part: BoolArray) -> _Split | None:
    """Let each landmark join the group that it fits, until none changes; None if one vanishes."""
    kept = [np.ones(len(look.points), np.bool_) for look in frames.looks]
    for _ in range(_ROUNDS):
        fit = _fitted(frames, part, kept)
        before, part = part, fit.costs[1] < fit.costs[0]
        near = [
            np.where(part[own], each[1], each[0]) < look.reach**2
            for look, own, each in zip(frames.looks, frames.which, fit.apart, strict=True)
        ]
        settled = np.array_equal(part, before) and all(map(np.array_equal, near, kept))
        kept = near
        if settled or np.count_nonzero(part) <= _OF_SHIFT:
            break
    found = np.zeros(len(part), np.bool_)
    for own, these in zip(frames.which, kept, strict=True):
        found[own[these]] = True
    count, size = int(np.count_nonzero(found)), int(np.count_nonzero(part & found))
    if not _OF_SHIFT < size < count:
        return None
    fit = _fitted(frames, part, kept)
    rows = 2.0 * sum(np.count_nonzero(these) for these in kept)
    labels = math.lgamma(count + 1) - math.lgamma(size + 1) - math.lgamma(count - size + 1)
    gain = _evidence(frames, fit, kept) - labels - math.log(count) - 1.5 * math.log(rows)
    return _Split(gain, part, found, fit.way)


def _sides(frames: _Frames, fitting: BoolArray) -> list[BoolArray]:
    """Return the sides of planes through the map whose shifts explain most."""
    away = frames.points - frames.points[fitting].mean(axis=0)
    values, axes = np.linalg.eigh(away[fitting].T @ away[fitting])
    places = away @ axes / np.sqrt(np.maximum(values, 1e-4 * values[-1])) @ _ALONG.T
    edges = np.quantile(places[fitting], _QUANTILES, axis=0)
    sides = np.concatenate([(places > edge).T for edge in edges]).astype(np.float64)
    information, targets = np.zeros((len(sides), 3, 3)), np.zeros((len(sides), 3))
    for look, own in zip(frames.looks, frames.which, strict=True):
        these = look.inliers
        flat, inverse, _ = _beside(look, these)
        by_place, errors, of = look.by_place[these], look.errors[these], sides[:, own[these]]
        count, rows = len(by_place), np.swapaxes(by_place, 1, 2)
        by_shift = (of @ (rows @ look.columns[these]).reshape(count, -1)).reshape(len(of), 3, -1)
        information += (of @ (rows @ by_place).reshape(count, 9)).reshape(-1, 3, 3)
        information -= by_shift @ inverse @ np.swapaxes(by_shift, 1, 2)
        targets += of @ np.einsum("nra,nr->na", by_place, errors)
        targets -= by_shift @ (inverse @ (flat.T @ errors.ravel()))
    information += max(_RIDGE * float(information[0].trace()), TINY) * np.eye(3)
    gains = np.einsum("sa,sa->s", targets, np.linalg.solve(information, targets[..., None])[..., 0])
    return [sides[k] > 0.5 for k in np.argsort(-gains)[:_STARTS]]
