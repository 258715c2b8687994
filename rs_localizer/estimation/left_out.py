# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Points that a motion leaves out: mismatches, or witnesses against it.

Mismatches lie anywhere. Where the points that are left out hang together, three explanations are
weighed: another body before a camera whose world the motion shows; the same two groups the other
way round; and one motion of all of them before a camera with another matrix than K.
"""

from __future__ import annotations

import math
from itertools import product
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.lens import centre_of, off_centre
from rs_localizer.core.reasons import Reason
from rs_localizer.core.state import (
    MOTION_PARAMETERS,
    MOVE,
    PARAMETERS,
    POSE,
    TURN,
    step_between,
)
from rs_localizer.core.types import Failure, altered
from rs_localizer.estimation.acceptance import speeding
from rs_localizer.estimation.calibration import MANY, promised
from rs_localizer.estimation.hypotheses import Posterior
from rs_localizer.estimation.linear_fit import known_at
from rs_localizer.estimation.moved_part import LEAST_CHANCE
from rs_localizer.estimation.points import Observations, Observed
from rs_localizer.estimation.projection import linearized
from rs_localizer.estimation.robust import (
    EXPECTED_NOISE,
    LEAST_NOISE,
    WIDEST_GATE,
    apply_step,
    best_motion,
    solve_positive,
)
from rs_localizer.estimation.search import GLOBAL_SHUTTER_SCALE, MotionSearch

# So many points have a motion, or a pose, whatever they are; the corners of one marker may be
# misplaced in the map.
SAMPLE, _OF_POSE, _MARKER = 6, 3, 4
# Odds for a motion to be the world's, of two motions, from which it is published. Second bodies of
# 40 to 45 % of 100 points leave 4.8 to 60, halves of a map that were moved mostly 1 (paired set).
_LEAST_ODDS = 4.0
# Beyond so many gates a point is another's.
_ELSEWHERE = 2.0
# Gates before a declared map, of two motions, differ by less, and a widened one from both by more.
_WIDE = 1.2
# A camera of a rig that has all but this part of a group.
_ELSE = 0.1
# Focal lengths, in parts of K's, from which another matrix is looked for: between two of them a
# rough pose finds its points by another distance.
_LENGTHS = (1.0, 0.7, 0.5, 1.4, 2.0)
# Focal length and principal point, in focal lengths: K's, and what those of another image (binned,
# a region of it) deviate by.
_OF_K, _DEVIATIONS = np.array([1.0, 0.0, 0.0]), np.array([1.0, 0.3, 0.3])
# The same of an image of another size, about one of the lengths: the principal point moves along.
_OF_SIZE = np.array([0.3, 0.03, 0.03])
_LENS = len(_OF_K)
# Gain in the logarithm of the evidence for each point, from which another matrix is believed: all
# points are seen through it. Wrong ones gain 1.5 and more (72 frames); before a curled sheet, whose
# errors many points share, another matrix gains 0.6.
_EACH = 1.0
# Smooth errors, in parts of what is declared, from which another matrix is looked for where no
# points are left out: boards of paper have up to 10 (12 videos), a K of another size before one
# wall 8 to 36.
BENT, _BENT_OFF_CENTRE = 10.0, 1.0
# Deviation of a K of this very image, which errors that are smooth over it stand for. Both are as
# probable where K is off by 0.048: the principal point of a phone is by 0.012, and of a lens of
# which a third is missing by 0.03 (paired set).
_USUAL = 0.01
# The other orders in which the four corners of a marker may be given.
_ORDERS = [
    tuple((first + step * k) % 4 for k in range(4))
    for step in (1, -1)
    for first in range(4)
    if (first, step) != (0, 1)
]
_CORNERS = ("upper left", "upper right", "lower right", "lower left")
# Four points in a row are a marker's corners if they are out of a parallelogram by less than this
# share of a side; of them another order explains so many, where ours does less than a half.
_FLAT, _FIT = 0.01, 0.7
# Gates fall by this part from step to step, to the last one, with its steps. With 0.7 two of 72
# wrong matrices were lost on the way.
_NARROWER, _LAST_STEPS = 0.8, 6


class LeftOut(NamedTuple):
    """Oddity of the points that are left out."""

    failure: Failure | None = None
    notice: str = ""
    other: Array = np.zeros((MOTION_PARAMETERS,) * 2)
    """Second moment of the motion of points that are left out, about the frame's."""
    group: BoolArray = np.zeros(0, np.bool_)
    """(n,) these points; empty: none."""
    surely: bool = True
    """Whether the frame's motion is the world's, and not the group's, at odds of a thousand."""


class _Group(NamedTuple):
    """Points that one motion explains."""

    chosen: BoolArray  # (n,)
    state: Array  # (24,)
    squared_errors: Array  # (n,) px^2
    covariance: Array = np.zeros((PARAMETERS,) * 2)  # of the motion


def left_out(
    search: MotionSearch, observed: Observed, posterior: Posterior, threshold: float, known: bool
) -> LeftOut:
    """Judge the points that a motion leaves out: what contradicts the motion.

    Args:
        posterior: of an accepted motion.
        threshold: px, of inliers.
        known: the motion was predicted, so that the camera's matrix is right, and a group as large
            is another thing.
    """
    inliers = posterior.inliers
    rest = ~(posterior.squared_errors < (_ELSEWHERE * WIDEST_GATE * posterior.gate) ** 2)
    found, left = int(np.count_nonzero(inliers)), int(np.count_nonzero(rest))
    wide = posterior.gate > _WIDE * threshold  # for noise, or for what another matrix explains
    failure = None if known else by_chance(observed, posterior, threshold)
    if not known and (failure is not None or wide or 2 * found < len(inliers)):
        in_order = reordered(search, observed, threshold)
        failure = failure if in_order is None else in_order
    if failure is not None:
        return LeftOut(failure)
    # A principal point alone may point to another image.
    most = _BENT_OFF_CENTRE if off_centre(observed.exposure.cameras[0]) else BENT
    bent = posterior.model_error > most * promised(posterior)
    bent |= wide or posterior.noise > EXPECTED_NOISE * threshold
    second = _own_motion(search, observed, rest, threshold) if left > SAMPLE else None
    # Before K errors hang together: some of them over the image, or those of a second group.
    alone = observed.exposure.alone
    if not known and alone and (bent or second is not None):
        failure = _of_another_lens(search, observed, posterior, second, threshold)
        if failure is not None:
            return LeftOut(failure)
    if second is None:
        return LeftOut(notice=_rough(observed, posterior) if wide else "")
    if apart := _cameras_apart(observed, inliers, second, threshold):
        return LeftOut(Failure(Reason.MODEL_ERROR, apart))
    size = int(np.count_nonzero(second.chosen))
    step = step_between(posterior.state, second.state)
    turn, move = float(np.linalg.norm(step[TURN])), float(np.linalg.norm(step[MOVE]))
    text = (
        f"{found} points fit one motion, and {size} of the {left} left out have a pose of "
        f"their own, {math.degrees(turn):.1f} deg and {move:.2g} m away"
    )
    faster = max(posterior.speeding - speeding(observed, second.state), 0.0)
    odds = _odds(found, size, faster)
    if odds > (1.0 if known else _LEAST_ODDS):
        # A part is one thing, however many of its landmarks a frame shows: either may have moved.
        moment = np.outer(step, step) + second.covariance
        other = size / (found + size) * moment[:MOTION_PARAMETERS, :MOTION_PARAMETERS]
        text = f"{text}: have these points been moved, or do they move?"
        surely = math.log(odds) > LEAST_CHANCE
        return LeftOut(None, text, other, second.chosen, surely)
    return LeftOut(Failure(
        Reason.MODEL_ERROR,
        f"{text}: which of both is the camera's? A part of the map was moved, or the calibration "
        "is grossly wrong",
    ))  # fmt: skip


def _cameras_apart(observed: Observed, inliers: BoolArray, second: _Group, threshold: float) -> str:
    """Name the camera of a rig that has a motion of its own; '' if none has.

    A body before it moves otherwise than most of its points. Where all of them do, no image tells
    which camera is where it is said to be, and no frame before this one does.
    """
    exposure = observed.exposure
    if exposure.alone:
        return ""
    of = np.array([side.place for side in exposure.sides])[observed.observations.camera]
    place = int(np.bincount(of[second.chosen]).argmax())
    own, fitting = of == place, second.squared_errors < (WIDEST_GATE * threshold) ** 2
    is_mixed = np.mean(own[second.chosen]) < 1.0 - _ELSE
    if is_mixed or np.count_nonzero(fitting & own) <= np.count_nonzero(inliers & own):
        return ""
    return (
        f"the points of {exposure.names[place]} have a motion of their own: its extrinsics, its "
        "clock or its K are others (rs_localizer calibrate --rig)"
    )


def reordered(search: MotionSearch, observed: Observed, threshold: float) -> Failure | None:
    """Return the failure of a frame of markers that fit if their corners come in another order.

    ``threshold`` is that of inliers, px.
    """
    seen, usable = observed.observations, observed.usable.indices
    for order in _ORDERS if _markers(observed) else ():
        by = np.arange(len(usable)).reshape(-1, 4)[:, order].ravel()
        part = altered(observed, ranking=observed.ranking[:0], observations=Observations.of(
            seen.points, seen.rays[by], seen.tau[by], seen.by_ray[by], seen.mounts, seen.camera[by]
        ))  # fmt: skip
        fit = search.from_rough(part, search.rough(part))
        fitting = part.observations.within(fit.state, WIDEST_GATE * threshold)
        if fit.found and np.mean(fitting) > _FIT:
            names = ", ".join(_CORNERS[order.index(k)] for k in range(4))
            return Failure(
                Reason.CALIBRATION,
                "the points fit if corners of markers come in another order: where "
                f"{', '.join(_CORNERS)} belong, {names} stand",
            )
    return None


def _markers(observed: Observed) -> int:
    """Return how many markers a frame shows, if nothing else: of each the corners, in a row."""
    usable = observed.usable.indices
    if len(usable) % 4 or len(usable) < len(observed.points):
        return 0
    corners = observed.points.reshape(-1, 4, 3)
    skew = corners[:, 0] - corners[:, 1] + corners[:, 2] - corners[:, 3]
    side = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    return len(corners) if np.all(np.linalg.norm(skew, axis=1) < _FLAT * side) else 0


def _rough(observed: Observed, posterior: Posterior) -> str:
    """Describe the noise for which the gate was widened."""
    depth = observed.observations.median_depth(posterior.state, posterior.inliers)
    deviation = posterior.noise * depth / observed.assumed.focal_length
    return (
        f"errors of {posterior.noise:.2g} px (one sigma) are more than inlier_threshold allows: "
        f"set map_deviation to {deviation:.2g} m, if points of the map are that far off"
    )


def _odds(size: int, other: int, faster: float) -> float:
    """Return the odds that a group of points is the world's and the other one a body's.

    Of a body points are with an unknown chance below one half; the world has the motion that is
    expected of the camera, by squared velocities that differ by ``faster``.
    """
    # Of the chance's posterior, a beta distribution, near a normal one from some ten points on.
    below = 0.5 * math.erfc((other - size) / math.sqrt(2.0 * (size + other + 1.0)))
    return below / max(1.0 - below, 1e-300) * math.exp(-0.5 * faster)


def _own_motion(
    search: MotionSearch, observed: Observed, rest: BoolArray, threshold: float
) -> _Group | None:
    """Return the motion that more left-out points share than chance makes, or None."""
    observations, gate = observed.observations, WIDEST_GATE * threshold
    left, area = int(np.count_nonzero(rest)), _area(observed)
    some = np.flatnonzero(rest)[:: 1 + left // MANY].copy()
    part = altered(observed, observations=observations.only(some), ranking=observed.ranking[:0])
    start, circle = search.rough(part), GLOBAL_SHUTTER_SCALE * observed.assumed.focal_length
    near = int(np.count_nonzero(part.observations.within(start.state, circle)))
    if _surprise(len(some), near, _OF_POSE, math.pi * circle**2 / area) < LEAST_CHANCE:
        return None
    own = search.from_rough(part, start)
    group = rest & observations.within(own.state, gate)
    size = int(np.count_nonzero(group))
    if _surprise(left, size, SAMPLE, math.pi * gate**2 / area) < LEAST_CHANCE:
        return None
    chosen = observations.only(np.flatnonzero(group))
    best = best_motion(chosen.packed, len(chosen), own.state, observed.terms, threshold)
    if not np.isfinite(best.covariance).all():  # a motion that they do not determine is none
        return None
    errors = observations.squared_errors(best.state)
    return _Group(group, best.state, errors, best.covariance)


def _area(observed: Observed) -> float:
    """Return the pixels of the smallest image."""
    return float(min(math.prod(camera.size) for camera in observed.exposure.cameras))


def _of_another_lens(
    search: MotionSearch, observed: Observed, posterior: Posterior, second: _Group | None,
    threshold: float,
) -> Failure | None:  # fmt: skip
    """Return the failure of a frame that another matrix explains better than two motions."""
    area, count = _area(observed), len(observed.observations)
    resized = off_centre(observed.exposure.cameras[0])
    found = [
        (_evidence((each[0],), PARAMETERS + _LENS, count, area), *each)
        for of_size in ((False, True) if resized else (False,))
        if (each := _another_lens(search, observed, threshold, of_size)) is not None
    ]
    if not found:
        return None
    explained, group, numbers = max(found, key=lambda each: each[0])
    usual, other = (numbers - _OF_K) / _USUAL, (numbers - _OF_K) / _DEVIATIONS
    if 0.5 * (usual @ usual - other @ other) < np.log(_DEVIATIONS / _USUAL).sum():
        return None
    first = _Group(posterior.inliers, posterior.state, posterior.squared_errors)
    parts = [(first,)] if second is None else [(first,), (first, second)]
    evidence = max(_evidence(groups, PARAMETERS * len(groups), count, area) for groups in parts)
    margin = max(0.0 if resized else _EACH * count, LEAST_CHANCE)
    moved = _evidence_without_a_marker(observed, posterior, threshold) + LEAST_CHANCE
    if explained < max(evidence + margin, moved):
        return None
    fitting = np.count_nonzero(first.chosen)
    more = np.count_nonzero(group.chosen) - fitting
    length, *shift = numbers * (1.0, *[observed.assumed.focal_length] * 2)
    beside = f"and {more} more" if more > 0 else "and better"
    return Failure(
        Reason.CALIBRATION,
        f"{fitting} points fit, {beside} with a focal length of {length:.2f} times K's and a "
        f"principal point {shift[0]:+.0f}, {shift[1]:+.0f} px from K's: is K, its binning or its "
        "region of interest that of another image?",
    )


def _evidence(groups: tuple[_Group, ...], parameters: int, count: int, area: float) -> float:
    """Return the log evidence of groups of points, the others anywhere in an image (Schwarz)."""
    inside = sum(int(np.count_nonzero(group.chosen)) for group in groups)
    freedom = max(2 * inside - parameters, 1)
    variance = max(
        sum(float(group.squared_errors[group.chosen].sum()) for group in groups) / freedom,
        LEAST_NOISE**2,
    )
    density = inside * (math.log(2.0 * math.pi * variance) + 1.0)
    return -density - (count - inside) * math.log(area) - 0.5 * parameters * math.log(2 * inside)


def _evidence_without_a_marker(observed: Observed, posterior: Posterior, threshold: float) -> float:
    """Return the log evidence of a motion and one marker that has a pose of its own."""
    observations, area = observed.observations, _area(observed)
    evidences, markers = [-math.inf], _markers(observed)
    for marker in range(markers):
        others = np.arange(len(observations)) // 4 != marker
        part = observations.only(np.flatnonzero(others))
        best = best_motion(part.packed, len(part), posterior.state, observed.terms, threshold)
        if best.inliers.any():
            group = _Group(best.inliers, best.state, best.squared_errors)
            evidences.append(_evidence((group,), PARAMETERS + POSE.stop, len(part), area))
    return max(evidences) - math.log(max(markers, 1))


def _another_lens(
    search: MotionSearch, observed: Observed, threshold: float, of_size: bool
) -> tuple[_Group, Array] | None:
    """Return the motion of most points with another matrix, and its numbers (3,): see _through.

    It is that of any image or, ``of_size``, of a resized one. Of that the principal point moves
    with the focal length, and both show before a wall, where neither does alone.
    """
    focal, last = observed.assumed.focal_length, WIDEST_GATE * threshold
    camera, enough = observed.exposure.cameras[0], len(observed.observations) - SAMPLE
    middle = centre_of(camera) / focal if of_size else 0.5 * np.array(camera.size) / focal
    starts: list[tuple[int, float, Array, Array, float]] = []
    for length, scaled in product(_LENGTHS, (True,) if of_size else (False, True)):
        lens = np.append(length, scaled * (length - 1.0) * middle)
        through, circle = _through(observed, lens), length * GLOBAL_SHUTTER_SCALE * focal
        start = search.rough(through)
        errors = through.observations.squared_errors(start.state)
        near = min(int(np.count_nonzero(errors < circle**2)), enough)
        if start.found and near > SAMPLE + _LENS:
            closest = -float(np.median(errors)) if of_size else 0.0
            starts.append((near, closest, start.state, lens, 2.0 * circle))
            if near == enough and not of_size:
                break
    if not starts:
        return None
    _, _, state, lens, gate = max(starts, key=lambda each: each[:2])
    mean, whitened = _OF_K, np.diag(1.0 / _DEVIATIONS)
    if of_size:
        mean, whitened = lens, np.diag(1.0 / (_OF_SIZE * [lens[0], 1.0, 1.0]))
        whitened[1:, 0] = -middle * np.diag(whitened)[1:]
    left = _LAST_STEPS
    while left:
        gate = max(_NARROWER * gate, last)
        left -= gate == last
        step = _step(_through(observed, lens), state, whitened, whitened @ (lens - mean), gate)
        state, lens = apply_step(state, step[:PARAMETERS]), lens + step[PARAMETERS:]
        if not 0.5 * min(_LENGTHS) < lens[0] < 2.0 * max(_LENGTHS):  # NaN is not, either
            return None
    errors = _through(observed, lens).observations.squared_errors(state)
    group = _Group(errors < last**2, state, errors)
    return (group, lens) if group.chosen.any() else None


def _through(observed: Observed, lens: Array) -> Observed:
    """Return the frame as a camera with another matrix saw it.

    ``lens`` (3,) is its focal length over K's, and the offset of its principal point from K's, in
    focal lengths.
    """
    seen, usable = observed.observations, observed.usable
    by_ray = lens[0] * usable.by_ray[usable.indices]
    rays = (seen.rays - lens[1:]) / lens[0]
    return altered(observed, observations=Observations.of(
        seen.points, rays, seen.tau, by_ray, seen.mounts, seen.camera
    ))  # fmt: skip


def _step(observed: Observed, state: Array, whitened: Array, off: Array, gate: float) -> Array:
    """Return Gauss and Newton's step (21,) of motion and lens, by the points within a gate.

    ``off`` (3,) is how far the lens is off from what is known of it, in deviations, and
    ``whitened`` (3,3) its derivative.
    """
    seen, usable = observed.observations, observed.usable
    lines = linearized(seen.packed, len(seen), state, np.zeros((len(seen), 6)))
    near, size = np.square(lines.errors).sum(axis=1) < gate**2, PARAMETERS + _LENS  # NaN is not
    if np.count_nonzero(near) < SAMPLE + _LENS:
        return np.full(size, np.nan)
    by_ray = usable.by_ray[usable.indices][near]
    by_length = np.einsum("nij,nj->ni", by_ray, lines.image[near])[:, :, None]
    errors = lines.errors[near][:, :, None]
    columns = np.concatenate([lines.by_motion[near], by_length, by_ray, errors], axis=2)
    columns = columns.reshape(-1, size + 1) / (EXPECTED_NOISE * gate)
    every, of_lens = columns.T @ columns, np.column_stack([whitened, off])
    of_motion = np.r_[:PARAMETERS, size]
    every[np.ix_(of_motion, of_motion)] += known_at(observed.terms, state).form
    every[PARAMETERS:, PARAMETERS:] += of_lens.T @ of_lens
    step, positive = solve_positive(every[:size, :size].copy(), -every[:size, size])
    return step if positive else np.full(size, np.nan)


def _surprise(total: int, size: int, sample: int, chance: float) -> float:
    """Return the negative log of the number of groups of ``size`` that chance makes of mismatches.

    Any ``sample`` of points has a motion, so only points beyond it count.
    """
    if size <= sample:
        return 0.0
    choices = math.log(math.comb(total, size) * math.comb(size, sample))
    return -(choices + (size - sample) * math.log(chance))


def by_chance(observed: Observed, posterior: Posterior, threshold: float) -> Failure | None:
    """Return the failure of a motion that fits no more points than chance makes fit.

    Points near their places may be those of a camera that vibrates, or of a rough map: they fit by
    chance unless a motion is surprising among them. Where the gate was widened for them, it is one
    among points that lie anywhere.
    """
    errors = posterior.squared_errors
    inliers = posterior.inliers & np.isfinite(errors)  # a gate may be as wide as a motion is absurd
    found = int(np.count_nonzero(inliers))
    fitting = errors[inliers]
    gate = float(fitting.max()) if found else 0.0
    # Of a rough map, or a short focal length, the gate may be as wide: others need room beside it.
    circle = max((GLOBAL_SHUTTER_SCALE * observed.assumed.focal_length) ** 2, 4.0 * gate)
    near = int(np.count_nonzero(errors <= circle))
    total, area, sample = near, circle, PARAMETERS // 2
    if posterior.gate > _WIDE * threshold:
        total, area = len(errors), _area(observed) / math.pi
        # Such errors decide few numbers of a motion; the others are as they are expected.
        sample = min(max(math.ceil(found - 0.5 * posterior.freedom), _OF_POSE), sample)
    elif near <= found + _MARKER:
        return None
    # One point may fill the gate, as a near one does of a rough map: so many others fit better.
    best, sizes = np.sort(fitting), (found, 3 * found // 4, found // 2)
    chances = best / area
    surprises = [_surprise(total, k, sample, float(chances[k - 1])) for k in sizes if k]
    if max(surprises, default=0.0) > LEAST_CHANCE:
        return None
    return Failure(
        Reason.MODEL_ERROR,
        f"{found} points fit, and {near - found} others lie within {math.sqrt(circle):.0f} px of "
        "their places: so many fit by chance",
    )
