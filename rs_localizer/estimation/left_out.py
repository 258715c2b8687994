# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Points that a motion leaves out: mismatches, or witnesses against it.

Mismatches lie anywhere. Before a lens or a map that is grossly wrong a motion fits a part of the
points, by velocities that it needs for that, and the rest is no chance: it lies near where it ought
to, or it has a motion of its own.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, Array2, BoolArray
from rs_localizer.core.reasons import Reason
from rs_localizer.core.state import MOVE, TURN, step_between
from rs_localizer.core.types import Failure
from rs_localizer.estimation.observations import Observed
from rs_localizer.estimation.posterior import WIDEST_GATE, Posterior
from rs_localizer.estimation.residuals import linearized
from rs_localizer.estimation.searching import GLOBAL_SHUTTER_SCALE, MotionSearch
from rs_localizer.native import entry

# Three quarters of the inliers say as much as they do. Two fifths of the matches that are
# shifted alike leave two thirds; with 0.5 they were lost, and 3 of 1,080 wrong cameras less passed.
_SHARE = 0.75
# Of points that lie just beyond the gate, where inliers go on: no match is shifted so.
_NEAR_SHARE = 0.5
# Six points have a motion whatever they are.
_SAMPLE = 6
# Groups that chance makes of mismatches in one frame of 1,000 (Desolneux, Moisan and Morel, IJCV
# 2000: the number of false alarms).
_LEAST_CHANCE = -math.log(1e-3)
# Errors of inliers from this part of the gate on are spread over it: they may go on beyond.
_SPREAD = 0.35
# Beyond so many gates a point is another's.
_ELSEWHERE = 2.0
# Mismatches are strewn over the image: this part of them lies about its places in circles of this
# part of the image.
_CIRCLE = 0.1
# How much the errors of two neighbours may differ, as a part of their distance: scales are off by
# twice at most.
_STRETCH = 0.5
_MANY = 60
# A side of the image that has all but this part of a group.
_ELSE = 0.1


class LeftOut(NamedTuple):
    """Oddity of the points that are left out."""

    failure: Failure | None = None
    notice: str = ""


def left_out(
    search: MotionSearch, observed: Observed, posterior: Posterior, threshold: float, known: bool
) -> LeftOut:
    """Judgement of the points that a motion leaves out: what speaks against it.

    Args:
        posterior: of an accepted motion.
        threshold: px, of inliers.
        known: the motion was predicted, so that a group as large is another thing.
    """
    count, inliers = observed.observations.count, int(np.count_nonzero(posterior.inliers))
    if count - inliers < _SAMPLE:
        return LeftOut()
    counts = math.exp(-0.5 * posterior.speeding) * inliers
    most, least = ((1.0 if known else share) * counts for share in (_SHARE, _NEAR_SHARE))
    near = _near(observed, posterior, threshold)
    found = LeftOut()
    if near < max(least, 1.0):
        found = _moved(search, observed, posterior, threshold, most)
        if found.failure is not None or known:  # what is matched near predictions is near them
            return found
        near = _not_strewn(observed, posterior)
        if near < _SHARE * inliers:  # however fast: a few that lie near are seen from a car, too
            return found
    return LeftOut(Failure(
        Reason.MODEL_ERROR,
        f"{inliers} points fit to {posterior.noise:.2g} px (one sigma), and of the "
        f"{count - inliers} others {near:.0f} lie so near to their places that they are no "
        "mismatches: the calibration or the map is too far off for any pose",
    ))  # fmt: skip


def _moved(
    search: MotionSearch, observed: Observed, posterior: Posterior, threshold: float, most: float
) -> LeftOut:
    """Oddity of points that are left out and have a motion of their own.

    Args:
        most: points that are no reason to refuse the frame.
    """
    inliers = int(np.count_nonzero(posterior.inliers))
    rest = ~(posterior.squared_errors < (_ELSEWHERE * WIDEST_GATE * threshold) ** 2)
    left = int(np.count_nonzero(rest))
    few = left < most
    if left <= _SAMPLE or (few and _moved_alike(observed, posterior, rest) <= _SAMPLE):
        return LeftOut()
    own = search.among(observed, rest, _SAMPLE)
    if not own.found:
        return LeftOut()
    group = rest & observed.observations.within(own.state, WIDEST_GATE * threshold)
    size = int(np.count_nonzero(group))
    if _surprise(left, size, _chance(observed, WIDEST_GATE * threshold)) < _LEAST_CHANCE:
        return LeftOut()
    text = _described(observed, posterior, own.state, group)
    text = f"{inliers} points fit one motion, and {size} of the {left} left out {text}"
    if size < most:
        return LeftOut(notice=f"{text}: have these points been moved, or do they move?")
    return LeftOut(Failure(
        Reason.MODEL_ERROR,
        f"{text}: a part of the map was moved, or the calibration is grossly wrong (is K, its "
        "binning or its region of interest that of another image?)",
    ))  # fmt: skip


def _chance(observed: Observed, distance: float) -> float:
    """Chance of a mismatch to lie within a distance (px) of its place."""
    area = min(math.prod(camera.size) for camera in observed.sighted.exposure.cameras)
    return min(math.pi * distance**2 / area, 1.0)


def _near(observed: Observed, posterior: Posterior, threshold: float) -> float:
    """How many points lie near where they ought to, though not within the gate, and not by chance;
    0 where the inliers are apart from the others.
    """
    if posterior.noise < _SPREAD * threshold:
        return 0.0
    distance = GLOBAL_SHUTTER_SCALE * observed.assumed.focal_length
    others = posterior.squared_errors[~posterior.inliers]
    near = np.count_nonzero(others < distance**2)
    return float(near) - len(others) * _chance(observed, distance)


def _not_strewn(observed: Observed, posterior: Posterior) -> float:
    """How many of the points that are left out lie nearer to their places than mismatches, which
    are strewn over the image; 0 where chance may do it.
    """
    area = min(math.prod(camera.size) for camera in observed.sighted.exposure.cameras)
    others = math.pi * posterior.squared_errors[~posterior.inliers] / area
    count, inside = len(others), int(np.count_nonzero(others < _CIRCLE))
    beyond = count - inside
    if inside <= _CIRCLE * count:
        return 0.0
    surprise = inside * math.log(inside / (_CIRCLE * count))
    if beyond:
        surprise += beyond * math.log(beyond / ((1.0 - _CIRCLE) * count))
    return inside - beyond * _CIRCLE / (1.0 - _CIRCLE) if surprise > _LEAST_CHANCE else 0.0


def _moved_alike(observed: Observed, posterior: Posterior, rest: BoolArray) -> int:
    """How many of the points that are left out are off as their nearest neighbours are.

    It costs a tenth of a search, and mismatches seldom are.
    """
    count = observed.observations.count
    lines = linearized(
        observed.observations.packed, count, posterior.state, np.zeros((count, 6))
    )  # fmt: skip
    some = np.flatnonzero(rest & np.isfinite(lines.errors[:, 0]))
    some = some[:: len(some) // _MANY + 1]
    if len(some) <= _SAMPLE:
        return len(some)
    focal = observed.assumed.focal_length
    places, rough = focal * observed.observations.rays[some], GLOBAL_SHUTTER_SCALE * focal
    alike = as_nearest(places, lines.errors[some], rough)
    return alike * (int(np.count_nonzero(rest)) // len(some))


@entry
def as_nearest(places: Array2, errors: Array2, rough: float) -> int:
    """How many of the errors (n,2) of places (n,2) are those of the nearest one, about."""
    count, alike = len(places), 0
    for i in range(count):
        nearest, apart = 0, np.inf
        for j in range(count):
            distance = math.hypot(places[i, 0] - places[j, 0], places[i, 1] - places[j, 1])
            if j != i and distance < apart:
                nearest, apart = j, distance
        off = math.hypot(errors[i, 0] - errors[nearest, 0], errors[i, 1] - errors[nearest, 1])
        if off < rough + _STRETCH * apart:
            alike += 1
    return alike


def _surprise(total: int, size: int, chance: float) -> float:
    """Negative logarithm of how many groups of a size chance makes of so many mismatches."""
    if size <= _SAMPLE:
        return 0.0

    def choices(n: int, k: int) -> float:
        return math.lgamma(n + 1) - math.lgamma(k + 1) - math.lgamma(n - k + 1)

    free = size - _SAMPLE
    return -(choices(total, size) + choices(size, _SAMPLE) + free * math.log(chance))


def _described(observed: Observed, posterior: Posterior, state: Array, group: BoolArray) -> str:
    """Place of a group of points, and how far away its own pose is."""
    step = step_between(posterior.state, state)
    turn, move = float(np.linalg.norm(step[TURN])), float(np.linalg.norm(step[MOVE]))
    where = _side(observed, posterior.inliers, group)
    return f"{where}have a pose of their own, {math.degrees(turn):.1f} deg and {move:.2g} m away"


def _side(observed: Observed, inliers: BoolArray, group: BoolArray) -> str:
    """On which side of the image a group of points lies, beside the inliers; empty: on none."""
    if not observed.sighted.exposure.alone:
        return ""
    pixels = observed.sighted.pixels[observed.sighted.usable.indices]
    for axis, names in enumerate((("left", "right"), ("top", "bottom"))):
        low, high = np.quantile(pixels[group, axis], [_ELSE, 1.0 - _ELSE])
        least, most = np.quantile(pixels[inliers, axis], [_ELSE, 1.0 - _ELSE])
        if high < least:
            return f"at the {names[0]} of the image "
        if low > most:
            return f"at the {names[1]} of the image "
    return ""
