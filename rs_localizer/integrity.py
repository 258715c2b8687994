# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Am I lost? The probability that a pose lies outside its 99.9 % region.

A wrong pose leaves traces in a frame: outliers cluster, and inliers are landmarks of only a part of
the map. Where matches lie in the image says nothing: wrong ones may lie anywhere. Each trace is a
number, and a logistic regression turns them into log odds. It was fitted to sequences in right and
wrong maps (``python -m benchmarks.integrity --fit``). Its odds are tempered, because successive
frames err together. If a whole map is wrong in the same way, only the first wrong frame shows it:
its pose lies where the frames before did not predict it. A hidden Markov chain combines both. Its
states are: right; wrong, and frames show it; wrong since a jump.

No image can show that a room was moved as a whole before the first frame. Neither can an image of
one wall show that the wall is a copy of another one. Landmarks that have disappeared do not make a
pose wrong; :meth:`Integrity.stale` finds them.
"""

import math

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.config import Acceleration
from rs_localizer.core.arrays import Array, Array1, Array2, BoolArray, BoolArray1
from rs_localizer.core.state import POSE
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.moved_part import keys_of
from rs_localizer.estimation.prior import Prior
from rs_localizer.estimation.window import acceleration_covariance, step_from
from rs_localizer.native import entry

NAMES = "apart", "spread", "count", "innovation"
"""Names of the numbers of a frame."""
# The regression: the constant, then the weights of NAMES; an innovation counts as a jump only.
WEIGHTS = np.array([0.863, 0.344, -1.623, -0.226, 0.0])
# Weight of a frame's log odds beside those of earlier ones, if it comes as those of the fit do (s):
# frames that are closer err together.
TEMPER, PERIOD = 0.4, 1.0 / 15.0
# Rates per second at which a right track goes wrong and a wrong one recovers; probabilities that a
# first pose is wrong in either way.
GOES_WRONG, RECOVERS, FIRST = 0.015, 13.7, (0.015, 0.005)
# Rate per second at which a track is right again after a jump, unseen, as wrong tracks of the fit
# are: 1.2 where a part of the map is wrong, 0 where all of it is. A camera that was carried is
# doubted for 0.9 s.
RETURNS = 0.3
# Log odds that an innovation is a jump to a wrong or a right pose (constant and factor), and the
# highest probability that a jump may give.
JUMP, MOST_JUMP = (-15.57, 5.34), 0.65
INNOVATION = NAMES.index("innovation")
# Neighbours of a point in the map that are compared with it; most points that are compared.
_NEIGHBOURS, _MOST = 4, 200
# A landmark has disappeared if an existing one would be missed as often with less than this
# probability. Most landmarks that are remembered.
_BY_CHANCE, _MOST_LANDMARKS = 1e-8, 20_000
# Bound of a frame's log odds.
_MOST_ODDS = 8.0


@entry
def likeness(points: Array2, numbers: Array1, neighbours: int) -> float:
    """Return the mean product of numbers (n,) of points (n,3) and of their neighbours."""
    extents = [np.max(points[:, axis]) - np.min(points[:, axis]) for axis in range(3)]
    sorted_by = np.argmax(np.array(extents))
    order = points[:, sorted_by].copy().argsort()
    points, numbers = points[order], numbers[order]
    count, total = len(points), 0.0
    far, near = np.empty(neighbours), np.empty(neighbours)
    for i in range(count):
        far[:] = np.inf
        for step in (-1, 1):  # both ways, until all others are farther along that axis alone
            j = i + step
            while 0 <= j < count:
                if not (points[i, sorted_by] - points[j, sorted_by]) ** 2 < far[neighbours - 1]:
                    break
                square = 0.0
                for axis in range(3):
                    square += (points[i, axis] - points[j, axis]) ** 2
                if square < far[neighbours - 1]:
                    place = neighbours - 1
                    while place > 0 and square < far[place - 1]:
                        far[place], near[place] = far[place - 1], near[place - 1]
                        place -= 1
                    far[place], near[place] = square, numbers[j]
                j += step
        total += numbers[i] * near.sum()
    return total / (count * neighbours)


@entry
def _together(points: Array2, kept: BoolArray1) -> float:
    """Return how far inliers and outliers cluster in the map, in deviations of chance."""
    count = min(len(points), _MOST)
    if count <= 2 * _NEIGHBOURS:
        return 0.0
    chosen = np.arange(count) * (len(points) - 1) // (count - 1)
    points, some = points[chosen], kept[chosen].astype(np.float64)
    share = float(np.mean(some))
    if not 0.0 < share < 1.0:
        return 0.0
    alike = likeness(points, some - share, _NEIGHBOURS) / (share * (1.0 - share))  # Moran's I
    expected, deviation = -1.0 / (count - 1.0), math.sqrt(1.5 / (count * _NEIGHBOURS))
    return min(max((alike - expected) / deviation, -3.0), 15.0)


@entry
def _spread(points: Array2, kept: BoolArray1) -> float:
    """Return the logarithm of how far inliers spread in the map, beside all points (n,3)."""
    if np.sum(kept) < 3:
        return -3.0
    inner = outer = 1e-12
    for axis in range(3):
        inner += float(np.var(points[kept, axis]))
        outer += float(np.var(points[:, axis]))
    return min(max(0.5 * math.log(inner / outer), -3.0), 1.0)


def _innovation(estimate: Estimate, prior: Prior, added: Array) -> float:
    """Return ``log(1 + d / 6)``, d the squared distance of the pose from its prediction.

    ``added`` (6,6) is covariance beside the prediction's.
    """
    if prior.motion is None or prior.covariance is None:
        return 0.0
    spread = np.asarray(prior.covariance)[:6, :6] + estimate.covariance[:6, :6] + added
    if not np.isfinite(spread).all():
        return 0.0
    off = step_from(prior.motion, estimate)[POSE]
    return min(math.log1p(float(off @ np.linalg.solve(spread, off)) / 6.0), 6.0)


class SeenLandmarks:
    """How often landmarks were seen, and how often they were matched."""

    def __init__(self) -> None:
        self._places: dict[float, int] = {}  # of landmarks, by key
        self._counts = np.zeros((1, 2))  # seen, kept; behind the landmarks are zeros

    def add(self, keys: Array, kept: BoolArray) -> None:
        """Count the landmarks of a frame."""
        if len(self._places) > _MOST_LANDMARKS:  # those that are not in view
            here = [*dict.fromkeys(key for key in keys.tolist() if key in self._places)]
            self._counts = self._counts[[self._places[key] for key in here] + [-1]]
            self._places = {key: place for place, key in enumerate(here)}
        places = self._places
        place = np.array([places.setdefault(key, len(places)) for key in keys.tolist()], np.int64)
        if len(places) >= len(self._counts):  # twice as many, so that few are copied
            self._counts = np.concatenate([self._counts, np.zeros((len(places), 2))])
        self._counts[place, 0] += 1.0
        self._counts[place[kept], 1] += 1.0

    def stale(self, keys: Array) -> BoolArray:
        """Return which landmarks, by key, were seen too often to be unmatched by chance."""
        place = np.array([self._places.get(key, -1) for key in keys.tolist()], np.int64)
        found: BoolArray = place >= 0
        if found.any():
            seen, kept = self._counts[place].T
            every = self._counts.sum(axis=0)
            found &= (kept == 0) & ((1.0 - every[1] / every[0]) ** seen < _BY_CHANCE)
        return found


class Integrity:
    """The chance that a track is wrong, frame by frame.

    Args:
        acceleration: of which cameras are capable. What it explains is no jump of the map, however
            calmly the camera moved before it was out of sight.
    """

    def __init__(self, acceleration: Acceleration) -> None:
        self._acceleration = acceleration
        self._seen = SeenLandmarks()
        self.reset()

    def reset(self) -> None:
        """Start anew with the next frame; the counts of landmarks are kept."""
        # Probabilities of the three states after the last frame.
        self._chances = np.array([1.0 - sum(FIRST), *FIRST])
        self._is_first = True

    def stale(self, points: ArrayLike) -> BoolArray:
        """Return which landmarks (n,3) were seen too often to be unmatched by chance."""
        return self._seen.stale(keys_of(np.asarray(points, float)))

    def numbers(
        self, estimate: Estimate, points: ArrayLike, prior: Prior | None, seconds: float
    ) -> Array:
        """Return the numbers (4,) of the next frame, in the order of ``NAMES``.

        Args:
            estimate: of the frame.
            points: (n,3) m of its correspondences.
            prior: what the frames before predicted; None: nothing.
            seconds: since the last of them that had a pose.
        """
        innovation = 0.0
        if prior is not None:
            added = acceleration_covariance(self._acceleration, seconds, estimate.span)
            innovation = _innovation(estimate, prior, added[POSE, POSE])
        usable = np.isfinite(np.asarray(estimate.residuals))
        every, kept = np.asarray(points, float)[usable], np.asarray(estimate.inliers)[usable]
        self._seen.add(keys_of(every), kept)
        inliers = int(kept.sum())
        outliers = (len(kept) - inliers + 1.0) / (len(kept) + 2.0)
        clusters = _together(every, kept) * outliers  # less, if few cluster: a person in view
        few = math.log(max(inliers - 6.0, 1.0))
        return np.array([clusters, _spread(every, kept), few, innovation])

    def add(self, numbers: Array, seconds: float) -> float:
        """Return the probability that the pose is wrong, after a frame with these numbers (4,).

        Args:
            numbers: of the frame.
            seconds: since the last frame with a pose; infinite: nobody knows.
        """
        said = min(max(float(WEIGHTS[0] + WEIGHTS[1:] @ numbers), -_MOST_ODDS), _MOST_ODDS)
        weight = TEMPER
        if not self._is_first:
            self._chances = _transitions(float(numbers[INNOVATION]), seconds) @ self._chances
            weight = min(TEMPER * seconds / PERIOD, 1.0)
        self._is_first = False
        self._chances *= [1.0, math.exp(weight * said), 1.0]
        self._chances /= self._chances.sum()
        return float(1.0 - self._chances[0])


def _transitions(innovation: float, seconds: float) -> Array:
    """Return the probabilities (3,3) of the next state (rows) for each last state (columns)."""
    odds = JUMP[0] + JUMP[1] * innovation
    jump = min(1.0 / (1.0 + math.exp(-odds)), MOST_JUMP)
    both = GOES_WRONG + RECOVERS
    mixed = -math.expm1(-both * seconds) / both
    goes, recovers = GOES_WRONG * mixed, RECOVERS * mixed
    stays, lasts = 1.0 - goes, (1.0 - goes) * (1.0 - jump) * math.exp(-RETURNS * seconds)
    return np.array([
        [stays * (1.0 - jump), recovers, stays - lasts],
        [goes, 1.0 - recovers, goes],
        [stays * jump, 0.0, lasts],
    ])  # fmt: skip
