# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The cost of a trajectory and its normal equations, on whitened errors."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.camera import Camera
from rs_localizer.trajectory.banded import Factored, Undetermined
from rs_localizer.trajectory.bodies import Pieces, paper_covariance
from rs_localizer.trajectory.gyro import MOUNT
from rs_localizer.trajectory.gyro_terms import GyroTerms
from rs_localizer.trajectory.lens import lens_prior, project
from rs_localizer.trajectory.model import Freedom, Observations, State
from rs_localizer.trajectory.normal_kernels import (
    Normal,
    accumulate,
    add_accelerations,
    add_rest,
    eliminate_stamps,
)
from rs_localizer.trajectory.sight_kernels import (
    EXTRINSICS,
    Curve,
    Sights,
    Terms,
    look,
    squared_errors,
)
from rs_localizer.trajectory.spline_kernels import CONTROL, LOCAL

LIMIT = 6.0
"""Tukey's limit in standard deviations: 97 % efficient on Gaussian noise in two dimensions."""
# Errors beyond so many standard deviations do not count for the scale of the noise.
_SCALE_LIMIT = 4.0
# Median of a squared error in two dimensions, in variances.
_MEDIAN = 2.0 * np.log(2.0)
_LOOSE_BODY = 100.0  # m, rad
# Kernels and OpenCV leave the interpreter free for each other.
_PARTS = 2
# What parts of a recording add to the normal equations.
_SUMS = tuple(name for name in Normal._fields if name != "image_first")

_Done = TypeVar("_Done")
Step = tuple[Array, Array]
"""Of the controls (6 n,) and of the border (b,)."""


class Problem:
    """The cost of what one camera sees and its normal equations."""

    def __init__(
        self, camera: Camera, observations: Observations, start: State, freedom: Freedom
    ) -> None:
        self.camera, self.observations, self.freedom = camera, observations, freedom
        self.lens_prior = lens_prior(camera, freedom.lens_deviations)
        # The parts are always the same, whatever the number of workers: so is every sum.
        edges = np.linspace(0, len(observations.times), _PARTS + 1).astype(int)
        self._parts = [slice(a, b) for a, b in pairwise(edges.tolist())]
        self._workers = ThreadPoolExecutor(_PARTS)  # of its own: threads do not survive a fork
        self._last: tuple[State, Curve, list[Sights]] | None = None
        self.lens_count = len(start.lens) if freedom.lens else 0
        self.pieces = _pieces(observations, freedom)
        self.shape_information: Array | None = None
        if freedom.paper and self.pieces.count:
            landmarks = observations.landmarks[self.pieces.slots >= 0]
            covariance = paper_covariance(landmarks, freedom.landmarks)
            self.shape_information = np.asarray(np.linalg.inv(covariance), np.float64)
        readout = 1 if freedom.readout_time else 0
        extrinsics = 0 if freedom.mounting is None else EXTRINSICS
        self.border = readout + self.lens_count + extrinsics + self.pieces.columns
        self.gyro: GyroTerms | None = None
        if observations.gyro is not None and start.mount is not None:
            self.gyro = GyroTerms(observations.gyro, start, self.border)
            self.border += MOUNT
        self.lens_column = readout if self.lens_count else -1
        self.mount_column = readout + self.lens_count if extrinsics else -1
        self.point_column = readout + self.lens_count + extrinsics if self.pieces.count else -1

    @property
    def point_columns(self) -> slice:
        """Where the landmarks stand in a step of the border."""
        return slice(self.point_column, self.point_column + self.pieces.columns)

    def look(self, state: State) -> tuple[Curve, list[Sights]]:
        """The spline, and all keypoints on it in so many parts of the recording."""
        if self._last is None or self._last[0] is not state:
            spline = state.spline
            curve = Curve(
                spline.rotations, spline.positions, *spline.steps(), float(spline.layout.spacing)
            )
            arms = self.pieces.arms(state.landmarks)
            parts = self.each(lambda part: self._part(state, curve, arms, part), self._parts)
            self._last = state, curve, parts
        return self._last[1:]

    def each(self, work: Callable[..., _Done], *parts: list[Any]) -> list[_Done]:
        """What comes of work on the parts of the recording, which threads share."""
        return list(self._workers.map(work, *parts))

    def _part(self, state: State, curve: Curve, arms: Array, part: slice) -> Sights:
        observations = self.observations
        tau, points, frames = (
            observations.row_times[part],
            observations.points[part],
            observations.frames[part],
        )
        mounted = state.extrinsics
        times = (
            observations.times[part]
            + state.delays[frames]
            + state.readout_time * tau
            + mounted.offset
        )
        first, u = state.spline.layout.locate(times)
        local, velocity = np.empty((len(first), 3)), np.empty((len(first), 3))
        axes, centre = mounted.axes, mounted.centre
        look(curve, first, u, state.landmarks[points], axes, centre, local, velocity)
        ahead = np.where(local[:, 2:] > 0.0, local, (0.0, 0.0, 1.0))
        seen_as = project(self.camera, state.lens, ahead, self.lens_column >= 0)
        return Sights(
            first, u, tau, local, velocity, seen_as.pixels - observations.pixels[part],
            seen_as.by_ray, seen_as.by_lens, self.pieces.slots[points], arms[points], frames,
            axes, centre,
        )  # fmt: skip

    def terms(self, state: State, deviation: float) -> Terms:
        return Terms(
            float(state.readout_time),
            self.camera.row_time_gradient,
            self.freedom.readout_time,
            self.lens_column >= 0,
            self.mount_column >= 0,
            self.point_column,
            self.pieces.width,
            self.freedom.stamps > 0.0,
            deviation**2,
            (LIMIT * deviation) ** 2,
        )

    def errors(self, state: State) -> Array:
        """Squared whitened errors (n,), px^2."""
        terms, squared = self.terms(state, 1.0), []
        for sights in self.look(state)[1]:
            squared.append(np.empty(len(sights.first)))
            squared_errors(sights, terms, squared[-1])
        return np.concatenate(squared)

    def normal(self, state: State, deviation: float, motion: bool = True) -> tuple[float, Normal]:
        """Cost and normal equations; without ``motion`` others add what is expected of it."""
        curve, parts = self.look(state)
        terms = self.terms(state, deviation)
        normals = self._empty(len(state.spline.positions), parts, len(state.delays))
        costs = self.each(
            lambda sights, normal: accumulate(curve, sights, terms, normal), parts, normals
        )
        cost, normal = sum(costs), normals[0]
        for other in normals[1:]:
            for field in _SUMS:
                getattr(normal, field)[:] += getattr(other, field)
        if motion:
            cost += self.expected_motion(state, normal)
        cost += self._add_priors(state, normal)
        if self.gyro is not None:
            cost += self.gyro.add(state, normal)
        if self.freedom.stamps > 0.0:
            eliminate_stamps(normal)
        return cost, normal

    def expected_motion(self, state: State, normal: Normal) -> float:
        """Add what is known of the motion beforehand; returns its cost."""
        curve, layout = self.look(state)[0], state.spline.layout
        expected = self.freedom.accelerations(layout.spacing)
        cost: float = add_accelerations(curve, layout.firsts, expected, normal)
        alone = layout.alone()
        if len(alone) and self.freedom.angular_velocity < math.inf:
            cost += add_rest(
                curve, alone, float(self.freedom.angular_velocity),
                float(self.freedom.linear_velocity), normal,
            )  # fmt: skip
        return cost

    def _empty(self, controls: int, parts: list[Sights], images: int) -> list[Normal]:
        """Normal equations of zeros for each part, of the same shape."""
        free = self.freedom.stamps > 0.0
        first, last = np.full(images, controls), np.zeros(images, np.int64)
        for sights in parts if free else ():
            np.minimum.at(first, sights.frames, sights.first)
            np.maximum.at(last, sights.frames, sights.first)
        width = LOCAL + CONTROL * int(np.max(last - first, initial=0))
        # The last images have no more controls behind them.
        first = np.minimum(first, max(controls - width // CONTROL, 0))
        count, images, border = CONTROL * controls, images if free else 0, self.border
        return [
            Normal(
                np.zeros((width, count)), np.zeros((count, border)), np.zeros((border, border)),
                np.zeros(count), np.zeros(border), first[:images], np.zeros((images, width)),
                np.zeros((images, border)), np.zeros(images), np.zeros(images),
            )
            for _ in parts
        ]  # fmt: skip

    def _add_priors(self, state: State, normal: Normal) -> float:
        """What is known of lens and landmarks beforehand."""
        cost = 0.0
        diagonal = np.arange(self.border)
        if self.lens_column >= 0:
            offset = state.lens - self.lens_prior.mean
            pull = self.lens_prior.information @ offset
            at = slice(self.lens_column, self.lens_column + self.lens_count)
            normal.border_slope[at] += pull
            normal.corner[at, at] += np.tril(self.lens_prior.information)
            cost += float(offset @ pull)
        if self.freedom.mounting is not None:
            offset = state.extrinsics.beside(self.freedom.mounting.given)
            precisions = self.freedom.mounting.deviations**-2.0
            at = slice(self.mount_column, self.mount_column + EXTRINSICS)
            normal.border_slope[at] += precisions * offset
            normal.corner[diagonal[at], diagonal[at]] += precisions
            cost += float(precisions @ offset**2)
        if self.point_column >= 0 and not self.pieces.rigid:
            free = self.pieces.slots >= 0
            offset = (state.landmarks - self.observations.landmarks)[free].ravel()
            at = self.point_columns
            if self.shape_information is not None:
                pull = self.shape_information @ offset
                normal.corner[at, at] += np.tril(self.shape_information)
            else:
                pull = offset / self.freedom.landmarks**2
                normal.corner[diagonal[at], diagonal[at]] += self.freedom.landmarks**-2
            normal.border_slope[at] += pull
            cost += float(offset @ pull)
        if self.pieces.rigid:  # a body none of whose landmarks fits stays where it is
            at = self.point_columns
            normal.corner[diagonal[at], diagonal[at]] += _LOOSE_BODY**-2
        if self.freedom.stamps > 0.0:
            normal.image_information[:] += self.freedom.stamps**-2
            normal.image_slope[:] += state.delays * self.freedom.stamps**-2
            cost += float(np.sum((state.delays / self.freedom.stamps) ** 2))
        return cost

    def moved(self, state: State, normal: Normal, step: Step) -> State:
        """The state after a step that these normal equations led to."""
        controls, border = step
        readout_time, lens, landmarks = state.readout_time, state.lens, state.landmarks
        if self.freedom.readout_time:
            readout_time = readout_time + float(border[0])
        if self.lens_column >= 0:
            lens = lens + border[self.lens_column : self.lens_column + self.lens_count]
        if self.point_column >= 0:
            landmarks = self.pieces.moved(landmarks, border[self.point_columns])
        delays, mount, extrinsics = state.delays, state.mount, state.extrinsics
        if self.mount_column >= 0:
            extrinsics = extrinsics.moved(border[self.mount_column :][:EXTRINSICS])
        if self.gyro is not None and mount is not None:
            mount = self.gyro.moved(mount, border)
        if self.freedom.stamps > 0.0:
            width = normal.image_controls.shape[1]
            own = controls[CONTROL * normal.image_first[:, None] + np.arange(width)]
            pull = np.einsum("gk,gk->g", normal.image_controls, own) + normal.image_border @ border
            delays = delays - (normal.image_slope + pull) / normal.image_information
        return State(
            state.spline.moved(controls), readout_time, lens, landmarks, delays, mount, extrinsics
        )

    def trusted(self, start: State) -> Problem:
        """The same with the trusted keypoints only."""
        observations = self.observations
        return Problem(self.camera, observations.subset(observations.trusted), start, self.freedom)

    def images(self, inliers: BoolArray) -> int:
        """How many images have some of these keypoints (n,)."""
        return len(np.unique(self.observations.frames[inliers]))


class RigNormal(NamedTuple):
    """The normal equations of a rig."""

    whole: Normal
    own: list[Normal]  # of each camera


class RigProblem:
    """The cost of one motion that several cameras see; borders and keypoints stand in their order.

    Args:
        cameras: one or more, of which the first has what is expected of the motion.
        noises: (k,) px, of each camera's keypoints; they keep their ratios (None: all alike).
        one_map: the free landmarks are the same of all; they come last, once.
    """

    def __init__(
        self, cameras: list[Problem], noises: Array | None = None, one_map: bool = False
    ) -> None:
        noises = np.ones(len(cameras)) if noises is None else noises
        self.cameras, self.ratios, self._one_map = cameras, noises / noises[0], one_map
        self.camera, self.freedom = cameras[0].camera, cameras[0].freedom
        points = cameras[0].pieces.columns if one_map else 0
        ends = np.cumsum([0, *(camera.border - points for camera in cameras)])
        self.border = int(ends[-1]) + points
        shared = np.arange(ends[-1], self.border)
        # Where each camera's border stands in that of all.
        self.columns = [np.r_[np.arange(a, b), shared] for a, b in pairwise(ends.tolist())]
        self._last: tuple[State, list[State]] | None = None

    def states(self, state: State) -> list[State]:
        """Those of the cameras, of one spline."""
        if self._last is None or self._last[0] is not state:
            others = [replace(other, spline=state.spline) for other in state.others]
            self._last = state, [state, *others]
        return self._last[1]

    def normal(self, state: State, deviation: float) -> tuple[float, RigNormal]:
        """Cost and normal equations."""
        cost, own = 0.0, list[Normal]()
        for camera, one, ratio in zip(self.cameras, self.states(state), self.ratios, strict=True):
            added, normal = camera.normal(one, deviation * float(ratio), motion=not own)
            own.append(normal)
            cost += added
        if len(own) == 1:
            return cost, RigNormal(own[0], own)
        count = len(own[0].slope)
        whole = own[0]._replace(
            band=np.zeros((max(len(normal.band) for normal in own), count)),
            cross=np.zeros((count, self.border)),
            corner=np.zeros((self.border, self.border)),
            slope=np.zeros(count),
            border_slope=np.zeros(self.border),
        )
        for normal, at in zip(own, self.columns, strict=True):
            whole.band[: len(normal.band)] += normal.band
            whole.slope[:] += normal.slope
            whole.cross[:, at] += normal.cross
            whole.corner[np.ix_(at, at)] += normal.corner
            whole.border_slope[at] += normal.border_slope
        return cost, RigNormal(whole, own)

    def step(self, normal: RigNormal, damping: float) -> Step:
        """Levenberg's; raises Undetermined when the equations are not positive definite."""
        return Factored(normal.whole, damping).step()

    def moved(self, state: State, normal: RigNormal, step: Step) -> State:
        """The state after a step that these normal equations led to."""
        first, *others = (
            camera.moved(one, own, (step[0], step[1][at]))
            for camera, one, own, at in zip(
                self.cameras, self.states(state), normal.own, self.columns, strict=True
            )
        )
        return replace(first, others=tuple(others))

    def errors(self, state: State) -> Array:
        """Squared whitened errors (n,), px^2 of the first camera."""
        parts = zip(self.cameras, self.states(state), self.ratios, strict=True)
        return np.concatenate([camera.errors(one) / ratio**2 for camera, one, ratio in parts])

    def noise(self, state: State, deviation: float) -> float:
        """Standard deviation of the noise, px of the first camera."""
        return max(noise_of(self.errors(state), deviation), self.freedom.least_noise)

    def trusted(self, start: State) -> RigProblem:
        """The same with the trusted keypoints only."""
        pairs = zip(self.cameras, self.states(start), strict=True)
        cameras = [camera.trusted(one) for camera, one in pairs]
        return RigProblem(cameras, self.ratios, self._one_map)

    def images(self, inliers: BoolArray) -> int:
        """How many images of all cameras have some of these keypoints (n,)."""
        counts = np.cumsum([len(camera.observations.times) for camera in self.cameras])
        parts = np.split(inliers, counts[:-1])
        return sum(camera.images(own) for camera, own in zip(self.cameras, parts, strict=True))


def noise_of(squared: Array, deviation: float) -> float:
    """Standard deviation of the noise, from squared errors (n,) that are not far off the last one.

    Raises:
        Undetermined: when there are none.
    """
    near = squared[squared < (_SCALE_LIMIT * deviation) ** 2]
    if len(near) == 0:
        raise Undetermined("no keypoint agrees with the motion of the frames")
    return float(np.sqrt(np.median(near) / _MEDIAN))


def _pieces(observations: Observations, freedom: Freedom) -> Pieces:
    """What is free of the map: bodies, or the landmarks that are seen."""
    if observations.bodies is not None:
        return Pieces(observations.bodies, rigid=True)
    slots = np.full(len(observations.landmarks), -1)
    if freedom.landmarks > 0.0:
        landmarks = np.unique(observations.points)
        slots[landmarks] = np.arange(len(landmarks))
    return Pieces(slots, rigid=False)
