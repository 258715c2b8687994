# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses of markers, from recordings that show them, by one camera or by the cameras of a rig.

Continuous-time adjustment with the poses of the markers free, each a rigid square of known size.
The first marker is the origin; whatever shows several of them closes loops.

A square that is seen from one side fits two poses. From few directions the wrong one is a minimum,
too, which no adjustment leaves (Collins and Bartoli, *Infinitesimal plane-based pose estimation*,
IJCV 2014). With the motion held, each marker is mirrored about its mean line of sight, adjusted on
its own, and compared.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.prints import Marker
from rs_localizer.tools.adjust.bodies import BODY, PLACE
from rs_localizer.tools.adjust.cluster_robust import by_seconds, cluster_robust
from rs_localizer.tools.adjust.fit import Fit, solve
from rs_localizer.tools.adjust.problem import Problem
from rs_localizer.tools.adjust.reprojection import LIMIT
from rs_localizer.tools.adjust.row_kernels import EXTRINSICS
from rs_localizer.tools.adjust.spline import Spline
from rs_localizer.tools.adjust.system import System, Undetermined
from rs_localizer.tools.adjust.variables import (
    CameraView,
    Freedom,
    SplineKeypoints,
    Unknowns,
    rig_state,
)
from rs_localizer.tools.mapping.gauge import of_the_shape, through
from rs_localizer.tools.mapping.initial_trajectory import (
    ANGULAR_VELOCITY,
    LINEAR_VELOCITY,
    acceleration_prior,
    initial_trajectory,
)
from rs_localizer.tools.mapping.map_keypoints import Adjusted, RigImages, frames_of
from rs_localizer.tools.mapping.unknown_markers import (
    Chained,
    Filmed,
    Spotted,
    chain,
)
from rs_localizer.tools.readout_belief import ReadoutCheck, disagreement

# Steps of Gauss and Newton, and the noise of each by what it is.
_NOISES = (10.0,) * 6 + (1.0,) * 4
# Least difference of the costs of independent errors: the other pose is e^6 times less likely, or
# it may be true.
_LEAST_DIFFERENCE = 12.0


@dataclass(frozen=True, slots=True, eq=False)
class Adjustable:
    """Keypoints of the cameras: four corners of each marker; the first, the origin, is known."""

    filmed: Sequence[Filmed]
    seen: Sequence[SplineKeypoints]  # of the landmarks that all see

    def start(self, spline: Spline) -> Unknowns:
        """Return a first guess."""
        pairs = zip(self.filmed, self.seen, strict=True)
        return rig_state(spline, ((one.camera, own, one.extrinsics) for one, own in pairs))

    def problem(
        self,
        start: Unknowns,
        freedom: Freedom,
        readout_times: bool = False,
        markers_only: bool = False,
    ) -> Problem:
        """Return the problem of all cameras.

        Args:
            freedom: of the motion.
            readout_times: those that are given are estimated, too.
            markers_only: nothing but the markers is free, the origin as well.
        """
        bodies = None
        if markers_only:
            bodies = np.repeat(np.arange(len(start.landmarks) // 4), 4)
        views = []
        for one, seen in zip(self.filmed, self.seen, strict=True):
            own = replace(
                freedom,
                readout_time=not markers_only
                and (readout_times or not one.camera.readout_time > 0.0),
                mounting=None if markers_only else one.mounting,
            )
            seen = seen if bodies is None else replace(seen, bodies=bodies)
            views.append(CameraView(one.camera, seen, own))
        return Problem(views, start, one_map=True)

    def fit_roughly(self, start: Unknowns, freedom: Freedom, *free: bool) -> Fit:
        """Fit from far off, as at the end of a chain, where large errors are no outliers."""
        errors = np.sqrt(self.problem(start, freedom, *free).errors(start))
        return self.fit(start, freedom, float(np.clip(np.median(errors), *_FIRST_NOISE)), *free)

    def fit(self, start: Unknowns, freedom: Freedom, deviation: float, *free: bool) -> Fit:
        """Return the minimum of a problem."""
        return solve(self.problem(start, freedom, *free), start, deviation)


def _mirrored(given: Adjustable, fitted: Fit) -> tuple[BoolArray, BoolArray, Unknowns]:
    """Compare each marker with its mirror image, the motion held.

    Returns:
        which markers (m,) fit better mirrored, which fit nearly as well one way or the other, and
        the state with those mirrored that fit better so.
    """
    count = len(fitted.state.landmarks) // 4
    # The origin, too, may lie the other way among all others.
    problem = given.problem(fitted.state, fitted.freedom, markers_only=True)
    other = fitted.state.with_landmarks(_turned_over(given.seen, fitted.state))
    for noise in _NOISES:
        system = problem.system(other, noise * fitted.deviation)
        still = np.zeros(problem.groups.motion)
        other = problem.moved(other, np.concatenate([still, _steps(system, count)]))
    own, theirs = (_costs(problem, state, fitted.deviation) for state in (fitted.state, other))
    better = theirs < own
    doubtful = np.abs(theirs - own) < _LEAST_DIFFERENCE * fitted.inflation
    # A pose that came back is the same one.
    apart = _normals(other) * _normals(fitted.state)
    same = np.sum(apart, axis=1) > np.cos(0.02)
    chosen = np.where(
        np.repeat(better & ~same, 4)[:, None], other.landmarks, fitted.state.landmarks
    )
    return better & ~same, doubtful & ~same, _at_the_origin(fitted.state, chosen)


def _turned_over(every: Sequence[SplineKeypoints], state: Unknowns) -> Array:
    """Return corners (p,3) of each marker mirrored in depth as its images see it."""
    layout, corners = state.spline.layout, state.landmarks.reshape(-1, 4, 3)
    middles, sight = corners.mean(axis=1), np.zeros((len(corners), 3))
    for seen, own in zip(every, (state, *state.others), strict=True):
        times = np.clip(seen.times, layout.starts.min(), layout.ends.max())
        states, markers = state.spline.states(times), seen.points // 4
        centres = states.positions + states.rotations @ own.extrinsics.centre
        toward: Array = centres - middles[markers]
        toward /= np.linalg.norm(toward, axis=1)[:, None]
        sight += np.column_stack([np.bincount(markers, of, len(corners)) for of in toward.T])
    sight /= np.maximum(np.linalg.norm(sight, axis=1), 1e-12)[:, None]
    depth = np.einsum("mci,mi->mc", corners - middles[:, None], sight)
    return np.asarray(corners - 2.0 * depth[..., None] * sight[:, None]).reshape(-1, 3)


def _steps(system: System, count: int) -> Array:
    """Return steps of all markers (6 m,), each on its own."""
    at = BODY * np.arange(count)[:, None] + np.arange(BODY)
    slope = system.slope[system.groups.motion :]
    blocks = system.corner[at[:, :, None], at[:, None, :]]
    return np.asarray(-np.linalg.solve(blocks, slope[at][..., None]).ravel())


def _costs(problem: Problem, state: Unknowns, deviation: float) -> Array:
    """Return Tukey's costs of the corners of each marker (m,)."""
    limit = (LIMIT * deviation) ** 2
    rest = np.maximum(1.0 - problem.errors(state) / limit, 0.0)
    costs = (1.0 - rest**3) * limit / (3.0 * deviation**2)
    points = np.concatenate([view.observations.points for view in problem.views])
    return np.asarray(np.bincount(points // 4, costs, len(state.landmarks) // 4), np.float64)


def _normals(state: Unknowns) -> Array:
    """Return normals of the markers (m,3)."""
    corners = state.landmarks.reshape(-1, 4, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1])
    return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None])


def _at_the_origin(state: Unknowns, landmarks: Array) -> Unknowns:
    """Set these landmarks (p,3), and move all so that the first four stay in place."""
    back = through(landmarks[:4], state.landmarks[:4])
    moved = back(landmarks)
    moved[:4] = state.landmarks[:4]
    return replace(state, spline=back.moved(state.spline)).with_landmarks(moved)


# Relative deviation of a size of which nothing is known.
_ANY_SIZE = 0.5
# A size is wrong beyond this and this many of its own deviations (printers stretch by up to three
# parts in a thousand, rulers are read to half a millimetre).
_SIZES_DIFFER, _SIGMAS = 0.015, 6.0
# The least noise (px) from far off on, where a wrong size makes no outliers, to the last one; and
# rounds at each, until sizes change by less than a part.
_FROM_FAR, _MOST_ROUNDS, _SAME_SIZE = (5.0, 1.0, 0.2), 5, 0.005
_LEAST_IMAGES = 5
# Images that show a marker: fewer say hardly anything of it.
_LEAST_SIGHTS = 3
# The noise about the first guess is taken for at least and at most this (px).
_FIRST_NOISE = 5.0, 50.0
# px, at first; an image of one marker has two numbers more than its pose.
_LEAST_NOISE = 0.05
# Share of the corners that fit where nothing is wrong: nearly all do.
_LEAST_FIT = 0.8
# A place that is known worse than to this part of a marker's size is worth little.
_POOR = 0.1
MISFIT = "is their size right, and each id used once?"
"""Question about markers whose corners do not fit."""
# Markers that were turned over may hide others.
_MOST_TURNS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """Markers and the covariance of their errors."""

    markers: tuple[Marker, ...]  # in the frame of the first of them, the origin
    # (6 m, 6 m) of place (m) and turn (rad) along the map's axes: in the frame of the origin,
    # whose own is 0, and of the shape, wherever the whole of it lies.
    covariance: Array
    covariance_of_shape: Array
    sights: tuple[int, ...]  # images of each
    apart: tuple[tuple[Marker, ...], ...]  # not connected with these, part by part
    # Connected, but too few images show them, or do not tell which of two ways they are turned.
    rare: tuple[Marker, ...]
    misfits: tuple[Marker, ...]  # whose corners do not fit those of the others, left out
    fit: Fit
    cameras: tuple[Adjusted, ...]
    images: tuple[int, ...]  # of each camera, that show markers of the map

    @property
    def deviations(self) -> Array:
        """Standard deviations (m,6) in the frame of the origin."""
        return np.sqrt(np.diagonal(self.covariance)).reshape(-1, BODY)

    @property
    def poor(self) -> BoolArray:
        """Which markers (m,) are known worse, beside the others, than a tenth of their size."""
        off = np.linalg.norm(self.deviations_of_shape[:, :PLACE], axis=1)
        return np.asarray(off > _POOR * np.array([marker.size for marker in self.markers]))

    @property
    def deviations_of_shape(self) -> Array:
        """Standard deviations (m,6) of what is left when all are laid over the truth."""
        return np.sqrt(np.diagonal(self.covariance_of_shape)).reshape(-1, BODY)


def survey(
    filmed: Sequence[Filmed], markers: Sequence[Marker], *, origin: int | None = None
) -> Survey:
    """Survey the markers that a camera or a rig shows; cameras need not see the same ones.

    Args:
        filmed: by each camera; the motion is that of the rig's axes.
        markers: all that may be there, by their sizes; where they are does not matter.
        origin: place of the marker whose frame is the map's; None: the first one.

    Raises:
        ValueError: when the images say too little, or markers fit no others, with what was found.
    """
    filmed = [
        replace(one, spotted=[image for image in one.spotted if len(image.markers)])
        for one in filmed
    ]
    images = [image for one in filmed for image in one.spotted]
    _check(images, markers, origin)
    start_ns = min(image.stamp_ns for image in images)
    times = [one.times(start_ns) for one in filmed]
    frames = frames_of(times)
    chained = chain(filmed, frames, markers, origin)
    if len(chained.markers) < 2:
        raise ValueError(
            f"no image shows {markers[next(iter(chained.markers))].name} together with another "
            "marker: there is nothing to survey"
        )
    try:
        done = _adjusted(filmed, times, frames, markers, chained)
    except Undetermined as error:
        raise ValueError(f"the images do not determine the markers' poses: {error}") from error
    if isinstance(done, Survey):
        return done
    # Their contribution to the motion is wrong, too.
    lost = tuple(markers[m] for m in done)
    if origin in done or len(chained.markers) - len(lost) < 2:
        names = ", ".join(marker.name for marker in lost)
        raise ValueError(f"{names}: the corners do not fit those of other markers: {MISFIT}")
    rest = [replace(one, spotted=[image.without(done) for image in one.spotted]) for one in filmed]
    found = survey(rest, markers, origin=origin)
    return replace(found, misfits=lost + found.misfits)


def _check(images: list[Spotted], markers: Sequence[Marker], origin: int | None) -> None:
    if len(images) < _LEAST_IMAGES:
        raise ValueError(
            f"{len(images)} images show a whole marker, at least {_LEAST_IMAGES} are needed"
        )
    if origin is not None and not any(origin in one.markers for one in images):
        raise ValueError(f"the origin, {markers[origin].name}, is in no image")


def _adjusted(
    filmed: Sequence[Filmed], times: Sequence[Array], frames: Sequence[RigImages],
    markers: Sequence[Marker], chained: Chained,
) -> Survey | list[int]:  # fmt: skip
    """Return the survey, or the markers that do not fit the others."""
    posed = [frames[k] for k in chained.frames]
    shown = [sorted(image for frame in posed for camera, image in frame.images if camera == place)
             for place in range(len(filmed))]  # fmt: skip
    own = _often(filmed, shown, chained)
    sizes, guessed = (np.array([of[m].size for m in own]) for of in (markers, chained.sized))
    spline = _first_motion(filmed, times, posed, chained)
    seen = []
    for one, images, own_times in zip(filmed, shown, times, strict=True):
        found = _observations(one, images, own_times, markers, chained, own)
        seen.append(found.subset(spline.layout.inside(found.times)))
    given = Adjustable(filmed, seen)
    freedom = Freedom(
        angular_velocity=ANGULAR_VELOCITY,
        linear_velocity=LINEAR_VELOCITY,
        least_noise=_LEAST_NOISE,
    )
    start = given.start(spline)
    grown = _grown(given, start, freedom, np.log(guessed / sizes))
    if grown.any():
        raise ValueError(_wrong_sizes([markers[m] for m in own], grown))
    fitted = given.fit_roughly(start, freedom)
    calmer = acceleration_prior(fitted.state, freedom)
    if calmer is not None:
        fitted = given.fit(fitted.state, calmer, fitted.deviation)
    fitted, doubtful = _right_side_up(given, fitted)
    fitted = _less_noise(given, fitted)
    _check_fit(fitted)
    fits, misfits = _fitting(posed, seen, fitted.inliers, len(own))
    if misfits.any():
        return [own[k] for k in np.flatnonzero(misfits)]
    fitted = cluster_robust(given.problem(fitted.state, fitted.freedom), fitted)
    corners = fitted.state.landmarks.reshape(-1, 4, 3)
    placed = [
        Marker(markers[m].family, markers[m].id, of) for m, of in zip(own, corners, strict=True)
    ]
    points = np.concatenate([each.points for each in seen])[fitted.inliers]
    counts = np.bincount(points // 4, minlength=len(own)) // 4
    known = np.flatnonzero(fits & (counts >= _LEAST_SIGHTS) & ~doubtful)
    order = [0, *sorted(known[known > 0].tolist(), key=lambda k: own[k])]
    covariance = _covariance(fitted, order)
    done = Survey(
        tuple(placed[k] for k in order),
        covariance,
        of_the_shape(covariance, corners[order]),
        tuple(int(counts[k]) for k in order),
        tuple(tuple(markers[m] for m in part) for part in chained.apart),
        tuple(markers[m] for m in chained.markers if m not in {own[k] for k in order}),
        (),
        fitted,
        tuple(_cameras(given, fitted)),
        tuple(map(len, shown)),
    )
    _check_places(done)
    return done


def _first_motion(
    filmed: Sequence[Filmed], times: Sequence[Array], posed: Sequence[RigImages], chained: Chained
) -> Spline:
    """Return a spline through the frames with a pose."""
    rotations = np.array([pose.rotation for pose in chained.poses])
    positions = np.array([pose.translation for pose in chained.poses])
    # Images of a frame reach beyond its middle.
    beyond = max(
        abs(times[camera][image] - frame.time) for frame in posed for camera, image in frame.images
    )
    longest = max(one.camera.readout_time for one in filmed) + 2.0 * float(beyond)
    return initial_trajectory(
        np.array([frame.time for frame in posed]), rotations, positions, longest
    )


def _right_side_up(given: Adjustable, fitted: Fit) -> tuple[Fit, BoolArray]:
    """Turn all markers as they fit best; return also a mask (m,) of undecided ones."""
    for _ in range(_MOST_TURNS):
        better, doubtful, other = _mirrored(given, fitted)
        if not better.any():
            break
        turned = given.fit(other, fitted.freedom, fitted.deviation)
        problem = given.problem(fitted.state, fitted.freedom)
        if problem.system(turned.state, fitted.deviation).cost > fitted.cost:
            break
        fitted = turned
    return fitted, doubtful


def _less_noise(given: Adjustable, fitted: Fit) -> Fit:
    """Fit again with corners that are better than was assumed.

    If they weigh too little, the prior of the accelerations wins, and the readout time suffers.
    """
    noise = fitted.deviation * math.sqrt(fitted.inflation)
    if fitted.deviation > _LEAST_NOISE or noise > _LEAST_NOISE:
        return fitted
    return given.fit(fitted.state, replace(fitted.freedom, least_noise=noise), noise)


def _covariance(fitted: Fit, order: list[int]) -> Array:
    """Return the covariance (6 m, 6 m) of markers in an order that starts at the origin."""
    shared = len(fitted.border_covariance) - BODY * (len(fitted.state.landmarks) // 4 - 1)
    places = np.array(order[1:])[:, None] - 1
    columns = (shared + BODY * places + np.arange(BODY)).ravel()
    covariance = np.zeros((BODY * len(order),) * 2)
    covariance[BODY:, BODY:] = fitted.border_covariance[np.ix_(columns, columns)]
    return covariance


def _grown(given: Adjustable, start: Unknowns, freedom: Freedom, grown: Array) -> Array:
    """Return log sizes (m,) over the given ones, for markers whose size certainly differs.

    All sizes free at once would drift along a chain of markers by what errors have in common, which
    costs each of them next to nothing. So most are held, and one at a time is let go; and readout
    times are free, lest a wrong one is taken for sizes.

    Args:
        start: with sizes as they are said to be.
        grown: (m,) a first guess.
    """
    far = replace(freedom, least_noise=_FROM_FAR[0])
    fitted = given.fit_roughly(_resized(start, grown), far, True)
    for noise in (*_FROM_FAR, _LEAST_NOISE):
        for _ in range(_MOST_ROUNDS):
            if grown.any():
                fitted = _right_side_up(given, fitted)[0]
            own = replace(freedom, least_noise=noise)
            fitted = given.fit(fitted.state, own, fitted.deviation, True)
            more = _least_growth(given, fitted, grown) - grown
            grown = grown + more
            fitted = replace(fitted, state=_resized(fitted.state, more))
            if np.abs(more).max() < _SAME_SIZE:
                break
    shown = np.concatenate([each.points for each in given.seen]) // 4
    share = np.bincount(shown, fitted.inliers, len(grown)) / np.bincount(shown)
    grown = np.where(share < _LEAST_FIT, 0.0, grown)  # no size explains those
    # The costs are compared, too: weights of Tukey's estimator hide evidence against a size.
    for k in np.argsort(np.abs(grown))[np.count_nonzero(grown == 0.0) :].tolist():
        less = np.where(np.arange(len(grown)) == k, 0.0, grown)
        plain = given.fit(_resized(fitted.state, less - grown), freedom, fitted.deviation, True)
        if not _cheaper(given, fitted, plain):
            fitted, grown = plain, less
    if grown.any() and not _cheaper(given, fitted, given.fit_roughly(start, freedom, True)):
        grown = np.zeros(len(grown))
    return grown


def _cheaper(given: Adjustable, sized: Fit, plain: Fit) -> bool:
    """Return True if one more size certainly lowers the cost."""
    problem = given.problem(plain.state, plain.freedom, True)
    gain = problem.system(plain.state, sized.deviation).cost - sized.cost
    return bool(gain > _SIGMAS**2 * cluster_robust(problem, plain).inflation)


def _least_growth(given: Adjustable, fitted: Fit, grown: Array) -> Array:
    """Return the log sizes of the few markers that lower the cost most.

    One by one the size is freed that lowers the cost most (orthogonal matching pursuit; Pati et
    al., Asilomar 1993), while it does so certainly.

    Args:
        grown: (m,) the same of the fit.
    """
    problem = given.problem(fitted.state, fitted.freedom, True)
    noise = cluster_robust(problem, fitted).inflation
    corners, count = fitted.state.landmarks.reshape(-1, 4, 3), len(grown)
    arms = (corners - corners.mean(axis=1, keepdims=True)).reshape(-1, 3)
    kept, own = np.zeros((problem.groups.kept, count)), np.zeros((count, count))
    slope = np.zeros(count)
    every = problem.keypoint_rows(fitted.state, fitted.deviation)
    for rows, seen in zip(every, given.seen, strict=True):
        by_place = rows.values[:, :, -BODY : PLACE - BODY]
        values = np.einsum("nri,ni->nr", by_place, arms[seen.points]).ravel()
        columns, starts = np.repeat(seen.points // 4, 2), np.arange(len(values) + 1)
        by_size = csr_array((values, columns, starts), shape=(len(values), count))
        kept += (rows.matrix(slice(None), len(kept)).T @ by_size).toarray()
        own += (by_size.T @ by_size).toarray()
        slope += by_size.T @ rows.errors.ravel()
    information = own - kept.T @ fitted.factored.kept(kept)
    slope += kept.T @ fitted.factored.step() - information @ grown
    found, chosen = np.zeros(count), list[int]()
    single = np.maximum(np.diag(information), _ANY_SIZE**-2)
    while len(chosen) < count // 2:
        off = -(slope + information @ found) / single
        gains = np.where(np.abs(off) > _SIZES_DIFFER, single * off**2, 0.0)
        gains[chosen] = 0.0
        if gains.max() < _SIGMAS**2 * noise:
            break
        chosen.append(int(np.argmax(gains)))
        found[chosen] = -np.linalg.solve(information[np.ix_(chosen, chosen)], slope[chosen])
    return found


def _resized(state: Unknowns, grown: Array) -> Unknowns:
    """Return the state with markers larger by factors of these logarithms (m,)."""
    corners = state.landmarks.reshape(-1, 4, 3)
    middles = corners.mean(axis=1, keepdims=True)
    larger = middles + np.exp(grown)[:, None, None] * (corners - middles)
    return state.with_landmarks(larger.reshape(-1, 3))


def _wrong_sizes(said: Sequence[Marker], grown: Array) -> str:
    """Name markers whose size disagrees with most, and the sizes that would fit."""
    listed = [
        f"{said[k].name} {said[k].size * np.exp(grown[k]):.4f} m (given {said[k].size:.4g})"
        for k in np.flatnonzero(grown).tolist()
    ]
    return (
        f"{len(listed)} of {len(said)} markers disagree with the others about metres; these "
        f"sizes would fit: {', '.join(listed)}: measure them, and give --size ID:M for "
        "those that differ"
    )


def _fitting(
    posed: Sequence[RigImages], seen: Sequence[SplineKeypoints], inliers: BoolArray, count: int
) -> tuple[BoolArray, BoolArray]:
    """Return masks (m,) of markers connected by fitting frames, and of those that do not fit.

    Two walls of which each fits by itself, and no image that shows both, are not one map.
    """
    number = {image: k for k, frame in enumerate(posed) for image in frame.images}
    pairs = [(camera, k) for camera, each in enumerate(seen) for k in each.frames.tolist()]
    markers = np.concatenate([each.points for each in seen]) // 4
    cells = len(posed) * markers + np.array([number[pair] for pair in pairs], np.int64)
    corners, fit = (
        np.bincount(cells, weights, count * len(posed)).reshape(count, -1)
        for weights in (None, inliers)
    )
    shown, whole = corners > 0, (corners > 0) & (fit == corners)
    most = 2 * whole.sum(axis=1) > shown.sum(axis=1)
    whole &= most[:, None]
    together = whole.astype(float) @ whole.T
    labels = connected_components(csr_array(together), directed=False)[1]
    fits = most & (labels == np.argmax(np.bincount(labels)))
    often = (shown & ~whole).sum(axis=1) >= _LEAST_SIGHTS
    often[0] = True  # all others are in the frame of the origin
    return fits, ~fits & often


def _check_fit(fitted: Fit) -> None:
    share = float(np.mean(fitted.inliers))
    if share < _LEAST_FIT:
        raise ValueError(
            f"{100 * share:.0f} % of the corners fit the survey, {100 * _LEAST_FIT:.0f} % should: "
            f"check the readout time and the calibration; {MISFIT}"
        )


def _check_places(survey: Survey) -> None:
    if np.mean(survey.poor) > 0.5:
        off = np.median(np.linalg.norm(survey.deviations_of_shape[:, :PLACE], axis=1))
        size = np.median([marker.size for marker in survey.markers])
        raise ValueError(
            f"most markers would be known to {1e3 * off:.0f} mm only, of {1e3 * size:.0f} mm: go "
            "nearer, for longer, with a sharper picture, and show more of them at once"
        )


def _cameras(given: Adjustable, fitted: Fit) -> Iterator[Adjusted]:
    """Yield the cameras, with the readout times that corners ask for instead of given ones."""
    problem, asked = given.problem(fitted.state, fitted.freedom), fitted
    if any(one.camera.readout_time > 0.0 for one in given.filmed):
        asked = given.fit(fitted.state, fitted.freedom, fitted.deviation, True)
        asked = cluster_robust(given.problem(asked.state, asked.freedom, True), asked)
    free = given.problem(asked.state, asked.freedom, True)
    for place, one in enumerate(given.filmed):
        state, wanted = ((fit.state, *fit.state.others)[place] for fit in (fitted, asked))
        known = one.camera.readout_time > 0.0
        at = free.place("readout", place)
        apart = disagreement(*by_seconds(free, asked, at))
        deviation = apart * math.sqrt(asked.border_covariance[at, at])
        deviations = np.zeros(EXTRINSICS)
        if one.mounting is not None:
            at = problem.place("mount", place)
            deviations = np.sqrt(np.diag(fitted.border_covariance)[at:][:EXTRINSICS])
        yield Adjusted(
            one.camera,
            state.readout_time,
            math.nan if known else deviation,
            ReadoutCheck(one.camera.readout_time, wanted.readout_time, deviation)
            if known
            else None,
            state.extrinsics,
            deviations,
        )


def _often(filmed: Sequence[Filmed], shown: Sequence[list[int]], chained: Chained) -> list[int]:
    """Return the origin first, then the other markers that enough images show."""
    counts: dict[int, int] = dict.fromkeys(chained.markers, 0)
    for one, images in zip(filmed, shown, strict=True):
        for k in images:
            for marker in one.spotted[k].markers.tolist():
                if marker in counts:
                    counts[marker] += 1
    origin, *others = chained.markers
    return [origin, *(marker for marker in others if counts[marker] >= _LEAST_SIGHTS)]


def _observations(
    filmed: Filmed, images: list[int], times: Array, markers: Sequence[Marker], chained: Chained,
    own: list[int],
) -> SplineKeypoints:  # fmt: skip
    """Return all corners of some images of a camera.

    Args:
        times: (g,) s, of all images.
    """
    place = {marker: k for k, marker in enumerate(own)}
    frames, points, pixels = [], [], [np.zeros((0, 2))]
    for k in images:
        spotted = filmed.spotted[k]
        for marker, quad in zip(spotted.markers.tolist(), spotted.quads, strict=True):
            if marker in place:
                frames += [k] * 4
                points += (4 * place[marker] + np.arange(4)).tolist()
                pixels.append(quad)
    landmarks = np.concatenate([
        Pose(chained.markers[m].translation, chained.markers[m].rotation)(markers[m].corners)
        for m in own
    ])  # fmt: skip
    all_pixels, all_frames = np.concatenate(pixels), np.array(frames, np.int64)
    return SplineKeypoints(
        times=times[all_frames],
        row_times=filmed.camera.row_time(all_pixels),
        pixels=all_pixels,
        landmarks=landmarks,
        points=np.array(points, np.int64),
        frames=all_frames,
        trusted=np.ones(len(all_frames), np.bool_),
        bodies=np.repeat(np.arange(len(own)) - 1, 4),
    )
