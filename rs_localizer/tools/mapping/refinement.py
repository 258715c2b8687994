# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A map refined with the rolling shutter that saw it: bundle adjustment in continuous time.

Landmarks are free, the motion is a spline, each keypoint is seen at the time of its own row. An
adjustment with a global shutter bends the map by what the camera moved while its rows were read.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import REVERSED, ScanDirection
from rs_localizer.tools.adjust.cluster_robust import Pull, pull_at_landmarks
from rs_localizer.tools.adjust.fit import inflation_of, left_over, steepness
from rs_localizer.tools.adjust.intrinsics import with_lens
from rs_localizer.tools.adjust.problem import Problem, fit_with_noise
from rs_localizer.tools.adjust.reprojection import LIMIT
from rs_localizer.tools.adjust.row_kernels import EXTRINSICS
from rs_localizer.tools.adjust.spline import LONGEST_GAP, Spline
from rs_localizer.tools.adjust.spline_kernels import CONTROL
from rs_localizer.tools.adjust.system import Factored, Undetermined
from rs_localizer.tools.adjust.variables import (
    CameraView,
    Freedom,
    SplineKeypoints,
    Unknowns,
    rig_state,
)
from rs_localizer.tools.mapping.gauge import Similarity, as_held, generators, laid_over, scaled
from rs_localizer.tools.mapping.initial_trajectory import (
    ANGULAR_VELOCITY,
    LINEAR_VELOCITY,
    acceleration_prior,
    following,
    initial_trajectory,
)
from rs_localizer.tools.mapping.map_keypoints import (
    LEAST_KEYPOINTS,
    Adjusted,
    MapFreedom,
    MapObservations,
    RigCamera,
    Start,
    check,
    frame_numbers,
    shared_landmarks,
)
from rs_localizer.tools.readout_belief import ReadoutCheck

# With more unknowns than this the matrix of the motion takes more than 2 GB.
_MOST_UNKNOWNS = 15000
# Landmarks are held to where they were by the map's size, which says nothing, but for those that
# hardly any image sees.
_LOOSE = 1.0
# Landmarks of known place that suffice to hold the frame and size of the map.
_LEAST_ANCHORS = 3
# Images in a row that may tell the readout time.
_LEAST_STRETCH = 20


class Refinement:
    """One map on its way: the keypoints that count, motion, landmarks, and what else is free."""

    def __init__(
        self, rig: Sequence[RigCamera], seen: MapObservations, start: Start, freedom: MapFreedom
    ) -> None:
        self.rig, self.shown, self.given, self.wanted = rig, seen, start, freedom
        self.start_ns = int(seen.stamps_ns.min())
        delays = np.array([one.delay for one in rig])[seen.of_cameras]
        self.times = np.asarray(1e-9 * (seen.stamps_ns - self.start_ns) + delays, np.float64)
        if freedom.apart:  # each alone
            self.times = np.arange(len(delays), dtype=np.float64)
        self.size = float(np.linalg.norm(np.ptp(start.points, axis=0)))
        self.deviations, self.floating = self._known()
        self.used = self._usable()
        self.spline = self._spline()
        if freedom.readout_time and not self.tells_readout:
            raise ValueError(
                f"estimating the readout time needs {_LEAST_STRETCH} images in a row, at most "
                f"{LONGEST_GAP} s apart; there are {self._longest()}: give it, or more of the "
                "recording"
            )
        held = CONTROL * len(self.spline.positions)
        if held > _MOST_UNKNOWNS:
            raise ValueError(
                f"{len(self.times)} images have {held} unknowns of motion, at most "
                f"{_MOST_UNKNOWNS} can be refined at once: leave images out"
            )
        self.seen = self._observations()
        pairs = zip(rig, self.seen, strict=True)
        self.state = rig_state(
            self.spline, ((one.camera, own, one.extrinsics) for one, own in pairs)
        )
        self.freedom = Freedom(
            readout_time=freedom.readout_time,
            lens=freedom.lens,
            lens_deviations=freedom.lens_deviations,
            angular_acceleration=freedom.angular_acceleration,
            linear_acceleration=freedom.linear_acceleration,
            angular_velocity=ANGULAR_VELOCITY,
            linear_velocity=LINEAR_VELOCITY,
        )

    def _known(self) -> tuple[Array, bool]:
        """Return deviations (p,) of the landmarks, m, and whether nothing holds the whole."""
        given = self.wanted.deviations
        if given is None:
            given = np.full(len(self.given.points), np.inf)
        anchors = np.count_nonzero(np.isfinite(given))
        if 0 < anchors < _LEAST_ANCHORS:
            raise ValueError(
                f"{anchors} landmarks of known place do not fix a map: give none, or at least "
                f"{_LEAST_ANCHORS}"
            )
        return np.minimum(given, _LOOSE * self.size), anchors == 0

    def _usable(self) -> BoolArray:
        """Return a mask (n,) of keypoints that constrain map or motion."""
        shared = np.zeros(len(self.given.points), np.bool_)
        found = shared_landmarks(self.shown)
        shared[: len(found)] = found
        if self.wanted.deviations is not None:
            shared |= np.isfinite(self.wanted.deviations)
        used = shared[self.shown.landmarks]
        counts = np.bincount(self.shown.images[used], minlength=len(self.times))
        return used & (counts >= LEAST_KEYPOINTS)[self.shown.images]

    def _spline(self) -> Spline:
        """Return a spline through images with keypoints, of a rig through the frames with most.

        Images that follow each other are one stretch.
        """
        counts = np.bincount(self.shown.images[self.used], minlength=len(self.times))
        frames = frame_numbers(self.times, self.shown.of_cameras)
        order = np.lexsort((-counts, frames))
        firsts = np.unique(frames[order], return_index=True)[1]
        best = order[firsts]
        beyond = np.abs(self.times - self.times[best[frames]])[counts > 0].max()
        best = best[counts[best] > 0]
        extrinsics = [self.rig[k].extrinsics for k in self.shown.of_cameras[best]]
        rotations = self.given.rotations[best] @ np.array([one.axes for one in extrinsics])
        centres = np.array([one.centre for one in extrinsics])
        positions = self.given.positions[best] - np.einsum("gij,gj->gi", rotations, centres)
        longest = max(one.camera.readout_time for one in self.rig) + 2.0 * float(beyond)
        follow = following(self.times[best], rotations)
        return initial_trajectory(self.times[best], rotations, positions, longest, follow)

    @property
    def tells_readout(self) -> bool:
        """Images on their own tell turn and way per readout only, and not how long it takes."""
        return self._longest() >= _LEAST_STRETCH

    def _longest(self) -> int:
        """Return the number of images in the longest stretch."""
        own = self.times[np.unique(self.shown.images[self.used])]
        return int(np.bincount(self.spline.layout.stretches(own)).max())

    def keypoints(self, camera: int) -> BoolArray:
        """Return a mask (n,) of the used keypoints of a camera."""
        return np.asarray(
            self.used & (self.shown.of_cameras[self.shown.images] == camera), np.bool_
        )

    def _observations(self) -> list[SplineKeypoints]:
        """Return the keypoints of each camera."""
        every = []
        for k, one in enumerate(self.rig):
            used = self.keypoints(k)
            images, pixels = self.shown.images[used], self.shown.pixels[used]
            every.append(
                SplineKeypoints(
                    times=self.times[images],
                    row_times=one.camera.row_time(pixels),
                    pixels=pixels,
                    landmarks=self.given.points,
                    points=self.shown.landmarks[used],
                    frames=images,
                    trusted=np.ones(len(images), np.bool_),
                )
            )
        return every

    def problem(self, freedom: Freedom, held: bool = False) -> Problem:
        """Return the problem of map and motion; ``held``: only the motion is free."""
        views = [
            CameraView(one.camera, own, replace(freedom, mounting=None if held else one.mounting))
            for one, own in zip(self.rig, self.seen, strict=True)
        ]
        if held:
            return Problem(views, self.state)
        return Problem(views, self.state, deviations=self.deviations, floating=self.floating)

    def solved(self, done: Callable[[str], object]) -> RefinedMap:
        # The motion that goes with the map as it is.
        held = replace(self.freedom, readout_time=False, lens=False)
        motion = self.problem(held, held=True)
        self.state, before = fit_with_noise(motion, self.state, motion.noise(self.state, np.inf))
        done("motion")
        problem = self.problem(self.freedom)
        self.state, deviation = fit_with_noise(problem, self.state, before)
        done("map")
        calmer = acceleration_prior(self.state, self.freedom)
        if calmer is not None:
            self.freedom, problem = calmer, self.problem(calmer)
            self.state, deviation = fit_with_noise(problem, self.state, deviation)
            done("accelerations")
        return self._result(problem, before, deviation)

    def _of_all(self, name: str) -> NDArray[Any]:
        """Return a field of the observations of all cameras, one after the other."""
        return np.concatenate([getattr(own, name) for own in self.seen])

    def _result(self, problem: Problem, before: float, deviation: float) -> RefinedMap:
        state, count = self.state, len(self.state.landmarks)
        squared = problem.errors(state)
        inliers = squared < (LIMIT * deviation) ** 2
        shown, frames = (self._of_all(name)[inliers] for name in ("points", "frames"))
        sights = np.bincount(shown, minlength=count)
        pairs = np.unique(np.column_stack([shown, frames]), axis=0)
        images = np.bincount(pairs[:, 0], minlength=count)
        used = self._freedoms(state.spline) + 3 * int(np.count_nonzero(images))
        inflation = inflation_of(squared[inliers], deviation, used + problem.border)
        inflation = self._cluster_robust(problem, deviation, inflation)
        factored = Factored(problem.system(state, deviation))
        modes = np.zeros((problem.groups.kept, 0))
        if self.wanted.drifts:
            modes = DRIFT * math.sqrt(inflation) * factored.modes(self.wanted.drifts)
        whole, covariances, shared = _laid(problem, state, factored, images > 1)
        points = whole(state.landmarks)
        covariances *= inflation
        spread = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
        refined = (images > 1) & (spread < _KNOWN * self.size)
        if self.wanted.deviations is None and refined.any():
            moved = np.linalg.norm(points - self.given.points, axis=1)
            refined &= spread < _WORTH * np.median(moved[refined])
        all_squared = np.full(len(self.used), np.inf)
        ends = np.cumsum([len(own.points) for own in self.seen])[:-1]
        for k, own in enumerate(np.split(squared, ends)):
            all_squared[self.keypoints(k)] = own
        found = RefinedMap(
            points=np.where(refined[:, None], points, self.given.points),
            covariances=np.where(refined[:, None, None], covariances, np.nan),
            refined=refined,
            sights=sights,
            cameras=self._cameras(problem, deviation, inflation, inflation * shared),
            deviation=deviation * math.sqrt(left_over(len(inliers), used)),
            squared_errors=all_squared,
            inliers=all_squared < (LIMIT * deviation) ** 2,
            before=before,
            after=deviation,
            spline=whole.moved(state.spline),
            start_ns=self.start_ns,
            times=self.times,
            tells_readout=self.tells_readout,
            apart=self.wanted.apart,
        )
        return replace(found, drifts=self._drifts(found, problem, modes, whole))

    def _drifts(
        self, found: RefinedMap, problem: Problem, modes: Array, whole: Similarity
    ) -> tuple[RefinedMap, ...]:
        """Return the motion with each of the errors (N,k), laid where the map was laid.

        Moves of landmarks are a difference of these, to first order: a motion that had not been
        laid would differ by the whole similarity, of which the second order is no small error.
        """
        drifts, still = [], np.zeros(3 * len(self.state.landmarks))
        for mode in modes.T:
            state = problem.moved(self.state, np.concatenate([mode, still]))
            cameras = tuple(
                _as_in(one, moved)
                for one, moved in zip(found.cameras, problem.states(state), strict=True)
            )
            drifts.append(replace(found, spline=whole.moved(state.spline), cameras=cameras))
        return tuple(drifts)

    def _cluster_robust(self, problem: Problem, deviation: float, independent: float) -> float:
        """Return the inflation of the covariances by errors of a second that pull together."""
        squared, every = problem.errors(self.state), problem.keypoint_rows(self.state, deviation)
        rows = np.concatenate([np.dstack([of.values[..., -3:], of.errors]) for of in every])
        inside = squared[squared < (LIMIT * deviation) ** 2]
        held, own = self.deviations**-2.0, steepness(inside, deviation) ** 2
        pull = pull_at_landmarks(rows, self._of_all("points"), self._of_all("times"), held)
        own *= left_over(len(inside), self._freedoms(self.state.spline))
        return Pull(own * pull.measured, pull.expected).inflation(independent)

    def _freedoms(self, spline: Spline) -> int:
        """Count the numbers of the motion that images determine: a pose each, and an end.

        Those of a global shutter say nothing of what lies between them.
        """
        images = sum(len(np.unique(own.frames)) for own in self.seen)
        rolling = self.freedom.readout_time or any(
            one.camera.readout_time > 0.0 for one in self.rig
        )
        ends = len(spline.layout.starts) if rolling else 0
        return CONTROL * min(images + ends, len(spline.positions))

    def _cameras(
        self, problem: Problem, deviation: float, inflation: float, shared: Array
    ) -> tuple[Adjusted, ...]:
        """Return the cameras, with the covariance (s,s) of what all images share."""
        asked, spread, found = self._asked(deviation, inflation), np.sqrt(np.diag(shared)), []
        free = self.freedom.readout_time
        for k, (one, wanted, state) in enumerate(
            zip(self.rig, asked, problem.states(self.state), strict=True)
        ):
            own = np.zeros(EXTRINSICS)
            if one.mounting is not None:
                own = spread[problem.place("mount", k) :][:EXTRINSICS]
            readout = float(spread[problem.place("readout", k)]) if free else math.nan
            given = Adjusted(one.camera, 0.0, readout, wanted, state.extrinsics, own)
            found.append(_as_in(given, state))
        return tuple(found)

    def _asked(self, deviation: float, inflation: float) -> list[ReadoutCheck | None]:
        """Return readout times that images ask for instead of given ones, by a Newton step."""
        known = [one.camera.readout_time > 0.0 for one in self.rig]
        none: list[ReadoutCheck | None] = [None] * len(known)
        if self.freedom.readout_time or not any(known) or not self.tells_readout:
            return none
        problem = self.problem(replace(self.freedom, readout_time=True))
        try:
            factored = Factored(problem.system(self.state, deviation))
            step, variances = factored.step(), np.diag(factored.border_covariance())
        except Undetermined:
            return none
        given = [float(one.readout_time) for one in problem.states(self.state)]
        return [
            ReadoutCheck(
                given[k],
                given[k] + float(step[problem.at[k]["readout"]]),
                math.sqrt(inflation * variances[problem.place("readout", k)]),
            )
            if known[k]
            else None
            for k in range(len(known))
        ]


DRIFT = 0.01
"""Part of a deviation, so little that landmarks follow in proportion, however large that is."""
# A landmark that is not known to this part of the map's size is not refined.
_KNOWN = 0.1
# Nor one that is known worse than to this many times what landmarks usually moved by: seen from one
# side only, it would be farther off than where it was.
_WORTH = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class RefinedMap:
    """Landmarks and motion, with the covariance of their errors."""

    points: Array  # (p,3) m
    covariances: Array  # (p,3,3) m^2; NaN where not refined
    refined: BoolArray  # (p,) others are where they were given
    sights: IntArray  # (p,) keypoints that fit
    cameras: tuple[Adjusted, ...]  # with the readout times and the lenses that were found
    deviation: float  # px, of the noise of u and of v
    squared_errors: Array  # (n,) px^2, whitened; infinite for keypoints that took no part
    inliers: BoolArray  # (n,)
    before: float  # px, noise that the map left as it was given
    after: float  # px, noise that it leaves now, likewise
    spline: Spline  # s since ``start_ns``
    start_ns: int
    times: Array  # (g,) s, of the images' middle rows
    tells_readout: bool  # images follow each other closely enough to tell the readout time
    apart: bool = False  # each image has a pose of its own, of no common motion
    # The motion and the cameras, off by DRIFT deviations of an error that landmarks share, each: as
    # many as were asked for, the largest first, in frames of their own.
    drifts: tuple[RefinedMap, ...] = ()

    @property
    def fit_share(self) -> float:
        """Share of the keypoints that fit."""
        return float(np.mean(self.inliers))

    @property
    def camera(self) -> Camera:
        """The first one, with the readout time and the lens that were found."""
        return self.cameras[0].camera

    @property
    def readout_time(self) -> float:
        """The first camera's readout time, s; negative: against the scan direction."""
        return self.cameras[0].readout_time

    @property
    def readout_time_deviation(self) -> float:
        """The first camera's deviation, s; NaN where it was given."""
        return self.cameras[0].readout_time_deviation

    @property
    def readout_check(self) -> ReadoutCheck | None:
        """The first camera's check."""
        return self.cameras[0].readout_check

    @property
    def camera_as_found(self) -> Camera:
        """The camera, its scan direction reversed where the readout time is negative."""
        if self.readout_time >= 0.0:
            return self.camera
        direction = REVERSED[ScanDirection(self.camera.scan_direction)]
        return replace(self.camera, scan_direction=direction)

    def poses(self) -> tuple[Array, Array]:
        """Return poses of the rig's axes in the map (g,3,3), (g,3) at the images' middle rows."""
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
    """Return the most likely map and motion, as of :func:`refine_rig`.

    Args:
        camera: its lens, scan direction and readout time (0: a global shutter).
        stamp_offset: s from a stamp to the first row's exposure.
    """
    return refine_rig([RigCamera(camera, stamp_offset)], seen, start, freedom, done=done)


def refine_rig(
    rig: Sequence[RigCamera],
    seen: MapObservations,
    start: Start,
    freedom: MapFreedom | None = None,
    *,
    done: Callable[[str], object] = lambda text: None,
) -> RefinedMap:
    """Return the most likely map and motion of a rig.

    Args:
        rig: its cameras.
        seen: keypoints of landmarks; those of landmarks that one image alone sees do not count.
        start: first guess; without landmarks of known places the map as a whole, its size too,
            stays where this has it.
        freedom: further unknowns (default: landmarks and motion only).
        done: called with each part of the work that is done.

    Raises:
        ValueError: when the images make no single map, or are too many.
    """
    freedom = freedom or MapFreedom()
    check(seen, len(start.points), np.array([one.delay for one in rig]))
    refinement = Refinement(rig, seen, start, freedom)
    try:
        return refinement.solved(done)
    except Undetermined as error:
        raise ValueError(f"the map cannot be refined: {error}") from error


def _as_in(one: Adjusted, state: Unknowns) -> Adjusted:
    """Return a camera with the lens, the readout time and the extrinsics of a state."""
    readout_time = float(state.readout_time)
    camera = with_lens(replace(one.camera, readout_time=abs(readout_time)), state.lens)
    return replace(one, camera=camera, readout_time=readout_time, extrinsics=state.extrinsics)


def _laid(
    problem: Problem, state: Unknowns, factored: Factored, usable: BoolArray
) -> tuple[Similarity, Array, Array]:
    """Return how a map is laid over the given one, unless landmarks of known place hold it.

    Args:
        problem: whose minimum the state is.
        state: map and motion.
        factored: its normal equations; they are used up.
        usable: (p,) which landmarks may hold the whole.

    Returns:
        the similarity that lays it there; and by the inverse of the normal matrix the covariances
        (p,3,3) of its landmarks and that (s,s) of readout time and lens.

    Raises:
        Undetermined: when the images leave something open.
    """
    if not problem.floating:
        return scaled(1.0), *factored.block_covariances()
    given = problem.views[0].observations.landmarks
    whole, kept = laid_over(state.landmarks, given, usable)
    every = generators(state.landmarks, state.landmarks[kept].mean(axis=0))
    of_kept = np.where(kept[:, None, None], every, 0.0)
    spread = factored.solve(np.zeros((problem.groups.kept, 7)), of_kept)[1]
    covariances, shared = factored.block_covariances()
    return whole, whole.covariances(as_held(covariances, spread, every, of_kept)), shared
