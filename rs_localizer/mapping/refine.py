# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A map refined with the rolling shutter that saw it: bundle adjustment in continuous time.

Landmarks are free, the motion is a spline, each keypoint is seen at the time of its own row. An
adjustment with a global shutter bends the map by what the camera moved while its rows were read.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.mapping.adjustment import MapProblem, apply_similarity, sights_of
from rs_localizer.mapping.cluster_robust import Pull, pull_at_landmarks
from rs_localizer.mapping.initial_trajectory import (
    ANGULAR_VELOCITY,
    LINEAR_VELOCITY,
    acceleration_prior,
    initial_trajectory,
)
from rs_localizer.mapping.observations import (
    LEAST_KEYPOINTS,
    MapFreedom,
    MapObservations,
    Start,
    check,
    shared_landmarks,
)
from rs_localizer.mapping.readout_check import ReadoutCheck, readout_check
from rs_localizer.trajectory.banded import Undetermined
from rs_localizer.trajectory.descent import settle
from rs_localizer.trajectory.fit import inflation_of, left_over, steepness
from rs_localizer.trajectory.lens import with_lens
from rs_localizer.trajectory.model import Freedom, Observations, start_state
from rs_localizer.trajectory.online_readout import REVERSED
from rs_localizer.trajectory.problem import LIMIT, Problem
from rs_localizer.trajectory.spline import LONGEST_GAP, Spline
from rs_localizer.trajectory.spline_kernels import CONTROL

# Beyond so many unknowns of the motion its matrix takes more than 2 GB.
_MOST_UNKNOWNS = 15000
# Landmarks are held to where they were by the map's size, which says nothing, but for those that
# hardly any image sees.
_LOOSE = 1.0
# So many landmarks of known place hold the map's frame and size.
_LEAST_ANCHORS = 3
# Images in a row that may tell the readout time.
_LEAST_STRETCH = 20


class Preparation:
    """The keypoints that count, and the first motion."""

    def __init__(
        self, camera: Camera, seen: MapObservations, start: Start, freedom: MapFreedom,
        stamp_offset: float,
    ) -> None:  # fmt: skip
        self.camera, self.seen, self.start, self.freedom = camera, seen, start, freedom
        self.start_ns = int(seen.stamps_ns[0])
        delay = stamp_offset - camera.readout_time * camera.first_row_time
        self.times = np.asarray(1e-9 * (seen.stamps_ns - self.start_ns) + delay, np.float64)
        self.size = float(np.linalg.norm(np.ptp(start.points, axis=0)))
        self.deviations, self.floating = self._known()
        self.used = self._usable()
        self.spline = self._spline()
        if freedom.readout_time:
            self._check_stretches()
        held = CONTROL * len(self.spline.positions)
        if held > _MOST_UNKNOWNS:
            raise ValueError(
                f"{len(self.times)} images have {held} unknowns of motion, at most "
                f"{_MOST_UNKNOWNS} can be refined at once: leave images out"
            )

    def _known(self) -> tuple[Array, bool]:
        """Deviations (p,) of the landmarks, m, and whether nothing holds the whole."""
        given = self.freedom.deviations
        if given is None:
            given = np.full(len(self.start.points), np.inf)
        anchors = np.count_nonzero(np.isfinite(given))
        if 0 < anchors < _LEAST_ANCHORS:
            raise ValueError(
                f"{anchors} landmarks of known place do not fix a map: give none, or at least "
                f"{_LEAST_ANCHORS}"
            )
        return np.minimum(given, _LOOSE * self.size), anchors == 0

    def _usable(self) -> BoolArray:
        """Keypoints (n,) that say something of map or motion."""
        shared = np.zeros(len(self.start.points), np.bool_)
        found = shared_landmarks(self.seen)
        shared[: len(found)] = found
        if self.freedom.deviations is not None:
            shared |= np.isfinite(self.freedom.deviations)
        used = shared[self.seen.landmarks]
        counts = np.bincount(self.seen.images[used], minlength=len(self.times))
        return used & (counts >= LEAST_KEYPOINTS)[self.seen.images]

    def _spline(self) -> Spline:
        """Through the images with keypoints: stretches where they follow each other."""
        own = np.unique(self.seen.images[self.used])
        return initial_trajectory(
            self.times[own], self.start.rotations[own], self.start.positions[own],
            self.camera.readout_time,
        )  # fmt: skip

    def _check_stretches(self) -> None:
        """Raise ValueError when the readout time cannot be found."""
        if not self.tells_readout:
            raise ValueError(
                f"estimating the readout time needs {_LEAST_STRETCH} images in a row, at most "
                f"{LONGEST_GAP} s apart; there are {self._longest()}: give it, or more of the "
                "recording"
            )

    @property
    def tells_readout(self) -> bool:
        """Images on their own tell turn and way per readout only, and not how long it takes."""
        return self._longest() >= _LEAST_STRETCH

    def _longest(self) -> int:
        """Images in the longest stretch."""
        own = self.times[np.unique(self.seen.images[self.used])]
        return int(np.bincount(self.spline.layout.stretches(own)).max())

    def observations(self) -> Observations:
        images, pixels = self.seen.images[self.used], self.seen.pixels[self.used]
        return Observations(
            times=self.times[images],
            row_times=self.camera.row_time(pixels),
            pixels=pixels,
            landmarks=self.start.points,
            points=self.seen.landmarks[self.used],
            frames=images,
            trusted=np.ones(len(images), np.bool_),
        )


__all__ = ["MapFreedom", "MapObservations", "RefinedMap", "Start", "refine"]

# A landmark that is not known to this part of the map's size is not refined.
_KNOWN = 0.1
# Nor one that is known worse than to so many times what landmarks usually moved by: seen from one
# side only, it would be farther off than where it was.
_WORTH = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class RefinedMap:
    """Landmarks and motion, with what is known of their errors."""

    points: Array  # (p,3) m
    covariances: Array  # (p,3,3) m^2; NaN where not refined
    refined: BoolArray  # (p,) others are where they were given
    sights: IntArray  # (p,) keypoints that fit
    camera: Camera  # with the readout time and the lens that were found
    readout_time: float  # s; negative: against the scan direction
    readout_time_deviation: float  # s; NaN where it was given
    readout_check: ReadoutCheck | None  # of a given one; None: the images do not tell, or found
    deviation: float  # px, of the noise of u and of v
    squared_errors: Array  # (n,) px^2, whitened; infinite for keypoints that took no part
    inliers: BoolArray  # (n,)
    before: float  # px, noise that the map left as it was given
    after: float  # px, noise that it leaves now, likewise
    spline: Spline  # s since ``start_ns``
    start_ns: int
    times: Array  # (g,) s, of the images' middle rows
    tells_readout: bool  # images follow each other closely enough to tell the readout time

    @property
    def camera_as_found(self) -> Camera:
        """The camera, its scan direction reversed where the readout time is negative."""
        if self.readout_time >= 0.0:
            return self.camera
        direction = REVERSED[ScanDirection(self.camera.scan_direction)]
        return replace(self.camera, scan_direction=direction)

    def poses(self) -> tuple[Array, Array]:
        """map_from_camera (g,3,3), (g,3) at the images' middle rows."""
        states = self.spline.states(self.times)
        return states.rotations, states.positions


def refine(
    camera: Camera,
    seen: MapObservations,
    start: Start,
    freedom: MapFreedom | None = None,
    *,
    stamp_offset: float = 0.0,
    done: Callable[[str], object] = lambda text: None,
) -> RefinedMap:
    """The most likely map and motion.

    Args:
        camera: its lens, scan direction and readout time (0: a global shutter).
        seen: keypoints of landmarks; those of landmarks that one image alone sees do not count.
        start: first guess; without landmarks of known places the map as a whole, its size too,
            stays where this has it.
        freedom: what is estimated beside (default: landmarks and motion only).
        stamp_offset: s from a stamp to the first row's exposure.
        done: called with each part of the work that is done.

    Raises:
        ValueError: when the images make no single map, or are too many.
    """
    freedom = freedom or MapFreedom()
    check(seen, len(start.points))
    prepared = Preparation(camera, seen, start, freedom, stamp_offset)
    try:
        return _Refinement(prepared).solved(done)
    except Undetermined as error:
        raise ValueError(f"the map cannot be refined: {error}") from error


class _Refinement:
    """One map on its way."""

    def __init__(self, prepared: Preparation) -> None:
        self.prepared, self.camera = prepared, prepared.camera
        self.observations = prepared.observations()
        self.state = start_state(
            self.camera, self.observations, prepared.spline, self.camera.readout_time
        )
        given = prepared.freedom
        self.freedom = Freedom(
            readout_time=given.readout_time,
            lens=given.lens,
            lens_deviations=given.lens_deviations,
            angular_acceleration=given.angular_acceleration,
            linear_acceleration=given.linear_acceleration,
            angular_velocity=ANGULAR_VELOCITY,
            linear_velocity=LINEAR_VELOCITY,
        )

    def solved(self, done: Callable[[str], object]) -> RefinedMap:
        # The motion that goes with the map as it is.
        held = replace(self.freedom, readout_time=False, lens=False)
        motion = Problem(self.camera, self.observations, self.state, held)
        self.state, before = settle(motion, self.state, motion.noise(self.state, np.inf))
        done("motion")
        problem = self._problem(self.freedom)
        self.state, deviation = settle(problem, self.state, before)
        done("map")
        calmer = acceleration_prior(self.state, self.freedom)
        if calmer is not None:
            self.freedom, problem = calmer, self._problem(calmer)
            self.state, deviation = settle(problem, self.state, deviation)
            done("accelerations")
        return self._result(problem, before, deviation)

    def _problem(self, freedom: Freedom) -> MapProblem:
        return MapProblem(
            self.camera, self.observations, self.state, freedom, self.prepared.deviations,
            self.prepared.floating,
        )  # fmt: skip

    def _result(self, problem: MapProblem, before: float, deviation: float) -> RefinedMap:
        state, prepared, seen = self.state, self.prepared, self.observations
        squared = problem.errors(state)
        inliers = squared < (LIMIT * deviation) ** 2
        sights, images = sights_of(seen, inliers)
        used = _freedoms(state.spline, seen.frames) + 3 * int(np.count_nonzero(images))
        inflation = inflation_of(squared[inliers], deviation, used + problem.motion.border)
        inflation = self._cluster_robust(problem, deviation, inflation)
        placed = apply_similarity(problem, state, deviation, images > 1)
        covariances = inflation * placed.covariances
        spread = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
        refined = (images > 1) & (spread < _KNOWN * prepared.size)
        if prepared.freedom.deviations is None and refined.any():
            moved = np.linalg.norm(placed.points - prepared.start.points, axis=1)
            refined &= spread < _WORTH * np.median(moved[refined])
        all_squared = np.full(len(prepared.used), np.inf)
        all_squared[prepared.used] = squared
        readout_time, free = float(state.readout_time), self.freedom.readout_time
        return RefinedMap(
            points=np.where(refined[:, None], placed.points, prepared.start.points),
            covariances=np.where(refined[:, None, None], covariances, np.nan),
            refined=refined,
            sights=sights,
            camera=with_lens(replace(self.camera, readout_time=abs(readout_time)), state.lens),
            readout_time=readout_time,
            readout_time_deviation=math.sqrt(inflation * placed.shared[0, 0]) if free else math.nan,
            readout_check=self._asked(deviation, inflation),
            deviation=deviation * math.sqrt(left_over(len(inliers), used)),
            squared_errors=all_squared,
            inliers=all_squared < (LIMIT * deviation) ** 2,
            before=before,
            after=deviation,
            spline=placed.spline,
            start_ns=prepared.start_ns,
            times=prepared.times,
            tells_readout=prepared.tells_readout,
        )

    def _cluster_robust(self, problem: MapProblem, deviation: float, independent: float) -> float:
        """The covariances' inflation, with what errors of a second pull together."""
        rows, seen = problem.normal(self.state, deviation)[1].rows, self.observations
        squared = problem.errors(self.state)
        inside = squared[squared < (LIMIT * deviation) ** 2]
        pull = pull_at_landmarks(rows.values[..., -4:], seen.points, seen.times, rows.precisions)
        own = steepness(inside, deviation) ** 2
        own *= left_over(len(inside), _freedoms(self.state.spline, seen.frames))
        return Pull(own * pull.measured, pull.expected).inflation(independent)

    def _asked(self, deviation: float, inflation: float) -> ReadoutCheck | None:
        """Whether a readout time that was given is the one of the images."""
        given = self.camera.readout_time > 0.0 and not self.freedom.readout_time
        if not given or not self.prepared.tells_readout:
            return None
        free = self._problem(replace(self.freedom, readout_time=True))
        try:
            asked = readout_check(free, self.state, deviation)
        except Undetermined:
            return None
        return replace(asked, deviation=math.sqrt(inflation) * asked.deviation)


def _freedoms(spline: Spline, frames: IntArray) -> int:
    """How many numbers of the motion the images determine: a pose each, and an end."""
    stretches = len(spline.layout.starts)
    return CONTROL * min(len(np.unique(frames)) + stretches, len(spline.positions))
