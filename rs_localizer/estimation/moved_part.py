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
from collections.abc import Generator, Sequence
from typing import Any, NamedTuple, TypeVar

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.shake import shake_at
from rs_localizer.core.state import MOTION_PARAMETERS, MOVE, PARAMETERS, rotation_of
from rs_localizer.estimation.hypotheses import Posterior
from rs_localizer.estimation.linear_fit import ORDINARY, known_at, smooth_columns
from rs_localizer.estimation.points import Observed
from rs_localizer.estimation.prior import RIDGE, PriorTerms
from rs_localizer.estimation.projection import linearized
from rs_localizer.estimation.robust import LEAST_NOISE, TINY, WIDEST_GATE
from rs_localizer.estimation.search import GLOBAL_SHUTTER_SCALE

# Frames that are compared, and after how many others at most: that takes as long as three frames.
# Of a long track it is spread over ten.
_LOOKS, _RARELY = 4, 120
# Landmarks that are enough.
_COMPARED = 200
# Explanations that chance makes in one frame of 1,000 (Desolneux, Moisan and Morel, IJCV 2000: the
# number of false alarms).
LEAST_CHANCE = -math.log(1e-3)
# Declared deviations of two landmarks within which they are no two parts.
_DECLARED = 3.0 * math.sqrt(2.0)
# Parts from which the search starts, beyond these quantiles along the axes and their diagonals.
_QUANTILES = (0.2, 0.35, 0.5, 0.65, 0.8)
_ALONG = np.array([
    (x, y, z) for x in (-1.0, 0.0, 1.0) for y in (-1.0, 0.0, 1.0) for z in (-1.0, 0.0, 1.0)
])[14:]  # fmt: skip
# So many landmarks have a shift, whatever they are.
_OF_SHIFT = 2
# Rounds of labels and fits: they mostly agree after four.
_ROUNDS = 4
# Logarithms of both focal lengths, which may be another camera's: no part moves as that shows it.
_OTHER_LENGTH, _BESIDE = 0.5, PARAMETERS + 2
_KEY_WEIGHTS = np.sqrt([2.0, 3.0, 5.0])


_Found = TypeVar("_Found")
_Search = Generator[None, None, _Found | None]  # that goes on when it is asked, and ends so


class Look(NamedTuple):
    """Errors of a frame's landmarks, linearized at its motion."""

    points: Array  # (n,3) m, as the map has them
    rows: Array  # (n,2,4) px: errors, and their derivatives by the places in the map (px per m)
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


def keys_of(points: Array) -> Array:
    """Return a number (n,) of each place (n,3), which no other place shares."""
    keys: Array = (points * _KEY_WEIGHTS).sum(axis=1)
    return keys


def look_at(observed: Observed, posterior: Posterior, terms: PriorTerms) -> Look:
    """Return what a frame leaves of its inliers, and of points near them.

    Args:
        terms: what is known of its motion but for poses of other frames.
    """
    seen, variance = observed.observations, posterior.noise**2
    lines = linearized(seen.packed, len(seen), posterior.state, shake_at(seen.tau, posterior.shake))
    circle = GLOBAL_SHUTTER_SCALE * observed.assumed.focal_length
    near = np.sum(lines.errors**2, axis=1) < circle**2  # NaN is not
    by_motion = lines.by_motion[near]
    bend = posterior.bend[near] if posterior.bend.shape[1] else np.zeros((len(by_motion), 0))
    smooth = smooth_columns(by_motion, lines.image[near], bend)
    of_lens = seen.by_ray[near] * (lines.image[near, None, :] * _OTHER_LENGTH)
    columns = np.concatenate([by_motion[:, :, :PARAMETERS], of_lens, smooth], axis=2)
    prior, motion = variance * np.eye(columns.shape[2]), slice(0, PARAMETERS)
    prior[motion, motion] = variance * known_at(terms, posterior.state).form[motion, motion]
    by_place = -by_motion[:, :, MOVE] @ rotation_of(posterior.state)
    sizes = posterior.shared, math.hypot(posterior.declared, ORDINARY)
    return Look(
        observed.points[observed.usable.indices[near]],
        np.concatenate([-lines.errors[near, :, None], by_place], axis=2), columns, prior, sizes,
        posterior.inliers[near], WIDEST_GATE * posterior.gate,
        float(math.prod(observed.exposure.cameras[0].size)),
    )  # fmt: skip


class MovedParts:
    """Looks, now and then, whether the frames of a track show a part of the map elsewhere.

    Args:
        map_deviation: m, as declared.
    """

    _search: _Search[MovedPart]

    def __init__(self, map_deviation: float) -> None:
        self._map_deviation = map_deviation
        self.reset()

    def __getstate__(self) -> dict[str, Any]:
        """Return all but the search, which cannot be copied: a copy begins it anew."""
        return {name: value for name, value in vars(self).items() if name != "_search"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._search = moved_part(self._looks, self._map_deviation)

    def reset(self) -> None:
        """Forget all frames."""
        self.part: MovedPart | None = None
        """The part that was last found; None: the frames that were last compared show none."""
        self.named: MovedPart | None = None
        """The part that frames show together: one alone may have a cause of its own."""
        self._apart = np.zeros((0, 3)), np.zeros((MOTION_PARAMETERS,) * 2)
        self._looks: list[Look] = []
        self._count, self._next = 0, 1

    def add(
        self, observed: Observed, posterior: Posterior, terms: PriorTerms, group: BoolArray,
        moment: Array,
    ) -> Array:  # fmt: skip
        """Take an accepted frame; return the moment of its left-out points, also if seen before.

        A part is one thing, also where too few of its landmarks are in view to have a motion.

        Args:
            terms: what is known of its motion but for poses of other frames.
            group: (n,) of its points those with a motion of their own; none: no others are found.
            moment: (12,12) second moment of that motion about the frame's, as the result is.
        """
        points, inliers = observed.points[observed.usable.indices], posterior.inliers
        self._look(observed, posterior, terms, points)
        if not (group.any() or len(self._apart[0])):
            return moment
        axes = np.kron(np.eye(4), rotation_of(posterior.state))  # camera_from_map
        if group.any():
            self._apart = points[group], axes.T @ moment @ axes
        there, apart = self._apart
        return _mostly_out(there, points, inliers) * (axes @ apart @ axes.T)

    def _look(
        self, observed: Observed, posterior: Posterior, terms: PriorTerms, points: Array
    ) -> None:
        """Compare the frame, of points (n,3), with others, if it is time."""
        part, self._count = self.part, self._count + 1
        stays = part is not None and _mostly_out(part.points, points, posterior.inliers)
        if not self._looks and self._count < self._next:
            return
        if len(self._looks) < _LOOKS:
            self._looks.append(look_at(observed, posterior, terms))
            if len(self._looks) not in (1, _LOOKS):
                return
            self._search = moved_part(self._looks, self._map_deviation)
        together = len(self._looks) == _LOOKS
        try:
            while True:
                next(self._search)
                if together and self._count > _RARELY:  # a step a frame
                    return
        except StopIteration as end:
            found = end.value
        if found is not None or (together and not stays):
            self.part = found
        if together:
            self.named = found
            self._later()

    def discard(self) -> None:
        """Take nothing that was found for a part: the shutter is another one, or may be."""
        self.part = self.named = None
        self._later()

    def _later(self) -> None:
        self._looks.clear()
        self._next = self._count + min(self._count, _RARELY)


def _mostly_out(landmarks: Array, points: Array, inliers: BoolArray) -> bool:
    """Return whether of some landmarks more are left out than are inliers of points (n,3)."""
    here = np.isin(keys_of(points), keys_of(landmarks))
    return bool(2 * np.count_nonzero(here & inliers) < np.count_nonzero(here))


class _Beside(NamedTuple):
    """The part of the kept points that motions and smooth errors take up."""

    columns: Array  # (f,2m,p)
    inverses: Array  # (f,p,p), of their products
    freedom: float  # that they leave


class _Frames(NamedTuple):
    """Looks of f frames at the same m landmarks; rows of those that a frame does not show are 0."""

    points: Array  # (m,3)
    rows: Array  # (f,m,2,4)
    columns: Array  # (f,m,2,p)
    priors: Array  # (2,f,p,p) with smooth errors as they were found, and as is declared
    shown: BoolArray  # (f,m)
    inliers: BoolArray  # (f,m)
    reach: Array  # (f,1) px
    area: Array  # (f,1) px

    @classmethod
    def of(cls, looks: Sequence[Look]) -> _Frames:
        """Put the landmarks of looks in order: of many, those that most frames show."""
        points = np.concatenate([look.points for look in looks])
        _, first, which, seen = np.unique(
            keys_of(points), return_index=True, return_inverse=True, return_counts=True
        )
        some = np.argsort(-seen, kind="stable")[:_COMPARED]
        place = np.full(len(seen), -1)
        place[some] = np.arange(len(some))
        sizes = len(looks), len(some)
        most = max(look.columns.shape[2] for look in looks)
        rows, columns = np.zeros((*sizes, 2, 4)), np.zeros((*sizes, 2, most))
        shown, inliers = np.zeros(sizes, np.bool_), np.zeros(sizes, np.bool_)
        priors = np.tile(np.eye(most), (2, len(looks), 1, 1))
        ends = np.cumsum([len(look.points) for look in looks])[:-1]
        for k, (look, own) in enumerate(zip(looks, np.split(place[which], ends), strict=True)):
            here, own, taken = own >= 0, own[own >= 0], len(look.prior)
            rows[k, own], columns[k, own, :, :taken] = look.rows[here], look.columns[here]
            shown[k, own], inliers[k, own] = True, look.inliers[here]
            for prior, size in zip(priors[:, k], look.sizes, strict=True):
                scale = np.ones(taken)
                scale[_BESIDE:] = max(size, LEAST_NOISE)
                prior[:taken, :taken] = look.prior / np.outer(scale, scale)
        reach, area = np.array([(look.reach, look.area) for look in looks]).T[:, :, None]
        return cls(points[first[some]], rows, columns, priors, shown, inliers, reach, area)


class _Shifted(NamedTuple):
    """The frames, fitted with one part that is shifted."""

    way: Array  # (3,) m
    each: Array  # (2,f,m) px^2, of landmarks that lie where the map has them, or are shifted
    evidence: float  # logarithm, of the points that are kept; the others are anywhere in an image


class _Split(NamedTuple):
    """Two groups of landmarks."""

    gain: float  # logarithm of their evidence, against one group
    part: BoolArray  # (m,)
    rest: BoolArray  # (m,)
    way: Array  # (3,) m


def moved_part(looks: Sequence[Look], map_deviation: float) -> _Search[MovedPart]:
    """Search, step by step, the part of the map that lies elsewhere than the rest.

    Args:
        looks: of one frame, or of several.
        map_deviation: m, as declared.

    Returns:
        the part, in the end; None if there is none.
    """
    frames = _Frames.of(looks)
    yield
    fitting: BoolArray = np.any(frames.inliers, axis=0)
    nobody = np.zeros(len(fitting), np.bool_)
    beside = _beside(frames, frames.inliers, declared=False)
    alone = _fitted(frames, nobody, frames.inliers, beside)
    yield
    starts = [_side(frames, fitting, beside), ~fitting][: 1 if fitting.all() else 2]
    yield
    beside, splits = _beside(frames, frames.shown, declared=True), []
    for start in starts:
        split = yield from _settled(frames, start, beside)
        splits += [split] if split is not None else []
    best = max(splits, key=lambda split: split.gain, default=None)
    if best is None or best.gain < alone.evidence + LEAST_CHANCE:
        return None
    if float(np.linalg.norm(best.way)) <= _DECLARED * map_deviation:
        return None
    _, part, rest, way = best
    if np.count_nonzero(part) > np.count_nonzero(rest):
        part, rest, way = rest, part, -way
    return MovedPart(frames.points[part], frames.points[rest], way)


def _beside(frames: _Frames, kept: BoolArray, declared: bool) -> _Beside:
    """Return what motions and smooth errors take up of the points (f,m) that are kept.

    ``declared``: smooth errors are as large as is declared, and not as without a part.
    """
    flat = (frames.columns * kept[:, :, None, None]).reshape(len(kept), -1, frames.columns.shape[3])
    normal = np.swapaxes(flat, 1, 2) @ flat
    weight = normal + frames.priors[int(declared)]
    places = np.arange(weight.shape[1])
    weight[:, places, places] *= 1.0 + RIDGE
    inverse = np.asarray(np.linalg.inv(weight), np.float64)
    freedom = 2.0 * np.count_nonzero(kept) - float(np.sum(inverse * normal))
    return _Beside(flat, inverse, freedom)


def _fitted(frames: _Frames, part: BoolArray, kept: BoolArray, beside: _Beside) -> _Shifted:
    """Fit motions, smooth errors and the shift of a part to the points (f,m) that are kept."""
    flat, inverse, freedom = beside
    own = frames.rows * kept[:, :, None, None]
    own[..., 1:] *= part[:, None, None]
    own = own.reshape(len(own), -1, 4)
    along = np.swapaxes(flat, 1, 2) @ own
    back = inverse @ along
    square = np.sum(np.swapaxes(own, 1, 2) @ own - np.swapaxes(along, 1, 2) @ back, axis=0)
    information, target = square[1:, 1:].copy(), square[1:, 0]
    information += max(RIDGE * float(np.trace(information)), TINY) * np.eye(3)
    way = np.asarray(np.linalg.solve(information, target), np.float64)
    found = back @ np.array([1.0, *-way])
    left = frames.rows[..., 0] - (frames.columns @ found[:, None, :, None])[..., 0]
    each = np.stack([left, left - frames.rows[..., 1:] @ way])
    squares = float(square[0, 0] - target @ way)
    variance = max(squares / max(freedom, 1.0), LEAST_NOISE**2)
    out = float(np.sum((frames.shown & ~kept) * np.log(frames.area)))
    evidence = -np.count_nonzero(kept) * (math.log(2.0 * math.pi * variance) + 1.0) - out
    return _Shifted(way, np.sum(each**2, axis=3) * frames.shown, evidence)


def _settled(frames: _Frames, part: BoolArray, beside: _Beside) -> _Search[_Split]:
    """Let each landmark join the group that it fits, until none changes; None if one vanishes.

    Motions and smooth errors are, at first, those ``beside`` all landmarks that are shown.
    """
    kept, fit = frames.shown, _fitted(frames, part, frames.shown, beside)
    for _ in range(_ROUNDS):
        before, costs = (part, kept), fit.each.sum(axis=1)
        part = costs[1] < costs[0]
        kept = frames.shown & (np.where(part, fit.each[1], fit.each[0]) < frames.reach**2)
        if np.count_nonzero(part) <= _OF_SHIFT:
            return None
        if np.array_equal(part, before[0]) and np.array_equal(kept, before[1]):
            break
        fit = _fitted(frames, part, kept, _beside(frames, kept, declared=True))
        yield
    found: BoolArray = np.any(kept, axis=0)
    count, size = int(np.count_nonzero(found)), int(np.count_nonzero(part & found))
    if not _OF_SHIFT < size < count:
        return None
    choices = math.log(math.comb(count, size) * count)
    choices += 1.5 * math.log(2.0 * np.count_nonzero(kept))
    return _Split(fit.evidence - choices, part & found, ~part & found, fit.way)


def _side(frames: _Frames, fitting: BoolArray, beside: _Beside) -> BoolArray:
    """Return the side of a plane through the map whose shift explains most."""
    columns, inverses, _ = beside
    away = frames.points - frames.points[fitting].mean(axis=0)
    values, axes = np.linalg.eigh(away[fitting].T @ away[fitting])
    places = away @ axes / np.sqrt(np.maximum(values, 1e-4 * values[-1])) @ _ALONG.T
    edges = np.quantile(places[fitting], _QUANTILES, axis=0)
    sides = np.concatenate([(places > edge).T for edge in edges]).astype(np.float64)
    own = frames.rows * frames.inliers[:, :, None, None]
    squares = np.zeros((len(sides), 4, 4))  # of a shift of all, and of the errors
    for rows, flat, inverse in zip(own, columns, inverses, strict=True):
        turned, count = np.swapaxes(rows, 1, 2), len(rows)
        along = (turned @ flat.reshape(count, 2, -1)).reshape(count, -1)
        by_side = (sides @ along).reshape(len(sides), 4, -1)
        by_side[:, 0] = along.reshape(count, 4, -1)[:, 0].sum(axis=0)
        squares += (sides @ (turned @ rows).reshape(count, -1)).reshape(-1, 4, 4)
        squares -= by_side @ inverse @ np.swapaxes(by_side, 1, 2)
    information, targets = squares[:, 1:, 1:], squares[:, 1:, 0]
    information += max(RIDGE * float(information[0].trace()), TINY) * np.eye(3)
    shifts = np.linalg.solve(information, targets[..., None])[..., 0]
    found: BoolArray = sides[np.argmax(np.sum(targets * shifts, axis=1))] > 0.5
    return found
