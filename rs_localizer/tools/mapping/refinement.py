# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A map refined with the rolling shutter that saw it: bundle adjustment in continuous time.

Landmarks are free, the motion is a spline, each keypoint is seen at the time of its own row. An
adjustment with a global shutter bends the map by what the camera moved while its rows were read.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import REVERSED, ScanDirection
from rs_localizer.tools.adjust.fit import (
    inflation_by_pull,
    inflation_of,
    left_over,
    pull_at_landmarks,
    steepness,
)
from rs_localizer.tools.adjust.intrinsics import with_lens
from rs_localizer.tools.adjust.problem import Problem, fit_with_noise, noise_of
from rs_localizer.tools.adjust.reprojection import LIMIT
from rs_localizer.tools.adjust.spline import LONGEST_GAP, Spline
from rs_localizer.tools.adjust.spline_kernels import CONTROL
from rs_localizer.tools.adjust.system import Factored, Undetermined
from rs_localizer.tools.adjust.variables import (
    CameraView,
    Freedom,
    SplineKeypoints,
    Unknowns,
    start_state,
)
from rs_localizer.tools.mapping.gauge import Similarity, as_held, generators, laid_over, scaled
from rs_localizer.tools.mapping.map_keypoints import (
    LEAST_KEYPOINTS,
    Adjusted,
    MapFreedom,
    MapObservations,
    Start,
    acceleration_prior,
    check,
    following,
    initial_trajectory,
    middle_row_delay,
    shared_landmarks,
)
from rs_localizer.tools.readout_belief import ReadoutCheck, ShutterFit

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
        self, camera: Camera, stamp_offset: float, seen: MapObservations, start: Start,
        freedom: MapFreedom,
    ) -> None:  # fmt: skip
        self.camera, self.shown, self.given, self.wanted = camera, seen, start, freedom
        self.start_ns = int(seen.stamps_ns[0])
        delay = middle_row_delay(camera, stamp_offset)
        self.times = np.asarray(1e-9 * (seen.stamps_ns - self.start_ns) + delay, np.float64)
        if freedom.apart:  # each alone
            self.times = np.arange(len(seen.stamps_ns), dtype=np.float64)
        self.size = float(np.linalg.norm(np.ptp(start.points, axis=0)))
        self.deviations, self.floating = self._known()
        self.used = self._usable()
        own = np.unique(seen.images[self.used])  # those that follow each other are one stretch
        times, rotations = self.times[own], start.rotations[own]
        self.spline = initial_trajectory(
            times, rotations, start.positions[own], camera.readout_time,
            following(times, rotations),
        )  # fmt: skip
        longest = int(np.bincount(self.spline.layout.stretches(times)).max())
        # Images on their own tell turn and way per readout only, and not how long it takes.
        self.tells_readout = longest >= _LEAST_STRETCH
        if freedom.readout_time and not self.tells_readout:
            raise ValueError(
                f"estimating the readout time needs {_LEAST_STRETCH} images in a row, at most "
                f"{LONGEST_GAP} s apart; there are {longest}: give it, or more of the recording"
            )
        held = CONTROL * len(self.spline.positions)
        if held > _MOST_UNKNOWNS:
            raise ValueError(
                f"{len(self.times)} images have {held} unknowns of motion, at most "
                f"{_MOST_UNKNOWNS} can be refined at once: leave images out"
            )
        images, pixels = seen.images[self.used], seen.pixels[self.used]
        self.seen = SplineKeypoints(
            camera, self.times[images], camera.row_time(pixels), pixels,
            landmarks=start.points, points=seen.landmarks[self.used], frames=images,
            trusted=np.ones(len(images), np.bool_),
        )  # fmt: skip
        self.state = start_state(self.seen, self.spline, camera.readout_time)
        self.freedom: Freedom = freedom

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

    def problem(self, freedom: Freedom, held: bool = False) -> Problem:
        """Return the problem of map and motion; ``held``: only the motion is free."""
        views = [CameraView(self.seen, freedom)]
        if held:
            return Problem(views, self.state)
        return Problem(views, self.state, deviations=self.deviations, floating=self.floating)

    def solved(self) -> RefinedMap:
        """Return the most likely map and motion."""
        # The motion that goes with the map as it is.
        held = replace(self.freedom, readout_time=False, lens=False)
        motion = self.problem(held, held=True)
        self.state, before = fit_with_noise(motion, self.state, motion.noise(self.state, np.inf))
        problem = self.problem(self.freedom)
        self.state, deviation = fit_with_noise(problem, self.state, before)
        if (calmer := acceleration_prior(self.state, self.freedom)) is not None:
            self.freedom, problem = calmer, self.problem(calmer)
            self.state, deviation = fit_with_noise(problem, self.state, deviation)
        return self._result(problem, before, deviation)

    def _result(self, problem: Problem, before: float, deviation: float) -> RefinedMap:
        state, count = self.state, len(self.state.landmarks)
        squared = problem.errors(state)
        inliers = squared < (LIMIT * deviation) ** 2
        shown, frames = self.seen.points[inliers], self.seen.frames[inliers]
        sights = np.bincount(shown, minlength=count)
        pairs = np.unique(np.column_stack([shown, frames]), axis=0)
        images = np.bincount(pairs[:, 0], minlength=count)
        used = self._freedoms(state.spline) + 3 * int(np.count_nonzero(images))
        inflation = inflation_of(squared[inliers], deviation, used + problem.border)
        inflation = self._cluster_robust(problem, deviation, inflation)
        factored = Factored(problem.system(state, deviation, dense=True))
        modes = np.zeros((problem.groups.kept, 0))  # errors of the motion
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
        all_squared[self.used] = squared
        free = self.freedom.readout_time
        found = RefinedMap(
            points=np.where(refined[:, None], points, self.given.points),
            covariances=np.where(refined[:, None, None], covariances, np.nan),
            refined=refined, sights=sights, camera=self.camera, readout_time=0.0,
            readout_time_deviation=math.sqrt(inflation * shared[0, 0]) if free else math.nan,
            readout_check=None if free else self._asked(deviation, inflation),
            deviation=deviation * math.sqrt(left_over(len(inliers), used)),
            squared_errors=all_squared, inliers=all_squared < (LIMIT * deviation) ** 2,
            before=before, after=deviation, spline=whole.moved(state.spline),
            start_ns=self.start_ns, times=self.times, tells_readout=self.tells_readout,
            apart=self.wanted.apart,
        )  # fmt: skip
        # Moves of landmarks are a difference of these, to first order: a motion that had not been
        # laid would differ by the whole similarity, of which the second order is no small error.
        steps = np.pad(modes, ((0, 3 * count), (0, 0))).T
        others = [problem.moved(state, step) for step in steps]
        drifts = [replace(_as_in(found, it), spline=whole.moved(it.spline)) for it in others]
        return replace(_as_in(found, state), drifts=tuple(drifts))

    def _cluster_robust(self, problem: Problem, deviation: float, independent: float) -> float:
        """Return the inflation of the covariances by errors of a second that pull together."""
        squared, (seen,) = problem.errors(self.state), problem.keypoint_rows(self.state, deviation)
        rows = np.dstack([seen.values[..., -3:], seen.errors])
        inside = squared[squared < (LIMIT * deviation) ** 2]
        held, own = self.deviations**-2.0, steepness(inside, deviation) ** 2
        measured, expected = pull_at_landmarks(rows, self.seen.points, self.seen.times, held)
        own *= left_over(len(inside), self._freedoms(self.state.spline))
        return inflation_by_pull(own * measured, expected, independent)

    def _freedoms(self, spline: Spline) -> int:
        """Count the numbers of the motion that images determine: a pose each, and an end.

        Those of a global shutter say nothing of what lies between them.
        """
        images = len(np.unique(self.seen.frames))
        rolling = self.freedom.readout_time or self.camera.readout_time > 0.0
        ends = len(spline.layout.starts) if rolling else 0
        return CONTROL * min(images + ends, len(spline.positions))

    def _asked(self, deviation: float, inflation: float) -> ReadoutCheck | None:
        """Return the readout time that images ask for instead of a given one, by a Newton step."""
        given = self.camera.readout_time
        if not given > 0.0 or not self.tells_readout:
            return None
        problem = self.problem(replace(self.freedom, readout_time=True))
        try:
            factored = Factored(problem.system(self.state, deviation))
            step, variances = factored.step(), np.diag(factored.border_covariance())
        except Undetermined:
            return None
        asked = given + float(step[problem.groups.motion])
        return ReadoutCheck(given, asked, math.sqrt(inflation * variances[0]))


DRIFT = 0.01
"""Part of a deviation, so little that landmarks follow in proportion, however large that is."""
# A landmark that is not known to this part of the map's size is not refined.
_KNOWN = 0.1
# Nor one that is known worse than to this many times what landmarks usually moved by: seen from one
# side only, it would be farther off than where it was.
_WORTH = 1.5


@dataclass(frozen=True, slots=True, eq=False)
class RefinedMap(Adjusted):
    """Landmarks and motion, with the covariance of their errors."""

    points: Array  # (p,3) m
    covariances: Array  # (p,3,3) m^2; NaN where not refined
    refined: BoolArray  # (p,) others are where they were given
    sights: IntArray  # (p,) keypoints that fit
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
    # The motion and the camera, off by DRIFT deviations of an error that landmarks share, each: as
    # many as were asked for, the largest first, in frames of their own.
    drifts: tuple[RefinedMap, ...] = ()

    @property
    def fit_share(self) -> float:
        """Share of the keypoints that fit."""
        return float(np.mean(self.inliers))

    @property
    def camera_as_found(self) -> Camera:
        """The camera, its scan direction reversed where the readout time is negative."""
        if self.readout_time >= 0.0:
            return self.camera
        direction = REVERSED[ScanDirection(self.camera.scan_direction)]
        return replace(self.camera, scan_direction=direction)

    def poses(self) -> tuple[Array, Array]:
        """Return poses map_from_camera (g,3,3), (g,3) at the images' middle rows."""
        states = self.spline.states(self.times)
        return states.rotations, states.positions


def refine(
    camera: Camera, seen: MapObservations, start: Start, freedom: MapFreedom | None = None, *,
    stamp_offset: float = 0.0,
) -> RefinedMap:  # fmt: skip
    """Return the most likely map and motion.

    Args:
        camera: its lens, scan direction and readout time (0: a global shutter).
        seen: keypoints of landmarks; those of landmarks that one image alone sees do not count.
        start: first guess; without landmarks of known places the map as a whole, its size too,
            stays where this has it.
        freedom: further unknowns (default: landmarks and motion only).
        stamp_offset: s from a stamp to the first row's exposure.

    Raises:
        ValueError: when the images make no single map, or are too many.
    """
    check(seen, len(start.points))
    refinement = Refinement(camera, stamp_offset, seen, start, freedom or MapFreedom())
    try:
        return refinement.solved()
    except Undetermined as error:
        raise ValueError(f"the map cannot be refined: {error}") from error


def _as_in(one: RefinedMap, state: Unknowns) -> RefinedMap:
    """Return a map whose camera has the lens and the readout time of a state."""
    readout_time = float(state.readout_time)
    camera = with_lens(replace(one.camera, readout_time=abs(readout_time)), state.lens)
    return replace(one, camera=camera, readout_time=readout_time)


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


LEAST_FIT = 0.8
"""Share of the keypoints that fit a good map: nine in ten do."""


def likely_axis(size: tuple[int, int], given: str | None) -> ScanDirection:
    """Return a given scan direction, or the likely one, reversed if the readout time is negative.

    The rows of sensors lie along their longer side, also where a driver or a phone has turned the
    images.
    """
    if given is not None:
        return ScanDirection(given)
    return ScanDirection.TOP_TO_BOTTOM if size[0] >= size[1] else ScanDirection.LEFT_TO_RIGHT


# Standard deviations of COLMAP's lens: focal length and centre over the focal length (of one
# phone's video 21 images give 384.2 px, 42 give 383.2), and distortion. Under a steady motion a
# focal length along the scan resembles a shutter; looser priors leave the choice to chance.
_LENS_DEVIATIONS = 0.005, 0.02


def colmap_freedom(lens: bool) -> MapFreedom:
    """Return the unknowns of a map that COLMAP has begun; ``lens``: its lens, too."""
    return MapFreedom(lens=lens, lens_deviations=_LENS_DEVIATIONS)


def fit_shutter(
    camera: Camera, observations: MapObservations, start: Start, freedom: MapFreedom
) -> tuple[RefinedMap, ShutterFit | None]:  # fmt: skip
    """Refine the map with the shutter that explains the images best.

    A shutter is only believed if it explains them significantly better than a global one. If no
    smooth motion fits them as well as the first guess (a time lapse, cuts), each image keeps its
    own pose, as in COLMAP, and the shutter stays unknown.

    Args:
        camera: its lens, and the axis of its scan.
        observations, start, freedom: as of :func:`refine`.

    Returns:
        the map, and what the shutter was found to be; None: too few images follow each other, or
        they are ``apart``.

    Raises:
        ValueError: as :func:`refine`.
    """
    camera, smooth = replace(camera, readout_time=0.0), None
    with suppress(ValueError):  # what is wrong with the images is raised below
        smooth = _of_one_motion(camera, observations, start, freedom)
        best, errors = smooth[0], global_errors(camera, observations, start)
        noise = noise_of(errors[np.isfinite(errors)] ** 2, np.inf)  # px, of the first guess
        if best.fit_share >= LEAST_FIT and best.after <= noise:
            return smooth
    try:
        apart = refine(camera, observations, start, replace(freedom, apart=True))
    except ValueError:
        if smooth is None:
            raise
        return smooth
    return smooth if smooth and apart.fit_share < LEAST_FIT else (apart, None)


def refine_with_shutter(
    camera: Camera, observations: MapObservations, start: Start, freedom: MapFreedom,
    given: float | None,
) -> tuple[RefinedMap, ShutterFit | None, ReadoutCheck | None]:  # fmt: skip
    """Refine the map with a given readout time (s), and check it.

    Else, or where the images contradict it, as of :func:`fit_shutter`: a map that was adjusted with
    the wrong one is bent to it, and fits it nearly as well.
    """
    check = None
    if given is not None:
        known = replace(camera, readout_time=given)
        refined = refine(known, observations, start, freedom)
        check = refined.readout_check
        if check is None or not check.differs:
            return refined, None, check
    return *fit_shutter(camera, observations, start, freedom), check


def global_errors(camera: Camera, observations: MapObservations, start: Start) -> Array:
    """Return distances (n,), px, of keypoints from their global-shutter projections."""
    found = camera.project(start.local(observations)) - observations.pixels
    return np.asarray(np.linalg.norm(found, axis=1))


def _of_one_motion(
    camera: Camera, observations: MapObservations, start: Start, freedom: MapFreedom
) -> tuple[RefinedMap, ShutterFit | None]:  # fmt: skip
    """Refine by one smooth motion through successive images; see :func:`fit_shutter`."""
    from scipy.stats import wilcoxon  # takes a second

    still = refine(camera, observations, start, freedom)
    if not still.tells_readout:
        return still, None
    free = replace(freedom, readout_time=True)
    rolling = refine(still.camera, observations, start, free)
    gains = _costs(still, still, observations) - _costs(rolling, still, observations)
    shutter = ShutterFit(
        readout_time=rolling.camera_as_found.readout_time,
        deviation=rolling.readout_time_deviation,
        direction=ScanDirection(rolling.camera_as_found.scan_direction),
        # Images at rest gain nothing, those of a quick turn much: the signed-rank test.
        chance=float(wilcoxon(gains, alternative="greater").pvalue),
        interval=1e-9 * float(np.median(np.diff(observations.stamps_ns))),
    )
    return (rolling if shutter.visible else still), shutter


def _costs(fit: RefinedMap, still: RefinedMap, observations: MapObservations) -> Array:
    """Return squared errors of the images (g,), outliers cut off alike in all fits."""
    limit = (LIMIT * still.deviation) ** 2
    squared = np.minimum(np.where(np.isfinite(fit.squared_errors), fit.squared_errors, 0.0), limit)
    sums = np.bincount(observations.images, squared, len(observations.stamps_ns))
    return np.asarray(sums, np.float64)
