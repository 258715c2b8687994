# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Another camera matrix than K, from three frames together.

Within one frame before a plane, motion takes up what a wrong focal length leaves. Between frames
the same camera moves: a parabola through the poses of three frames is how it moves within each
of them. So each frame has a pose only, and all of them share

    the readout time, the stamp of the middle one, the focal length, and fy over fx,

as parts of what is given. A readout time or a stamp that is off is no fault of K and is left free;
beside them three frames tell a focal length to 1 %, and fy over fx to 0.1 %.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.lens import centre_of
from rs_localizer.core.rig import Exposure
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.points import Observations, find_usable, packed
from rs_localizer.estimation.projection import linearized

FRAMES = 3
"""Frames that are compared: through them goes one parabola."""
# Points of a frame: more take longer than they are worth.
_MOST = 60
# Steps of Gauss and Newton, the last of which moves no number and no angle by more than this.
_ROUNDS, _LEAST_STEP = 12, 1e-4
_LEAST_NOISE = 0.1  # px, no real error is smaller
# Focal lengths from which the search also starts, over K's.
_LENGTHS = (0.6, 1.7)
# The largest step of a number: beyond it the linear terms no longer hold.
_MOST_STEP = 0.3
# Deviations of readout time, stamp (of an interval: drivers stamp when an image arrives, or count
# images of which some were lost), focal length and fy over fx (logarithms) of any camera.
_OTHER = np.array([3.0, 0.2, 1.0, 0.1])
# Numbers that are no fault of K, and all.
_GIVEN, _NUMBERS = 2, 4
# Deviation of the focal length of this very camera: also of one that is bent or lies before a map
# that is (:mod:`.left_out`).
_USUAL = 0.01
# No fy over fx is known better than to this.
_EXACT = 1e-4
# Gain in the logarithm of the evidence for each point and frame, from which another matrix is
# believed: right ones gain 0.0, boards of paper at most 0.27 (12 videos), wrong ones 2 to 9.
_EACH = 1.0
# fy over fx changes as each changes by a half, the other way.
_ASPECT = np.array([-0.5, 0.5])


class Fitted(NamedTuple):
    """A frame with a pose."""

    time_ns: int
    found: Estimate
    points: Array  # (n,3)
    pixels: Array  # (n,2)


class Matrix(NamedTuple):
    """Another camera matrix, beside K."""

    focal_length: float  # over K's
    aspect_ratio: float  # fy over fx, over K's

    def __str__(self) -> str:
        named = [
            f"{name} {value:.3g} times K's"
            for name, value in (
                ("a focal length", self.focal_length),
                ("fy over fx", self.aspect_ratio),
            )
            if value != 1.0
        ]
        return (
            f"successive images fit a camera with {' and '.join(named)}: is K that of another "
            "resolution or of a zoomed, squeezed or rectified image, was only its size edited, or "
            "is the map off?"
        )


class _Linked(NamedTuple):
    """A frame on its way; the motion within it is that through the poses of two others."""

    seen: Observations
    others: tuple[int, int]
    away: Array  # (2,) times to the others, readouts
    shifted: Array  # (2,) their derivatives by the stamp of the middle frame


def _slopes(away: Array) -> Array:
    """Return velocity and acceleration (2,2) by the ways to two others, per readout."""
    first, second = away
    columns = np.array([[0.5 * second**2, -0.5 * first**2], [-second, first]])
    slopes: Array = columns / (0.5 * first * second * (second - first))
    return slopes


class _Fit(NamedTuple):
    """Poses and numbers of a fit, and the errors that it leaves."""

    poses: list[tuple[Array, Array]]  # rotation (3,3) camera_from_map and centre (3,)
    numbers: Array  # (4,) beside those that are given
    squared_errors: Array  # (n,) px^2


@np.errstate(all="ignore")  # a start that leads nowhere
def another_matrix(
    exposure: Exposure, posed: Sequence[Fitted], aspect_ratio: float, map_deviation: float
) -> Matrix | None:
    """Return the matrix that frames tell to be the camera's instead of K; None: K may be right.

    Args:
        exposure: of a camera alone that moves while rows are read.
        posed: of three frames, in their order.
        aspect_ratio: declared deviation of fy over fx.
        map_deviation: m, as declared.
    """
    centre = np.median(posed[0].points, axis=0)
    frames = _frames(exposure, posed, centre)
    poses = [(each.found.rotation, each.found.position - centre) for each in posed]
    own = np.concatenate([each.found.residuals[each.found.inliers] for each in posed])
    depth = np.median(frames[0].seen.points @ poses[0][0][2]) - poses[0][0][2] @ poses[0][1]
    of_map = map_deviation * exposure.cameras[0].focal_length / float(depth)
    least = _LEAST_NOISE**2 + of_map**2
    most = math.exp(_EACH) * max(_variance(own**2), least)
    size = 6 * len(frames) + _GIVEN
    given = _fitted(frames, _Fit(poses, np.zeros(_NUMBERS), np.zeros(0)), _GIVEN)
    hidden = _variance(given.squared_errors) > most  # or each frame hides what is wrong
    near = _fitted(frames, given, _NUMBERS, rounds=1)
    if not hidden and not _told(near, aspect_ratio).any():  # the first step would tell
        return None
    fits = [_fitted(frames, near, _NUMBERS)]
    if hidden:
        camera = exposure.cameras[0]
        middles = np.zeros(2), centre_of(camera) / camera.focal_length
        starts = [given, *(_scaled(poses, length) for length in _LENGTHS)]
        fits += [_fitted(frames, start, _NUMBERS, each) for each in middles for start in starts]
    other = max(fits, key=lambda fit: _evidence(fit, size + 2, least))
    if not _variance(other.squared_errors) < most:  # it leaves more than frames do
        return None
    told = _told(other, aspect_ratio)
    gain = _evidence(other, size + 2, least) - _evidence(given, size, least)
    if not (told.any() and gain > _EACH * len(other.squared_errors)):  # NaN is not
        return None
    length, aspect = np.where(told, np.exp(other.numbers[_GIVEN:]), 1.0).tolist()
    return Matrix(length, aspect)


def _told(fit: _Fit, aspect_ratio: float) -> Array:
    """Return whether focal length and fy over fx (2,) are those of any camera rather than K's."""
    off, usual = fit.numbers[_GIVEN:], np.array([_USUAL, max(aspect_ratio, _EXACT)])
    any_camera = _OTHER[_GIVEN:]
    odds = 0.5 * ((off / usual) ** 2 - (off / any_camera) ** 2)
    told: Array = odds > np.log(any_camera / usual)
    return told


def _scaled(poses: Sequence[tuple[Array, Array]], length: float) -> _Fit:
    """Return a start with another focal length: the points are so much farther away."""
    away = [
        (rotation, rotation.T @ ((rotation @ place) * [1.0, 1.0, length]))
        for rotation, place in poses
    ]
    return _Fit(away, np.array([0.0, 0.0, math.log(length), 0.0]), np.zeros(0))


def _frames(exposure: Exposure, posed: Sequence[Fitted], centre: Array) -> list[_Linked]:
    times = np.array([1e-9 * (each.time_ns - posed[0].time_ns) for each in posed]) / exposure.span
    frames = []
    for k, each in enumerate(posed):
        some = np.flatnonzero(each.found.inliers)
        some = some[:: 1 + len(some) // _MOST]
        points, pixels = map(np.ascontiguousarray, (each.points[some], each.pixels[some]))
        usable = find_usable(exposure, points, pixels, [len(pixels)], None)
        near = usable._replace(centre=centre)
        middle = min(max(k, 1), len(posed) - 2)
        others = sorted({middle - 1, middle, middle + 1} - {k})
        interval = 0.5 * (times[middle + 1] - times[middle - 1])
        shifted = interval * np.array([(each == middle) - float(k == middle) for each in others])
        seen = packed(exposure, points, near)
        frames.append(_Linked(seen, (others[0], others[1]), times[others] - times[k], shifted))
    return frames


def _fitted(
    frames: Sequence[_Linked],
    start: _Fit,
    free: int,
    middle: Array | None = None,
    rounds: int = _ROUNDS,
) -> _Fit:
    """Return the fit of poses and of the first so many numbers.

    ``middle`` (2,): the principal point, in focal lengths, which moves with the focal length if the
    image has another size; None or zero: it does not.
    """
    middle = np.zeros(2) if middle is None else middle
    fit, size = start, 6 * len(frames)
    for _ in range(rounds):
        lines = [_linearized(frames, fit, k, middle) for k in range(len(frames))]
        squared = _squared(lines)
        variance = _variance(squared)
        known = np.r_[np.zeros(size), variance / _OTHER[:free] ** 2]
        information = np.diag(known)
        slope = known * np.r_[np.zeros(size), fit.numbers[:free]]
        for errors, columns in lines:
            rows = columns[:, :, : size + free]
            near = np.isfinite(rows).all(axis=(1, 2)) & np.isfinite(errors).all(axis=1)
            off, rows = errors[near], rows[near].reshape(-1, size + free)
            weights = 1.0 / (1.0 + np.square(off).sum(axis=1) / (9.0 * variance))
            weighed = rows.T * np.repeat(weights, 2)
            information += weighed @ rows
            slope += weighed @ off.ravel()
        try:
            step = -np.linalg.solve(information, slope)
        except np.linalg.LinAlgError:
            break
        numbers = fit.numbers.copy()
        numbers[:free] += np.clip(step[size:], -_MOST_STEP, _MOST_STEP)
        poses = [
            (np.ascontiguousarray(so3.exp(-turn) @ rotation), place + rotation.T @ move)
            for (rotation, place), (turn, move) in zip(
                fit.poses, step[:size].reshape(-1, 2, 3), strict=True
            )
        ]
        fit = _Fit(poses, numbers, squared)
        turns = step[:size].reshape(-1, 6)[:, :3]
        if max(np.abs(step[size:]).max(), np.abs(turns).max()) < _LEAST_STEP:
            return fit  # whose errors are those before the step: they differ by nothing that counts
    lines = [_linearized(frames, fit, k, middle) for k in range(len(frames))]
    return fit._replace(squared_errors=_squared(lines))


def _squared(lines: Sequence[tuple[Array, Array]]) -> Array:
    """Return the squared errors of all frames' points; infinite where there are none."""
    squared = np.concatenate([np.square(errors).sum(axis=1) for errors, _ in lines])
    return np.where(np.isnan(squared), np.inf, squared)


def _variance(squared: Array) -> float:
    """Return the variance (px^2) of one coordinate, by the median of squared errors."""
    return max(float(np.median(squared)) / 1.386, _LEAST_NOISE**2)


def _linearized(frames: Sequence[_Linked], fit: _Fit, k: int, middle: Array) -> tuple[Array, Array]:
    """Return errors (n,2) of a frame, and their derivatives (n,2,m) by all poses and numbers."""
    frame, (rotation, place) = frames[k], fit.poses[k]
    turns = [rotation @ fit.poses[other][0].T for other in frame.others]
    ways = np.array([
        np.r_[so3.log(np.ascontiguousarray(turn)), rotation @ (fit.poses[other][1] - place)]
        for turn, other in zip(turns, frame.others, strict=True)
    ])  # fmt: skip
    more, late, longer, aspect = fit.numbers
    readout, away = 1.0 + more, frame.away + late * frame.shifted
    scale, length = np.exp(longer + aspect * _ASPECT), math.exp(longer)
    shift = (length - 1.0) * middle
    seen, per_time = frame.seen, readout ** np.array([1.0, 2.0])
    through = Observations.of(
        seen.points,
        (seen.rays - shift) / scale,
        seen.tau,
        seen.by_ray * scale,
        seen.mounts,
        seen.camera,
    )
    by_way = _slopes(away)
    speeds = per_time[:, None] * (by_way @ ways)
    shifts = frame.shifted[:, None] * np.column_stack([np.ones(2), away])
    by_stamp = -per_time[:, None] * (by_way @ shifts @ by_way @ ways)
    state = np.concatenate([rotation.ravel(), -rotation @ place, speeds.ravel()])
    lines = linearized(through.packed, len(through), state, np.zeros((len(through), 6)))
    size, own = 6 * len(frames), slice(6 * k, 6 * k + 6)
    by_number = np.zeros(
        (lines.by_motion.shape[2], size + _NUMBERS)
    )  # of the motion within the frame
    by_number[:6, own] = np.eye(6)
    for turn, other, way, slopes in zip(turns, frame.others, ways, by_way.T, strict=True):
        about = np.linalg.inv(so3.right_jacobian(-way[:3]))
        by_own, by_other = -np.eye(6), np.zeros((6, 6))
        by_own[:3, :3], by_own[3:, :3] = -about, so3.hat(way[3:])
        by_other[:3, :3], by_other[3:, 3:] = about @ turn, turn
        for part, weight in enumerate(per_time * slopes, start=1):
            rows = slice(6 * part, 6 * part + 6)
            by_number[rows, own] += weight * by_own
            by_number[rows, 6 * other : 6 * other + 6] = weight * by_other
    by_number[6:, size] = (speeds * [[1.0], [2.0]]).ravel() / readout
    by_number[6:, size + 1] = by_stamp.ravel()
    columns = lines.by_motion @ by_number
    by_length = through.by_ray * lines.image[:, None, :]
    columns[:, :, size + 2] = by_length.sum(axis=2) + seen.by_ray @ (length * middle)
    columns[:, :, size + 3] = by_length @ _ASPECT
    return lines.errors, columns


def _evidence(fit: _Fit, parameters: int, least: float) -> float:
    """Return the log evidence of a fit, with outliers of little weight (Schwarz).

    ``least``: px^2, variance that noise and map have in any case.
    """
    squared = fit.squared_errors
    weights = 1.0 / (1.0 + squared / (9.0 * _variance(squared)))
    inside = weights > 0.0
    total, count = float(weights[inside] @ squared[inside]), len(squared)
    variance = max(total / max(2.0 * weights.sum() - parameters, 1.0), least)
    return -count * (math.log(variance) + 1.0) - 0.5 * parameters * math.log(2 * count)
