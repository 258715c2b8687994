# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Another camera matrix than K, from what frames of a track together say.

Within one frame before a plane, motion takes up what a wrong focal length leaves. Between frames
the same camera moves: a parabola through the poses of three neighbours is how it moves within each
of them, but for a change of acceleration. So three neighbours have poses, a stamp and that change
for themselves, and share with all other threes of the track

    the readout time, the focal length, fy over fx, and small errors of lens and map,

of which each three says what is left of its equations without its own unknowns. A board that
faces the camera tells a focal length by how it is foreshortened, which grows with the square of
the angle: what one three hardly tells, some from different angles do.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import replace
from itertools import compress
from typing import NamedTuple

import numpy as np

from rs_localizer.config import LocalizerConfig
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, Array1, Array2, Array3, IntArray1
from rs_localizer.core.camera import Camera
from rs_localizer.core.lens import centre_of, off_centre
from rs_localizer.core.rig import Exposure, Mounts, Rig
from rs_localizer.core.shake import shake_at
from rs_localizer.core.state import (
    MOVE,
    PARAMETERS,
    POSE,
    POSE_SIZE,
    STATE_ANGULAR,
    STATE_LINEAR,
    VELOCITIES,
)
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.calibration import ASPECT, LandmarkErrors
from rs_localizer.estimation.linear_fit import known_at
from rs_localizer.estimation.points import FrameSights, find_usable, pack, packed
from rs_localizer.estimation.prior import PriorTerms, state_in
from rs_localizer.estimation.projection import linearized
from rs_localizer.native import entry

FRAMES = 3
"""Frames that are compared: through them goes one parabola."""
# Points of a frame: more take longer than they are worth.
_MOST = 60
# Threes that are kept: those that tell most of the focal length (its logarithm). It is known if its
# deviation is less than the second.
_KEPT, _KNOWN = 8, 0.02
# Rounds of Gauss and Newton at most, the last of which moves no number by more than this part of
# its deviation, and no pose by more than this. Short of that, a focal length seems to be known
# where it is not.
_ROUNDS, _NEAR, _LEAST_STEP = 20, 0.1, 1e-3
_LEAST_NOISE = 0.1  # px, no real error is smaller
_OF_MEDIAN = 1.386  # median of the squared errors of a point, over the variance of a coordinate
# Of other images, widths over that of K's.
_SIZES = (0.25, 4.0)
# Focal lengths from which the search also starts, over K's.
_LENGTHS = (0.6, 1.7)
# The largest step of a number: beyond it the linear terms no longer hold; usual steps of the first
# three, which may hardly be told, are smaller.
_MOST_STEP, _DAMPING = 0.3, np.diag(np.r_[np.full(3, 100.0), np.zeros(8)])
# Numbers of a three: poses, the stamp of the middle frame (drivers stamp when an image arrives, or
# count images of which some were lost; of an interval), and the velocities beside the parabola.
_OWN, _STAMP, _BESIDE = 25, 18, slice(19, 25)
_OF_STAMP = 0.2
# A third derivative adds to the velocities in the middle frame, and minus twice as much in the
# others. A hand's is by this part of how far the velocities between the frames differ, or by so
# much, rad or shares of the depth per readout.
_CUBIC, _OF_CHANGE, _LIKE_MOTION = (-2.0, 1.0, -2.0), 0.15, 0.002
# Shared numbers: readout time, focal length and fy over fx (logarithms) of any camera; errors of
# the lens (principal point, px, and distortion at the corners, px); and of the map, over its
# extent: bends and stretches (printed boards have 0.3 %).
_READOUT, _LENGTH, _RATIO, _LENS, _MAP = 0, 1, 2, slice(3, 6), slice(6, 11)
_ANY = (3.0, 0.5, 0.1)
_BENT, _SHARED, _STRETCHED = 0.003, 11, slice(9, 11)
# The principal point is as known as lenses are, unless frames tell another one.
_CENTRE, _ANY_CENTRE = slice(3, 5), 50.0
_OF_K = slice(_LENGTH, _CENTRE.stop)
# Landmarks farther away than this many extents are moved like those there.
_FAR = 2.0
# Focal length and fy over fx are others than K's beyond so many deviations. Beyond the second they
# may be, and poses allow for that. The deviation of the focal length of this very camera has the
# third beside what is declared: who calibrates a moving camera without its shutter is off by up to
# 2.8 % (twelve real boards). No fy over fx is known better than to the last.
_SURELY, _DOUBTFULLY, _USUAL, _EXACT = 4.0, 2.0, 0.01, 1e-4
# Deviations are larger by this before K is denied: cameras that vibrate by 0.1 to 0.3 deg show
# another focal length by up to 8.4 of them, or fy over fx by 11 (72 recordings).
_VIBRATING = 3.0
# If the readout time is off by more than this (logarithm), rows and images move otherwise, and
# nothing is told of fy over fx.
_TURNED = 0.25
# Errors of corners are alike in neighbouring images: before twelve real boards focal lengths are
# off by up to 4.3 deviations without this factor, by 2.8 with it.
_ALIKE = 1.6
# Deviations beyond which a map is said to be stretched. Right ones have up to 1.7, before a camera
# that vibrates up to 5.1 (36 recordings), maps that are longer by 1 % 7 to 19 after a second.
_STRETCHED_SURELY = 6.0
# Frames together may leave so many times the variance (px^2) that each leaves alone.
_AS_GOOD = math.e
# Numbers of a camera of a rig: rotation (rad) and move (m) of its mount, in the rig's axes; focal
# length (logarithm); how much later (s) it is exposed. They may be as large as the first. Who has
# calibrated is off by the second: 0.06 deg, 2 mm, 0.3 ms.
_OF_CAMERA, _LATE = 8, 7
_ANY_CAMERA = np.array([*np.full(3, 0.1), *np.full(3, 0.1), 0.1, 0.03])
_OF_MOUNT, _OF_CLOCK = (*np.full(3, 0.001), *np.full(3, 0.002)), 0.0003
# A camera is named beyond so many of these: of the right rigs of benchmarks.rigs none is (seed 0).
_BEYOND_USUAL = 5.0
_REMEDY = "are mounts, stamps and K those of these cameras (rs_localizer calibrate --rig)?"
# Of what frames tell, the part that the next one knows: mounts are bumped.
_KEPT_OF_CAMERAS = 0.97


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
    across: float  # px, of the principal point beside K's
    down: float

    def __str__(self) -> str:
        names = zip(("a focal length", "fy over fx"), self[:2], strict=True)
        named = [f"{name} {value:.3g} times K's" for name, value in names if value != 1.0]
        if self.across or self.down:
            named.append(f"a principal point {self.across:.0f}, {self.down:.0f} px from K's")
        return (
            f"successive images fit a camera with {' and '.join(named)}: is K that of another "
            "resolution or of a zoomed, squeezed or rectified image, was only its size edited, or "
            "is the map off?"
        )


class _Landmarks(NamedTuple):
    """Directions in which a map may be bent and stretched."""

    centre: Array  # (3,)
    axes: Array  # (3,3) rows; the last is that of the least extent
    extent: float  # m

    @classmethod
    def of(cls, points: Array) -> _Landmarks:
        centre = np.median(points, axis=0)
        _, sizes, axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
        return cls(centre, axes, math.sqrt(2.0 / len(points)) * float(sizes[0]))

    def modes(self, points: Array) -> Array:
        """Return how points (n,3) beside the centre move (n,3,5) by errors of one extent."""
        along, across = np.clip(points @ self.axes[:2].T / self.extent, -_FAR, _FAR).T
        bends = np.column_stack([along**2, along * across, across**2])
        one, other, out = self.axes
        stretched = np.outer(along, one) - np.outer(across, other)
        sheared = np.outer(along, other) + np.outer(across, one)
        bent = out[:, None] * bends[:, None, :]
        modes: Array = self.extent * np.dstack([bent, stretched, sheared])
        return modes


class Stretch(NamedTuple):
    """A map that is longer along one direction of its plane than it says."""

    landmarks: _Landmarks
    sizes: Array  # (2,) of stretch and shear, shares of lengths, beyond what may be chance
    surely: bool
    beside: LandmarkErrors | None = None  # that the map declares

    def at(self, points: Array) -> Array:
        """Return modes (n,3,k) of points (n,3): the stretch, and a map that is as much larger.

        What stretches a map one way makes it larger, which no frame shows.
        """
        centre, axes, extent = self.landmarks
        places = np.clip((points - centre) @ axes[:2].T, -_FAR * extent, _FAR * extent)
        along, across = self.sizes
        found = np.array([[along, across], [across, -along]])
        larger = math.hypot(along, across) * np.eye(2)
        modes: Array = np.stack([places @ each @ axes[:2] for each in (found, larger)], axis=2)
        if self.beside is None:
            return modes
        return np.concatenate([self.beside.at(points), modes], axis=2)

    def __str__(self) -> str:
        along, across = self.sizes
        turn = 0.5 * math.atan2(across, along)
        x, y, z = np.array([math.cos(turn), math.sin(turn)]) @ self.landmarks.axes[:2]
        return (
            f"successive images fit a map that is longer by {200.0 * math.hypot(along, across):.2g}"
            f" % along ({x:.2f}, {y:.2f}, {z:.2f}) than across: was it printed, measured or built "
            "with another scale along one axis?"
        )


class _Linked(NamedTuple):
    """A frame on its way; the motion within it is that through the poses of two others."""

    points: Array2  # (n,3), with the fields of :class:`Observations` behind it
    rays: Array2
    tau: Array1
    by_ray: Array3
    camera: IntArray1
    mounts: Mounts
    others: tuple[int, int]
    away: Array1  # (2,) times to the others, readouts
    shifted: Array1  # (2,) their derivatives by the stamp of the middle frame
    moved: Array3  # (n,3,5) points by errors of the map


class _Equations(NamedTuple):
    """The linear equations of a three for the shared numbers."""

    numbers: Array  # (11,) where
    information: Array  # (11,11)
    slope: Array  # (11,)
    step: Array  # (25,) of its own numbers, if the shared ones stay
    by_shared: Array  # (25,11) and by these
    squared_errors: Array  # (n,) px^2


class _Three:
    """Three neighbours with their own unknowns."""

    def __init__(
        self, exposure: Exposure, posed: Sequence[Fitted], map_: _Landmarks, length: float
    ) -> None:
        # By the logarithm of another focal length the points are farther away.
        (camera,) = exposure.cameras
        self.posed, self._focal_length = posed, camera.focal_length
        self._corner = 0.5 * math.hypot(*camera.size) / camera.focal_length
        self.frames = _frames(exposure, posed, map_)
        self.poses = []
        for each in posed:
            turn, place = each.found.rotation, each.found.position - map_.centre
            self.poses.append((turn, turn.T @ ((turn @ place) * [1.0, 1.0, math.exp(length)])))
        turn, place = self.poses[1]
        self.depth = abs(float(np.median((self.frames[1].points - place) @ turn[2])))
        self.known = self._known()  # of its own numbers beforehand, as information (25,)
        self.own = np.zeros(_OWN)  # that of the poses stays zero
        residuals = np.concatenate([each.found.residuals[each.found.inliers] for each in posed])
        self.variance = _variance(residuals**2)  # px^2, that each frame leaves alone
        self.equations: _Equations | None = None

    def linearize(self, numbers: Array, principal: Array, least: float) -> None:
        """Linearize at these shared numbers (11,), where its own ones move to.

        ``principal`` (2,): the principal point, in focal lengths, which moves with the focal length
        if the image has another size; zero: it does not. ``least``: px^2, variance of the noise.
        """
        if (there := self.equations) is not None:
            self._move(there.step + there.by_shared @ (numbers - there.numbers))
        lines = [self.lines(k, numbers, principal) for k in range(FRAMES)]
        errors, columns = (np.concatenate(part) for part in zip(*lines, strict=True))
        reduced = _reduced(errors, columns, self.known, self.own, least)
        self.equations = _Equations(numbers, *reduced)

    def _known(self) -> Array:
        frame = self.frames[1]
        before, after = (
            self._way(1, other) / away
            for other, away in zip(frame.others, frame.away, strict=True)
        )  # fmt: skip
        change = _OF_CHANGE * np.linalg.norm((after - before).reshape(2, 3), axis=1)
        deviation = np.hypot(change, _LIKE_MOTION * np.array([1.0, self.depth]))
        beside = np.repeat(deviation, 3) ** -2.0
        known: Array = np.concatenate([np.full(_STAMP, 1e-9), [_OF_STAMP**-2], beside])
        return known

    def _way(self, k: int, other: int) -> Array:
        """Return rotation vector and way (6,) from a frame to another, in the axes of the first."""
        (turn, place), (others_turn, others_place) = self.poses[k], self.poses[other]
        turned = so3.log(np.ascontiguousarray(turn @ others_turn.T))
        way: Array = np.concatenate([turned, turn @ (others_place - place)])
        return way

    def _move(self, step: Array) -> None:
        self.poses = [
            (np.ascontiguousarray(so3.exp(-turn) @ rotation), place + rotation.T @ move)
            for (rotation, place), (turn, move) in zip(
                self.poses, step[:_STAMP].reshape(-1, 2, 3), strict=True
            )
        ]
        self.own = self.own + np.r_[np.zeros(_STAMP), step[_STAMP:]]

    def lines(self, k: int, numbers: Array, principal: Array) -> tuple[Array, Array]:
        """Return errors (n,2) of a frame, and their derivatives (n,2,36) by own and shared ones."""
        poses = np.array([[*turn, place] for turn, place in self.poses])
        lens = np.array([*principal, self._corner, self._focal_length])
        errors, columns = _lines_of(k, self.frames[k], poses, self.own, numbers, lens)
        return errors, columns


@entry
def _lines_of(
    k: int, frame: _Linked, poses: Array3, own: Array1, numbers: Array1, lens: Array1
) -> tuple[Array, Array]:
    """Return errors (n,2) of a frame, and their derivatives (n,2,36) by own and shared numbers.

    Args:
        k: the place of the frame among its three.
        poses: (3,4,3) rotation and place of each.
        own: (25,) numbers of the three.
        numbers: (11,) shared ones.
        lens: (4,) the principal point that moves with the focal length, and the corner, in focal
            lengths; the focal length, px.
    """
    rotation, place, count = poses[k, :3].copy(), poses[k, 3].copy(), len(frame.points)
    ways, by_poses = np.empty((2, 6)), np.zeros((2, 6, _STAMP))  # of the ways
    here = 6 * k
    for i in range(2):
        each, first = by_poses[i], 6 * frame.others[i]
        turn = rotation @ poses[frame.others[i], :3].T
        ways[i, :3] = so3.log(turn)
        ways[i, 3:] = rotation @ (poses[frame.others[i], 3] - place)
        hat = so3.hat_of(ways[i, :3])
        about = np.eye(3) - 0.5 * hat + hat @ hat / 12.0  # inverse of the right Jacobian
        each[:3, here : here + 3], each[:3, first : first + 3] = -about, about @ turn
        each[3:, here : here + 3] = so3.hat_of(ways[i, 3:])
        each[3:, here + 3 : here + 6], each[3:, first + 3 : first + 6] = -np.eye(3), turn
    readout, length = 1.0 + numbers[_READOUT], math.exp(numbers[_LENGTH])
    away = frame.away + own[_STAMP] * frame.shifted
    # Velocity and acceleration by the ways, per readout.
    before, after = away[0], away[1]
    by_way = np.array([[0.5 * after**2, -0.5 * before**2], [-after, before]])
    by_way /= 0.5 * before * after * (after - before)
    by_way *= np.array([[readout], [readout**2]])
    speeds = by_way @ ways
    shifts = np.empty((2, 2))
    shifts[:, 0], shifts[:, 1] = frame.shifted / readout, frame.shifted * away / readout**2
    by_stamp = -(by_way @ shifts @ speeds)
    state = np.concatenate((rotation.ravel(), -(rotation @ place), speeds.ravel()))
    state[STATE_ANGULAR.start : STATE_LINEAR.stop] += _CUBIC[k] * own[_BESIDE]
    scale, shift = np.exp(numbers[_LENGTH] + numbers[_RATIO] * ASPECT), (length - 1.0) * lens[:2]
    by_ray = frame.by_ray * scale
    data = pack(
        frame.points, (frame.rays - shift) / scale, frame.tau, by_ray, frame.camera, frame.mounts
    )
    lines = linearized(data, count, state, np.zeros((count, 6)))
    by_number = np.zeros((PARAMETERS, _OWN + 1))  # of the motion within the frame
    by_number[:6, here : here + 6] = np.eye(6)
    by_number[6:, :_STAMP] = (by_way @ by_poses.reshape(2, 6 * _STAMP)).reshape(12, _STAMP)
    by_number[6:, _STAMP] = by_stamp.ravel()
    by_number[VELOCITIES, _BESIDE] = _CUBIC[k] * np.eye(6)
    by_number[6:12, _OWN + _READOUT] = speeds[0] / readout
    by_number[12:, _OWN + _READOUT] = 2.0 * speeds[1] / readout
    columns, errors = np.zeros((count, 2, _OWN + _SHARED)), lines.errors.copy()
    by_own = lines.by_motion.reshape(2 * count, PARAMETERS) @ by_number
    columns[:, :, : _OWN + 1] = by_own.reshape(count, 2, _OWN + 1)
    by_place = lines.by_motion[:, :, MOVE].copy().reshape(2 * count, 3) @ rotation
    for i in range(count):  # a number at a time: arrays of two take longer
        x, y = frame.rays[i]
        radial = (x * x + y * y) / (lens[2] ** 3 * lens[3])
        for side in range(2):
            shared, given = columns[i, side, _OWN:], frame.by_ray[i, side]
            across = by_ray[i, side, 0] * lines.image[i, 0]
            down = by_ray[i, side, 1] * lines.image[i, 1]
            moved = length * (given[0] * lens[0] + given[1] * lens[1])
            shared[_LENGTH] = across + down + moved
            shared[_RATIO] = across * ASPECT[0] + down * ASPECT[1]
            shared[_LENS.start + side] = 1.0
            shared[_LENS.stop - 1] = radial * (given[0] * x + given[1] * y)
            for k in range(_SHARED - _MAP.start):
                for axis in range(3):
                    by_error = by_place[2 * i + side, axis] * frame.moved[i, axis, k]
                    shared[_MAP.start + k] += by_error
            for k in range(_LENS.start, _SHARED):
                errors[i, side] += shared[k] * numbers[k]
    return errors, columns


@entry
def _reduced(
    errors: Array2, columns: Array3, known: Array1, own: Array1, least: float
) -> tuple[Array, Array, Array, Array, Array]:
    """Return the equations of the shared numbers alone: the fields of :class:`_Equations`.

    Args:
        errors, columns: (n,2) and (n,2,36) of a three.
        known, own: (25,) information of its own numbers beforehand, and these.
        least: px^2, variance of the noise.
    """
    count, rows = len(errors), columns.copy()
    squared: Array = np.sum(errors**2, axis=1)
    squared[np.isnan(squared)] = np.inf
    ordered = np.sort(squared)
    middle = 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])
    variance = max(middle / _OF_MEDIAN, _LEAST_NOISE**2, least)
    off = errors.copy()
    for i in range(count):
        weight = 1.0 / math.sqrt(variance + squared[i] / 9.0)
        if not np.isfinite(np.sum(columns[i]) + squared[i]):
            rows[i], off[i], weight = np.zeros(columns.shape[1:]), np.zeros(2), 0.0
        rows[i] *= weight
        off[i] *= weight
    flat = rows.reshape(2 * count, _OWN + _SHARED)
    every, slope = flat.T @ flat, off.ravel() @ flat
    crossed, right = every[:_OWN, _OWN:].copy(), np.empty((_OWN, _SHARED + 1))
    right[:, :_SHARED], right[:, _SHARED] = crossed, slope[:_OWN] + known * own
    gain = np.linalg.solve(every[:_OWN, :_OWN] + np.diag(known), right)
    taken = crossed.T @ gain
    by_shared = -gain[:, :_SHARED].copy()
    return (  # type: ignore[return-value]
        every[_OWN:, _OWN:] - taken[:, :_SHARED], slope[_OWN:] - taken[:, _SHARED],
        -gain[:, _SHARED].copy(), by_shared, squared,
    )  # fmt: skip


class _Fit(NamedTuple):
    """Shared numbers that all threes tell, and what is left."""

    numbers: Array  # (11,)
    deviations: Array  # (11,)
    wider: float  # by which they are larger than the equations say
    squared_errors: Array  # (n,) px^2
    unlikely: float  # squares of what is known beforehand, over its variances

    @property
    def variance(self) -> float:
        return _variance(self.squared_errors)

    def cost(self, variance: float) -> float:
        """Return minus twice the logarithm of the likelihood, for this variance (px^2)."""
        return self.unlikely + 9.0 * float(np.log1p(self.squared_errors / (9.0 * variance)).sum())


class FramesTogether:
    """Adds up the equations of threes, and compares K with what they tell.

    Args:
        exposure: of a camera alone that moves while rows are read.
        config: with the deviations of calibration and map.
    """

    def __init__(self, exposure: Exposure, config: LocalizerConfig) -> None:
        given = config.calibration
        self._exposure, self._map_deviation = exposure, config.map_deviation
        self._most_variance = config.inlier_threshold**2
        (camera,) = exposure.cameras
        # A K of another image has its principal point where no lens of this one has it.
        self._is_doubtful = off_centre(camera)
        away = 0.5 * np.array(camera.size) - centre_of(camera) if self._is_doubtful else np.zeros(2)
        own = np.hypot(away, given.principal_point)
        self._of_lens = np.append(own, given.distortion)
        centre = math.hypot(_USUAL * camera.focal_length, given.principal_point)
        usual = math.hypot(_USUAL, given.focal_length), max(given.aspect_ratio, _EXACT)
        self._usual = np.array([*usual, centre, centre])
        self._threes: list[_Three] = []
        self._map: _Landmarks | None = None
        self._known = np.zeros(_SHARED)  # before any frame, as information
        self._principal = np.zeros(2)
        self._fit: _Fit | None = None
        self.matrix: Matrix | None = None
        """The matrix that frames tell to be the camera's instead of K; None: K may be right."""
        self.stretch: Stretch | None = None
        """How frames show the map to be stretched; None: by no more than chance."""
        self.doubt = np.zeros(4)
        """Deviations of focal length and fy over fx (logarithms) and principal point (px) from K's,
        if frames doubt K."""
        self.other: tuple[Camera, Array] | None = None
        """The camera that frames then tell, and deviations (4,) of these numbers of it."""
        if self._is_doubtful:
            larger = np.log(0.5 * np.array(camera.size) / np.maximum(centre_of(camera), 1.0))
            numbers = np.r_[np.clip(larger.mean(), *np.log(_SIZES)), 0.0, away]
            self.doubt = np.r_[_ANY[_LENGTH], 0.0, own]
            self.other = self._another(*numbers), self.doubt

    @property
    def is_enough(self) -> bool:
        """Whether further threes tell hardly more: soon no more than now."""
        return self._fit is None or bool(self._fit.deviations[_LENGTH] < _KNOWN)

    @np.errstate(all="ignore")  # a start that leads nowhere
    def add(self, posed: Sequence[Fitted]) -> None:
        """Take three neighbours, in their order."""
        if self._map is None:
            self._map = _Landmarks.of(posed[0].points)
            bent = math.hypot(_BENT, self._map_deviation / self._map.extent)
            known = np.concatenate([_ANY, self._of_lens, np.full(_SHARED - _MAP.start, bent)])
            self._known = np.maximum(known, _EXACT) ** -2.0
        before = np.zeros(_SHARED) if self._fit is None else self._fit.numbers
        newest = _Three(self._exposure, posed, self._map, before[_LENGTH])
        threes, principal = [*map(copy, self._threes), newest], self._principal
        fit = self._fitted(threes, before, principal)
        if self._is_off_centre(fit, threes):
            self._known[_CENTRE] = _ANY_CENTRE**-2.0
            fit = self._fitted(threes, fit.numbers, principal, self._known)
        if not self._fits(fit, threes):
            fit, threes, principal = self._from_anywhere([three.posed for three in threes])
            if not self._fits(fit, threes):  # it leaves more than frames do
                return
        if self._beyond(fit, _DOUBTFULLY).any():
            fit, threes, principal = self._beside_k(fit, threes, principal)
        if not self._beyond(fit, _DOUBTFULLY)[2:].any():
            self._known[_CENTRE] = np.maximum(self._of_lens[:2], _EXACT) ** -2.0
        self._threes, self._fit, self._principal = threes, fit, principal
        if len(threes) > _KEPT:
            del self._threes[self._least()]
        told = self._beyond(fit, _SURELY, _VIBRATING) > 0.0
        length, aspect, *centre = (told * fit.numbers[_OF_K]).tolist()
        found = Matrix(math.exp(length), math.exp(aspect), centre[0], centre[1])
        self.matrix = found if told.any() else None
        doubtful = self._beyond(fit, _DOUBTFULLY) > 0.0
        allowed = doubtful | self._is_doubtful
        numbers, deviations = doubtful * fit.numbers[_OF_K], allowed * fit.deviations[_OF_K]
        self.doubt = np.hypot(numbers, deviations)
        self.other = (self._another(*numbers), deviations) if allowed.any() else None
        sizes, deviations = fit.numbers[_STRETCHED], fit.deviations[_STRETCHED]
        by_more = np.sqrt(np.maximum(sizes**2 - deviations**2, 0.0))
        # Frames that do not tell the readout time are not of the motion between them, or at rest.
        surely = float(np.linalg.norm(sizes / deviations)) > _STRETCHED_SURELY
        surely &= bool(fit.deviations[_READOUT] < _TURNED)
        stretch = Stretch(self._map, np.copysign(by_more, sizes), surely)
        self.stretch = stretch if by_more.any() else None

    def _is_off_centre(self, fit: _Fit, threes: Sequence[_Three]) -> bool:
        """Return whether another principal point may explain the frames, to first order."""
        known = self._known.copy()
        known[_CENTRE] = _ANY_CENTRE**-2.0
        information, slope = _summed(threes, known, fit.numbers)
        covariance = np.linalg.inv(information)
        there = (fit.numbers - covariance @ slope)[_CENTRE]
        deviations = np.hypot(_ALIKE * np.sqrt(np.diag(covariance)[_CENTRE]), self._usual[2:])
        return bool(np.any(np.abs(there) > _DOUBTFULLY * deviations))

    def _another(self, length: float, aspect: float, *centre: float) -> Camera:
        """Return the camera with these numbers beside K's, as in ``doubt``."""
        (camera,) = self._exposure.cameras
        K = camera.K.copy()
        K[[0, 1], [0, 1]] *= np.exp(length + aspect * ASPECT)
        K[:2, 2] += math.expm1(length) * self._principal * camera.focal_length + centre
        return replace(camera, K=K)

    def _beyond(self, fit: _Fit, least: float, wider: float = 1.0) -> Array:
        """Return what of the numbers of K (4,) lies beyond so many deviations, or 0."""
        deviations = np.hypot(wider * fit.deviations[_OF_K], self._usual)
        squared = fit.numbers[_OF_K] ** 2 - (least * deviations) ** 2
        # Rows of a squeezed image take as long as before; images that are turned as wholes look
        # squeezed, too. Where rows seem to take another time than is given, a camera that vibrates
        # looks like another focal length.
        longer, aspect = math.log1p(max(fit.numbers[_READOUT], -0.9)), fit.numbers[_RATIO]
        most = np.array([least * fit.deviations[_READOUT], _TURNED, _TURNED, _TURNED])
        beyond: Array = np.sqrt(np.maximum(squared, 0.0)) * (abs(longer + aspect) < most)
        return beyond

    def _beside_k(
        self, fit: _Fit, threes: list[_Three], principal: Array
    ) -> tuple[_Fit, list[_Three], Array]:
        """Return a fit, or that with K, if K explains the same threes as well.

        Before a plane that is seen squarely a focal length walks away, three by three, and seems
        to be known where it has come to, not where it should be.
        """
        assert self._map is not None
        known, start = self._known.copy(), fit.numbers.copy()
        known[_OF_K], start[_OF_K] = np.maximum(known[_OF_K], self._usual**-2.0), 0.0
        given = [_Three(self._exposure, three.posed, self._map, 0.0) for three in threes]
        with_k = self._fitted(given, start, np.zeros(2), known)
        variance = max(fit.variance, self._least_variance(threes))
        worse = with_k.cost(variance) - fit.cost(variance)
        if worse > (_DOUBTFULLY * fit.wider) ** 2:
            return fit, threes, principal
        return with_k, given, np.zeros(2)

    def _from_anywhere(self, posed: Sequence[Sequence[Fitted]]) -> tuple[_Fit, list[_Three], Array]:
        """Return a fit from other focal lengths, as each frame may hide what is wrong."""
        assert self._map is not None
        camera, fits = self._exposure.cameras[0], list[tuple[_Fit, list[_Three], Array]]()
        for principal in (np.zeros(2), centre_of(camera) / camera.focal_length):
            for length in (0.0, *map(math.log, _LENGTHS)):
                threes = [_Three(self._exposure, each, self._map, length) for each in posed]
                start = length * np.eye(_SHARED)[_LENGTH]
                fits.append((self._fitted(threes, start, principal), threes, principal))
                best = min(fits, key=lambda each: each[0].cost(self._least_variance(threes)))
                if self._fits(*best[:2]):
                    return best
        return best

    def _fits(self, fit: _Fit, threes: Sequence[_Three]) -> bool:
        """Return whether no more is left than frames leave, and no lens or map is impossible.

        Frames that leave more than points may have errors that nobody knows, unless together they
        leave less.
        """
        own = float(np.median([three.variance for three in threes]))
        own = min(own, self._most_variance)
        squared = (fit.numbers**2 * self._known)[_LENS.start :]
        near = fit.variance < _AS_GOOD * max(own, self._least_variance(threes))
        return bool(near and squared.max() < _SURELY**2)

    def _least_variance(self, threes: Sequence[_Three]) -> float:
        of_map = self._map_deviation * self._exposure.cameras[0].focal_length / threes[-1].depth
        return float(_LEAST_NOISE**2 + of_map**2)

    def _fitted(
        self, threes: Sequence[_Three], start: Array, principal: Array, known: Array | None = None
    ) -> _Fit:
        """Return the fit of all threes, which move there.

        ``known`` (11,): information that counts instead of what is known before any frame.
        """
        numbers, least = start, self._least_variance(threes)
        known = self._known if known is None else known
        covariance: Array = np.diag(1.0 / known)
        for _ in range(_ROUNDS):
            for three in threes:
                three.linearize(numbers, principal, least)
            information, slope = _summed(threes, known, numbers)
            try:
                covariance[:] = np.linalg.inv(information + np.diag(self._known - known))
                step = -np.linalg.solve(information + _DAMPING, slope)
            except np.linalg.LinAlgError:
                break
            farthest = float(np.abs(step[:3]).max())
            if not math.isfinite(farthest):
                break
            numbers = numbers + step * min(1.0, _MOST_STEP / farthest)
            poses = max(np.abs(there.step[:_STAMP]).max() for there in _linear(threes))
            near = np.abs(step) < _NEAR * np.sqrt(np.diag(covariance))
            if near.all() and poses < _LEAST_STEP:
                break
        linear = _linear(threes)
        squared = np.concatenate([there.squared_errors for there in linear])
        wider = _ALIKE * _disagreement(linear, numbers)
        unlikely = known @ numbers**2 + sum(three.known @ three.own**2 for three in threes)
        return _Fit(numbers, wider * np.sqrt(np.diag(covariance)), wider, squared, float(unlikely))

    def _least(self) -> int:
        """Return the three without which the focal length is known best."""
        every = [three.equations.information for three in self._threes if three.equations]
        total = np.diag(self._known) + sum(every)
        without = [np.linalg.inv(total - one)[_LENGTH, _LENGTH] for one in every]
        return int(np.argmin(without))


class CamerasTogether:
    """Compares the cameras of a rig with each other, by the last frames together.

    The motion of one frame takes up a part of what one of its cameras has wrong. Mounts, focal
    lengths and clocks stay as they are while the motion changes: each frame has its motion for
    itself, and shares these numbers with all others.

    Args:
        rig: as it is said to be.
        config: with the deviations of the calibrations.
    """

    def __init__(self, rig: Rig, config: LocalizerConfig) -> None:
        self.rig, count = rig, _OF_CAMERA * len(rig.cameras)
        self._usual = np.array([*_OF_MOUNT, math.hypot(_USUAL, config.calibration.focal_length),
                                _OF_CLOCK])  # fmt: skip
        self._equations, self._count = np.zeros((count + 1, count + 1)), 0
        self._off: list[tuple[str, Array]] = []
        self.fault = ""
        """The camera that frames show to be wrong, and what it has, in one sentence."""

    def add(self, found: Estimate, terms: PriorTerms, sights: FrameSights) -> None:
        """Take a frame of a rig with a pose, and what is known of its motion beside it."""
        exposure, usable = sights.exposure, sights.usable
        if exposure.lenses is None:
            return
        fitting = np.flatnonzero(np.asarray(found.inliers)[usable.indices])
        seen = sights.observations.only(fitting)
        state = state_in(found, usable.centre)
        lines = linearized(seen.packed, len(seen), state, shake_at(seen.tau, found.shake))
        tau, by_pose = seen.tau[:, None], lines.by_motion[:, :, POSE]
        way = state[POSE_SIZE:].reshape(2, 6)
        own = np.concatenate([
            by_pose, (seen.by_ray @ lines.image[:, :, None]),
            by_pose @ (way[0] + tau * way[1])[:, :, None] / exposure.span,
        ], axis=2)  # fmt: skip
        places = np.array([list(self.rig.cameras).index(name) for name in exposure.names])
        columns = np.zeros((len(seen), 2, len(self.rig.cameras), _OF_CAMERA))
        columns[np.arange(len(seen)), :, places[exposure.lenses[seen.camera]]] = own
        rows = np.concatenate(
            [lines.by_motion, columns.reshape(len(seen), 2, -1), lines.errors[:, :, None]], axis=2
        ).reshape(2 * len(seen), -1)
        if not np.isfinite(rows).all():  # of an absurd motion
            return
        best, _, rank, _ = np.linalg.lstsq(rows[:, :-1], rows[:, -1])
        left = float(np.square(rows[:, -1] - rows[:, :-1] @ best).sum())
        variance = max(left / max(len(rows) - rank, 1), _LEAST_NOISE**2)
        every, of_motion = rows.T @ rows / variance, np.r_[:PARAMETERS, rows.shape[1] - 1]
        every[np.ix_(of_motion, of_motion)] += known_at(terms, state).form
        motion, rest = slice(PARAMETERS), slice(PARAMETERS, None)
        gain = np.linalg.solve(every[motion, motion], every[motion, rest])
        self._equations = _KEPT_OF_CAMERAS * self._equations + every[rest, rest]
        self._equations -= every[rest, motion] @ gain
        self._count += 1
        if self._count >= FRAMES:
            said = [self._against(reference) for reference in range(len(self.rig.cameras))]
            self._off = min(said, key=len)
            of = f", seen from {list(self.rig.cameras)[said.index(self._off)]}: {_REMEDY}"
            has = ", ".join(text for text, _ in self._off)
            self.fault = f"successive frames fit if {has}{of}" if has else ""

    def widened(self, found: Estimate) -> Estimate:
        """Return a frame whose pose may be that of any camera, if one contradicts the others."""
        speeds = np.concatenate([found.angular_velocity, found.linear_velocity]) / found.span
        covariance = found.calibration_covariance.copy()
        for _, numbers in self._off:
            step = numbers[POSE] + numbers[_LATE] * speeds
            covariance[POSE, POSE] += np.outer(step, step)
        return replace(found, calibration_covariance=covariance) if self._off else found

    def _against(self, reference: int) -> list[tuple[str, Array]]:
        """Name what cameras have wrong, with their numbers, if mount and clock of one are right."""
        known = np.tile(_ANY_CAMERA**-2.0, (len(self.rig.cameras), 1))
        known[reference, [*range(6), _LATE]] = _EXACT**-2
        information = self._equations[:-1, :-1] + np.diag(known.ravel())
        covariance = np.linalg.inv(information)
        numbers, texts = -covariance @ self._equations[:-1, -1], []
        for k, (name, (axes, moved)) in enumerate(self.rig.camera_from_rig.items()):
            own = slice(_OF_CAMERA * k, _OF_CAMERA * (k + 1))
            by = np.eye(_OF_CAMERA)
            by[3:6, :3] = so3.hat(axes.T @ moved)  # of the camera's centre, where the rig turns
            off, spread = by @ numbers[own], by @ covariance[own, own] @ by.T
            spread = _ALIKE**2 * spread + np.diag(self._usual**2)
            beyond = [
                off[part] @ np.linalg.solve(spread[part, part], off[part]) > _BEYOND_USUAL**2
                for part in (slice(3), slice(3, 6), slice(6, 7), slice(7, 8))
            ]
            late = "later" if off[_LATE] > 0.0 else "earlier"
            said = (
                f"rotated by {math.degrees(np.linalg.norm(off[:3])):.2g} deg",
                f"{np.linalg.norm(off[3:6]):.2g} m from its mount",
                f"of a focal length {math.exp(off[6]):.3g} times K's",
                f"exposed {abs(1e3 * off[_LATE]):.2g} ms {late} than its stamps say",
            )
            if has := " and ".join(compress(said, beyond)):
                texts.append((f"{name} is {has}", numbers[own]))
        return texts


def _linear(threes: Sequence[_Three]) -> list[_Equations]:
    return [three.equations for three in threes if three.equations]


def _summed(threes: Sequence[_Three], known: Array, numbers: Array) -> tuple[Array, Array]:
    """Return information (11,11) and slope (11,) of all threes and what is known, there."""
    information: Array = np.diag(known)
    slope = known * numbers
    for there in _linear(threes):
        information = information + there.information
        slope = slope + there.slope + there.information @ (numbers - there.numbers)
    return information, slope


def _disagreement(threes: Sequence[_Equations], numbers: Array) -> float:
    """Return by how much threes scatter about common numbers, over what their equations say.

    At least 1. What vibrates moves otherwise within its images than between them, each time by
    another amount, and looks like another focal length each time.
    """
    if len(threes) < 2:
        return 1.0
    some, square = slice(0, _LENS.start), 0.0
    for there in threes:
        pull = (there.slope + there.information @ (numbers - there.numbers))[some]
        square += float(pull @ np.linalg.pinv(there.information[some, some]) @ pull)
    return math.sqrt(max(square / (_LENS.start * (len(threes) - 1)), 1.0))


def _frames(exposure: Exposure, posed: Sequence[Fitted], map_: _Landmarks) -> list[_Linked]:
    times = np.array([1e-9 * (each.time_ns - posed[0].time_ns) for each in posed]) / exposure.span
    frames = []
    for k, each in enumerate(posed):
        some = np.flatnonzero(each.found.inliers)
        some = some[:: 1 + len(some) // _MOST]
        points, pixels = map(np.ascontiguousarray, (each.points[some], each.pixels[some]))
        usable = find_usable(exposure, points, pixels, [len(pixels)], None)
        near = usable._replace(centre=map_.centre)
        others = sorted({0, 1, 2} - {k})
        interval = 0.5 * (times[2] - times[0])
        shifted = interval * np.array([(each == 1) - float(k == 1) for each in others])
        seen = packed(exposure, points, near)
        frames.append(_Linked(
            seen.points, seen.rays, seen.tau, seen.by_ray, seen.camera, seen.mounts,
            (others[0], others[1]), times[others] - times[k], shifted, map_.modes(seen.points),
        ))  # fmt: skip
    return frames


def _variance(squared: Array) -> float:
    """Return the variance (px^2) of one coordinate, by the median of squared errors."""
    return max(float(np.median(squared)) / _OF_MEDIAN, _LEAST_NOISE**2)
