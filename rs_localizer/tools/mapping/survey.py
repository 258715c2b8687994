# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses of markers, from a recording that shows them.

Continuous-time adjustment with the poses of the markers free, each a rigid square of known size.
The first marker is the origin; whatever shows several of them closes loops.

A square that is seen from one side fits two poses. From few directions the wrong one is a minimum,
too, which no adjustment leaves (Collins and Bartoli, *Infinitesimal plane-based pose estimation*,
IJCV 2014). With the motion held, each marker is mirrored about its mean line of sight, adjusted on
its own, and compared.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.markers.prints import Marker, Pose
from rs_localizer.tools.adjust.fit import Fit, by_seconds, cluster_robust, fit
from rs_localizer.tools.adjust.problem import Problem
from rs_localizer.tools.adjust.reprojection import LIMIT
from rs_localizer.tools.adjust.system import Undetermined
from rs_localizer.tools.adjust.variables import (
    BODY,
    PLACE,
    CameraView,
    Freedom,
    SplineKeypoints,
    Unknowns,
    start_state,
)
from rs_localizer.tools.mapping.gauge import of_the_shape, through
from rs_localizer.tools.mapping.map_keypoints import (
    ANGULAR_VELOCITY,
    LINEAR_VELOCITY,
    Adjusted,
    acceleration_prior,
    initial_trajectory,
)
from rs_localizer.tools.mapping.unknown_markers import Chained, Filmed, chain
from rs_localizer.tools.readout_belief import ReadoutCheck, disagreement

# Steps of Gauss and Newton, and the noise of each by what it is.
_NOISES = (10.0,) * 6 + (1.0,) * 4
# Least difference of the costs of independent errors: the other pose is e^6 times less likely, or
# it may be true.
_LEAST_DIFFERENCE = 12.0


def _problem(seen: SplineKeypoints, fitted: Fit) -> Problem:
    """Return the problem whose minimum a fit is."""
    return Problem([CameraView(seen, fitted.freedom)], fitted.state)


def _mirrored(seen: SplineKeypoints, fitted: Fit) -> tuple[BoolArray, BoolArray, Unknowns]:
    """Compare each marker with its mirror image, the motion held.

    Returns:
        which markers (m,) fit better mirrored, which fit nearly as well one way or the other, and
        the state with those mirrored that fit better so.
    """
    count = len(fitted.state.landmarks) // 4
    # The origin, too, may lie the other way among all others.
    every = replace(seen, bodies=np.repeat(np.arange(count), 4))
    free = replace(fitted.freedom, readout_time=False)
    problem = Problem([CameraView(every, free)], fitted.state)
    other = replace(fitted.state, landmarks=_turned_over(seen, fitted.state))
    still, at = np.zeros(problem.groups.motion), np.arange(BODY * count).reshape(count, BODY)
    for noise in _NOISES:  # each marker steps on its own
        system = problem.system(other, noise * fitted.deviation)
        blocks = system.corner[at[:, :, None], at[:, None, :]]
        slopes = system.slope[len(still) :][at][..., None]
        steps = -np.linalg.solve(blocks, slopes).ravel()
        other = problem.moved(other, np.concatenate([still, steps]))
    own, theirs = (_costs(problem, state, fitted.deviation) for state in (fitted.state, other))
    better = theirs < own
    doubtful = np.abs(theirs - own) < _LEAST_DIFFERENCE * fitted.inflation
    # A pose that came back is the same one.
    apart = _normals(other) * _normals(fitted.state)
    same = np.sum(apart, axis=1) > np.cos(0.02)
    before, turned = fitted.state.landmarks, np.repeat(better & ~same, 4)
    chosen = np.where(turned[:, None], other.landmarks, before)
    back = through(chosen[:4], before[:4])  # the first four stay in place
    landmarks = np.concatenate([before[:4], back(chosen[4:])])
    state = replace(fitted.state, spline=back.moved(fitted.state.spline), landmarks=landmarks)
    return better & ~same, doubtful & ~same, state


def _turned_over(seen: SplineKeypoints, state: Unknowns) -> Array:
    """Return corners (p,3) of each marker mirrored in depth as its images see it."""
    layout, corners = state.spline.layout, state.landmarks.reshape(-1, 4, 3)
    middles, markers = corners.mean(axis=1), seen.points // 4
    times = np.clip(seen.times, layout.starts.min(), layout.ends.max())
    toward = state.spline.states(times).positions - middles[markers]
    toward = toward / np.linalg.norm(toward, axis=1)[:, None]
    sight = np.column_stack([np.bincount(markers, of, len(corners)) for of in toward.T])
    sight = sight / np.maximum(np.linalg.norm(sight, axis=1), 1e-12)[:, None]
    depth = np.einsum("mci,mi->mc", corners - middles[:, None], sight)
    return np.asarray(corners - 2.0 * depth[..., None] * sight[:, None]).reshape(-1, 3)


def _costs(problem: Problem, state: Unknowns, deviation: float) -> Array:
    """Return Tukey's costs of the corners of each marker (m,)."""
    limit = (LIMIT * deviation) ** 2
    rest = np.maximum(1.0 - problem.errors(state) / limit, 0.0)
    costs = (1.0 - rest**3) * limit / (3.0 * deviation**2)
    points = problem.views[0].observations.points
    return np.asarray(np.bincount(points // 4, costs, len(state.landmarks) // 4), np.float64)


def _normals(state: Unknowns) -> Array:
    """Return normals of the markers (m,3)."""
    corners = state.landmarks.reshape(-1, 4, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1])
    return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None])


_LEAST_IMAGES = 5
# Images that show a marker: fewer say hardly anything of it.
_LEAST_SIGHTS = 3
# The noise about the first guess is taken for at least and at most this (px).
_FIRST_NOISE = 5.0, 50.0
# px, at first; an image of one marker has two numbers more than its pose.
_LEAST_NOISE = 0.05
# Share of the corners that fit where nothing is wrong: nearly all do.
_LEAST_FIT = 0.8
# Corners that are off by so many times what still fits are those of another marker: of an id that
# is used twice, most images may fit. What a wrong shutter moves is not so far off.
_FAR = 5.0
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
    shutter: Adjusted
    images: int  # that show markers of the map

    @property
    def poor(self) -> BoolArray:
        """Which markers (m,) are known worse, beside the others, than a tenth of their size."""
        off = np.linalg.norm(self.deviations_of_shape[:, :PLACE], axis=1)
        return np.asarray(off > _POOR * np.array([marker.size for marker in self.markers]))

    @property
    def deviations_of_shape(self) -> Array:
        """Standard deviations (m,6) of what is left when all are laid over the truth."""
        return np.sqrt(np.diagonal(self.covariance_of_shape)).reshape(-1, BODY)


def survey(filmed: Filmed, markers: Sequence[Marker], *, origin: int | None = None) -> Survey:
    """Survey the markers that a camera shows.

    Args:
        filmed: the images.
        markers: all that may be there, by their sizes; where they are does not matter.
        origin: place of the marker whose frame is the map's; None: the first one.

    Raises:
        ValueError: when the images say too little, or markers fit no others, with what was found.
    """
    filmed = replace(filmed, spotted=[image for image in filmed.spotted if len(image.markers)])
    if (shown := len(filmed.spotted)) < _LEAST_IMAGES:
        raise ValueError(f"{shown} images show a whole marker, at least {_LEAST_IMAGES} are needed")
    if origin is not None and not any(origin in one.markers for one in filmed.spotted):
        raise ValueError(f"the origin, {markers[origin].name}, is in no image")
    chained = chain(filmed, markers, origin)
    if len(chained.markers) < 2:
        raise ValueError(
            f"no image shows {markers[next(iter(chained.markers))].name} together with another "
            "marker: there is nothing to survey"
        )
    try:
        done = _adjusted(filmed, markers, chained)
    except Undetermined as error:
        raise ValueError(f"the images do not determine the markers' poses: {error}") from error
    if isinstance(done, Survey):
        return done
    # Their contribution to the motion is wrong, too.
    lost = tuple(markers[m] for m in done)
    if origin in done or len(chained.markers) - len(lost) < 2:
        names = ", ".join(marker.name for marker in lost)
        raise ValueError(f"{names}: the corners do not fit those of other markers: {MISFIT}")
    rest = []
    for image in filmed.spotted:
        others = ~np.isin(image.markers, done)
        rest.append(replace(image, markers=image.markers[others], quads=image.quads[others]))
    found = survey(replace(filmed, spotted=rest), markers, origin=origin)
    return replace(found, misfits=lost + found.misfits)


def _adjusted(filmed: Filmed, markers: Sequence[Marker], chained: Chained) -> Survey | list[int]:
    """Return the survey, or the markers that do not fit the others."""
    shown = np.concatenate([filmed.spotted[k].markers for k in chained.poses])
    first_one, *others = chained.markers
    often = [m for m in others if np.count_nonzero(shown == m) >= _LEAST_SIGHTS]
    own, camera, times = [first_one, *often], filmed.camera, filmed.times()
    rotations = np.array([pose.rotation for pose in chained.poses.values()])
    positions = np.array([pose.translation for pose in chained.poses.values()])
    starts = times[list(chained.poses)]
    spline = initial_trajectory(starts, rotations, positions, camera.readout_time)
    seen = _observations(filmed, times, markers, chained, own)
    seen = seen.subset(spline.layout.inside(seen.times))
    freedom = Freedom(
        readout_time=not camera.readout_time > 0.0, angular_velocity=ANGULAR_VELOCITY,
        linear_velocity=LINEAR_VELOCITY, least_noise=_LEAST_NOISE,
    )  # fmt: skip
    start = start_state(seen, spline, camera.readout_time)
    # Far off, as at the end of a chain, large errors are no outliers.
    errors = np.sqrt(Problem([CameraView(seen, freedom)], start).errors(start))
    first = float(np.clip(np.median(errors), *_FIRST_NOISE))
    fitted = fit(seen, start, freedom, first)
    if (calmer := acceleration_prior(fitted.state, freedom)) is not None:
        fitted = fit(seen, fitted.state, calmer, fitted.deviation)
    fitted, doubtful = _right_side_up(seen, fitted)
    fitted = _less_noise(seen, fitted)
    share = float(np.mean(fitted.inliers))
    if share < _LEAST_FIT:
        raise ValueError(
            f"{100 * share:.0f} % of the corners fit the survey, {100 * _LEAST_FIT:.0f} % should: "
            f"check the readout time and the calibration; {MISFIT}"
        )
    fits, misfits = _fitting(seen, fitted, len(own))
    if misfits.any():
        return [own[k] for k in np.flatnonzero(misfits)]
    fitted = cluster_robust(_problem(seen, fitted), fitted)
    corners = fitted.state.landmarks.reshape(-1, 4, 3)
    counts = np.bincount(seen.points[fitted.inliers] // 4, minlength=len(own)) // 4
    known = np.flatnonzero(fits & (counts >= _LEAST_SIGHTS) & ~doubtful)
    order = [0, *sorted(known[known > 0].tolist(), key=lambda k: own[k])]
    # In the border, too, markers come last: all but the origin.
    begin = len(fitted.border_covariance) - BODY * len(own)
    columns = (begin + BODY * np.array(order[1:])[:, None] + np.arange(BODY)).ravel()
    covariance = np.pad(fitted.border_covariance[np.ix_(columns, columns)], (BODY, 0))
    done = Survey(
        tuple(Marker(markers[own[k]].family, markers[own[k]].id, corners[k]) for k in order),
        covariance, of_the_shape(covariance, corners[order]), tuple(int(counts[k]) for k in order),
        tuple(tuple(markers[m] for m in part) for part in chained.apart),
        tuple(markers[m] for m in chained.markers if m not in {own[k] for k in order}), (), fitted,
        _shutter(seen, fitted), len(chained.poses),
    )  # fmt: skip
    if np.mean(done.poor) > 0.5:
        off = np.median(np.linalg.norm(done.deviations_of_shape[:, :PLACE], axis=1))
        size = np.median([marker.size for marker in done.markers])
        raise ValueError(
            f"most markers would be known to {1e3 * off:.0f} mm only, of {1e3 * size:.0f} mm: go "
            "nearer, for longer, with a sharper picture, and show more of them at once"
        )
    return done


def _right_side_up(seen: SplineKeypoints, fitted: Fit) -> tuple[Fit, BoolArray]:
    """Turn all markers as they fit best; return also a mask (m,) of undecided ones."""
    for _ in range(_MOST_TURNS):
        better, doubtful, other = _mirrored(seen, fitted)
        if not better.any():
            break
        turned = fit(seen, other, fitted.freedom, fitted.deviation)
        system = _problem(seen, fitted).system(turned.state, fitted.deviation)
        if system.cost > fitted.cost:
            break
        fitted = turned
    return fitted, doubtful


def _less_noise(seen: SplineKeypoints, fitted: Fit) -> Fit:
    """Fit again with corners that are better than was assumed.

    If they weigh too little, the prior of the accelerations wins, and the readout time suffers.
    """
    noise = fitted.deviation * math.sqrt(fitted.inflation)
    if fitted.deviation > _LEAST_NOISE or noise > _LEAST_NOISE:
        return fitted
    return fit(seen, fitted.state, replace(fitted.freedom, least_noise=noise), noise)


def _fitting(seen: SplineKeypoints, fitted: Fit, count: int) -> tuple[BoolArray, BoolArray]:
    """Return masks (m,) of markers connected by fitting images, and of those that do not fit.

    Two walls of which each fits by itself, and no image that shows both, are not one map.
    """
    images: IntArray = np.unique(seen.frames, return_inverse=True)[1]
    total = int(images.max()) + 1
    cells = total * (seen.points // 4) + images
    far = fitted.squared_errors > (_FAR * LIMIT * fitted.deviation) ** 2
    corners, fit_corners, far_corners = (
        np.bincount(cells, weights, count * total).reshape(count, -1)
        for weights in (None, fitted.inliers, far)
    )
    shown, whole = corners > 0, (corners > 0) & (fit_corners == corners)
    counts = shown.sum(axis=1)
    most = 2 * whole.sum(axis=1) > counts
    most &= np.sum(far_corners > 0, axis=1) <= (1.0 - _LEAST_FIT) * counts
    whole &= most[:, None]
    together = whole.astype(float) @ whole.T
    labels = connected_components(csr_array(together), directed=False)[1]
    fits = most & (labels == np.argmax(np.bincount(labels)))
    often = (shown & ~whole).sum(axis=1) >= _LEAST_SIGHTS
    often[0] = True  # all others are in the frame of the origin
    return fits, ~fits & often


def _shutter(seen: SplineKeypoints, fitted: Fit) -> Adjusted:
    """Return the camera, with the readout time that corners ask for instead of a given one."""
    camera, asked = seen.camera, fitted
    known = camera.readout_time > 0.0
    if known:
        free = replace(fitted.freedom, readout_time=True)
        asked = fit(seen, fitted.state, free, fitted.deviation)
        asked = cluster_robust(_problem(seen, asked), asked)
    problem = _problem(seen, asked)
    apart = disagreement(*by_seconds(problem, asked, problem.place("readout")))
    deviation, wanted = apart * asked.readout_time_deviation, asked.state.readout_time
    if not known:
        return Adjusted(camera, wanted, deviation, None)
    check = ReadoutCheck(camera.readout_time, wanted, deviation)
    return Adjusted(camera, camera.readout_time, math.nan, check)


def _observations(
    filmed: Filmed, times: Array, markers: Sequence[Marker], chained: Chained, own: list[int]
) -> SplineKeypoints:
    """Return all corners of some markers in the images with a pose, taken at times (g,), s."""
    place = {marker: k for k, marker in enumerate(own)}
    frames, points, pixels = [], [], []
    for k in chained.poses:
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
        filmed.camera, times[all_frames], filmed.camera.row_time(all_pixels), all_pixels, landmarks,
        np.array(points, np.int64), all_frames, np.ones(len(all_frames), np.bool_),
        bodies=np.repeat(np.arange(len(own)) - 1, 4),
    )  # fmt: skip
