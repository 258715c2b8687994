# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Where markers are, from one recording that shows them.

Continuous-time adjustment with the poses of the markers free, each a rigid square of known size.
The first marker is the origin; whatever shows several of them closes loops.

A square that is seen from one side fits two poses. From few directions the wrong one is a minimum,
too, which no adjustment leaves (Collins and Bartoli, *Infinitesimal plane-based pose estimation*,
IJCV 2014). With the motion held, each marker is mirrored about its mean line of sight, adjusted on
its own, and compared.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.camera import Camera
from rs_localizer.mapping.cluster_robust import cluster_robust
from rs_localizer.mapping.gauge import of_the_shape, through
from rs_localizer.mapping.initial_trajectory import (
    ANGULAR_VELOCITY,
    LINEAR_VELOCITY,
    acceleration_prior,
    initial_trajectory,
)
from rs_localizer.mapping.readout_check import ReadoutCheck
from rs_localizer.mapping.unknown_markers import Chained, Spotted, chain
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.prints import Marker
from rs_localizer.trajectory.banded import Undetermined
from rs_localizer.trajectory.bodies import BODY, PLACE
from rs_localizer.trajectory.fit import Fit, fit
from rs_localizer.trajectory.model import Freedom, Observations, State, start_state
from rs_localizer.trajectory.normal_kernels import Normal
from rs_localizer.trajectory.problem import LIMIT, Problem

# Steps of Gauss and Newton, and the noise of each by what it is.
_NOISES = (10.0,) * 6 + (1.0,) * 4
# Of the cost of independent errors: the other pose is e^6 times less likely, or it may be true.
_LEAST_DIFFERENCE = 12.0


@dataclass(frozen=True, slots=True, eq=False)
class Mirrored:
    """What is known of the other pose of each marker."""

    better: BoolArray  # (m,) which fit better mirrored
    doubtful: BoolArray  # (m,) which fit nearly as well, one way or the other
    state: State  # with those mirrored that fit better so


def mirrored(camera: Camera, observations: Observations, fitted: Fit) -> Mirrored:
    """Compare each marker with its mirror image, the motion held.

    Args:
        observations: corners, four of each marker; those of the first, the origin, are known.
        fitted: the adjustment of these.
    """
    count = len(fitted.state.landmarks) // 4
    # The origin, too, may lie the other way among all others.
    free = replace(observations, bodies=np.repeat(np.arange(count), 4))
    problem = Problem(camera, free, fitted.state, replace(fitted.freedom, readout_time=False))
    other = replace(fitted.state, landmarks=_turned_over(observations, fitted.state))
    for noise in _NOISES:
        normal = problem.normal(other, noise * fitted.deviation)[1]
        still = np.zeros(len(normal.slope))
        other = problem.moved(other, normal, (still, _steps(normal, count)))
    own, theirs = (_costs(problem, state, fitted.deviation) for state in (fitted.state, other))
    better = theirs < own
    doubtful = np.abs(theirs - own) < _LEAST_DIFFERENCE * fitted.inflation
    # What came back is the same pose.
    apart = _normals(other) * _normals(fitted.state)
    same = np.sum(apart, axis=1) > np.cos(0.02)
    chosen = np.where(
        np.repeat(better & ~same, 4)[:, None], other.landmarks, fitted.state.landmarks
    )
    return Mirrored(better & ~same, doubtful & ~same, _at_the_origin(fitted.state, chosen))


def _turned_over(observations: Observations, state: State) -> Array:
    """Corners (p,3) of each marker mirrored in depth as its images see it."""
    layout, corners = state.spline.layout, state.landmarks.reshape(-1, 4, 3)
    times = np.clip(observations.times, layout.starts.min(), layout.ends.max())
    markers, middles = observations.points // 4, corners.mean(axis=1)
    toward: Array = state.spline.states(times).positions - middles[markers]
    toward /= np.linalg.norm(toward, axis=1)[:, None]
    sums = [np.bincount(markers, of, len(corners)) for of in toward.T]
    sight: Array = np.column_stack(sums)
    sight /= np.maximum(np.linalg.norm(sight, axis=1), 1e-12)[:, None]
    depth = np.einsum("mci,mi->mc", corners - middles[:, None], sight)
    return np.asarray(corners - 2.0 * depth[..., None] * sight[:, None]).reshape(-1, 3)


def _steps(normal: Normal, count: int) -> Array:
    """Of all markers (6 m,), each on its own."""
    at = BODY * np.arange(count)[:, None] + np.arange(BODY)
    lower = np.tril(normal.corner[at[:, :, None], at[:, None, :]])
    blocks = lower + np.tril(lower, -1).swapaxes(1, 2)
    steps: Array = -np.linalg.solve(blocks, normal.border_slope[at][..., None]).ravel()
    return steps


def _costs(problem: Problem, state: State, deviation: float) -> Array:
    """Of the corners of each marker (m,), Tukey's."""
    limit = (LIMIT * deviation) ** 2
    rest = np.maximum(1.0 - problem.errors(state) / limit, 0.0)
    costs = (1.0 - rest**3) * limit / (3.0 * deviation**2)
    points = problem.observations.points
    return np.asarray(np.bincount(points // 4, costs, len(state.landmarks) // 4), np.float64)


def _normals(state: State) -> Array:
    """Of the markers (m,3)."""
    corners = state.landmarks.reshape(-1, 4, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1])
    return np.asarray(normals / np.linalg.norm(normals, axis=1)[:, None])


def _at_the_origin(state: State, landmarks: Array) -> State:
    """With these landmarks (p,3), and all moved so that the first four stay where they were."""
    back = through(landmarks[:4], state.landmarks[:4])
    moved = back(landmarks)
    moved[:4] = state.landmarks[:4]
    return replace(state, spline=back.moved(state.spline), landmarks=moved)


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
# Markers that were turned over may hide others.
_MOST_TURNS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Survey:
    """Markers and what is known of their errors."""

    markers: tuple[Marker, ...]  # in the frame of the first of them, the origin
    # (6 m, 6 m) of place (m) and turn (rad) along the map's axes: in the frame of the origin,
    # whose own is 0, and of the shape, wherever the whole of it lies.
    covariance: Array
    covariance_of_shape: Array
    sights: tuple[int, ...]  # images of each
    apart: tuple[tuple[Marker, ...], ...]  # not connected with these, part by part
    # Connected, but too few images show them, or do not tell which of two ways they are turned.
    rare: tuple[Marker, ...]
    images: int  # with a pose
    fit: Fit
    readout_check: ReadoutCheck | None = None  # where it was given

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
    camera: Camera, spotted: Sequence[Spotted], markers: Sequence[Marker],
    *, origin: int | None = None, stamp_offset: float = 0.0,
) -> Survey:  # fmt: skip
    """Poses of the markers of a recording.

    Args:
        camera: its lens, scan direction and readout time (0: it is to be found).
        spotted: images in the order of their stamps.
        markers: all that may be there, by their sizes; where they are does not matter.
        origin: place of the marker whose frame is the map's; None: the first one.
        stamp_offset: s from a stamp to the first row's exposure.

    Raises:
        ValueError: when the images say too little, with what was found.
    """
    images = [one for one in spotted if len(one.markers)]
    _check(images, markers, origin)
    chained = chain(camera, images, markers, origin)
    if len(chained.markers) < 2:
        raise ValueError(
            f"no image shows {markers[next(iter(chained.markers))].name} together with another "
            "marker: there is nothing to survey"
        )
    try:
        return _adjusted(camera, images, markers, chained, stamp_offset)
    except Undetermined as error:
        raise ValueError(f"the images do not determine the markers' poses: {error}") from error


def _check(images: list[Spotted], markers: Sequence[Marker], origin: int | None) -> None:
    if len(images) < _LEAST_IMAGES:
        raise ValueError(
            f"{len(images)} images show a whole marker, at least {_LEAST_IMAGES} are needed"
        )
    if origin is not None and not any(origin in one.markers for one in images):
        raise ValueError(f"the origin, {markers[origin].name}, is in no image")


def _adjusted(
    camera: Camera, images: list[Spotted], markers: Sequence[Marker], chained: Chained,
    stamp_offset: float,
) -> Survey:  # fmt: skip
    own = _often(images, chained)
    observations, times = _observations(camera, images, markers, chained, own, stamp_offset)
    rotations = np.array([pose.rotation for pose in chained.poses])
    positions = np.array([pose.translation for pose in chained.poses])
    spline = initial_trajectory(times[chained.images], rotations, positions, camera.readout_time)
    observations = observations.subset(spline.layout.inside(observations.times))
    freedom = Freedom(
        readout_time=not camera.readout_time > 0.0,
        angular_velocity=ANGULAR_VELOCITY,
        linear_velocity=LINEAR_VELOCITY,
        least_noise=_LEAST_NOISE,
    )
    start = start_state(camera, observations, spline, camera.readout_time)
    # Where a chain ends far off, its errors are large and no outliers.
    errors = np.sqrt(Problem(camera, observations, start, freedom).errors(start))
    fitted = fit(
        camera, observations, start, freedom, float(np.clip(np.median(errors), *_FIRST_NOISE))
    )
    calmer = acceleration_prior(fitted.state, freedom)
    if calmer is not None:
        fitted = fit(camera, observations, fitted.state, calmer, fitted.deviation)
    fitted, doubtful = _right_side_up(camera, observations, fitted)
    fitted = _less_noise(camera, observations, fitted)
    _check_fit(fitted)
    fitted = _believable(camera, observations, fitted)
    corners = fitted.state.landmarks.reshape(-1, 4, 3)
    placed = [
        Marker(markers[m].family, markers[m].id, of) for m, of in zip(own, corners, strict=True)
    ]
    counts = np.bincount(observations.points[fitted.inliers] // 4, minlength=len(own)) // 4
    known = [k for k in range(1, len(own)) if counts[k] >= _LEAST_SIGHTS and not doubtful[k]]
    order = [0, *sorted(known, key=lambda k: own[k])]
    covariance = _covariance(fitted, order)
    done = Survey(
        tuple(placed[k] for k in order),
        covariance,
        of_the_shape(covariance, corners[order]),
        tuple(int(counts[k]) for k in order),
        tuple(tuple(markers[m] for m in part) for part in chained.apart),
        tuple(markers[m] for m in chained.markers if m not in {own[k] for k in order}),
        len(chained.images),
        fitted,
        None if fitted.freedom.readout_time else _asked(camera, observations, fitted),
    )
    _check_places(done)
    return done


def _right_side_up(
    camera: Camera, observations: Observations, fitted: Fit
) -> tuple[Fit, BoolArray]:
    """With all markers turned as they fit best, and for which (m,) that cannot be told."""
    for _ in range(_MOST_TURNS):
        other = mirrored(camera, observations, fitted)
        if not other.better.any():
            break
        turned = fit(camera, observations, other.state, fitted.freedom, fitted.deviation)
        problem = Problem(camera, observations, fitted.state, fitted.freedom)
        if problem.normal(turned.state, fitted.deviation)[0] > fitted.cost:
            break
        fitted = turned
    return fitted, other.doubtful


def _less_noise(camera: Camera, observations: Observations, fitted: Fit) -> Fit:
    """With corners that are better than was taken for granted.

    Weighed too little, they lose to what is known of accelerations beforehand, and the readout time
    with them.
    """
    noise = fitted.deviation * math.sqrt(fitted.inflation)
    if fitted.deviation > _LEAST_NOISE or noise > _LEAST_NOISE:
        return fitted
    return fit(
        camera, observations, fitted.state, replace(fitted.freedom, least_noise=noise), noise
    )


def _believable(camera: Camera, observations: Observations, fitted: Fit) -> Fit:
    """With covariances as large as the corners' errors show."""
    return cluster_robust(Problem(camera, observations, fitted.state, fitted.freedom), fitted)


def _covariance(fitted: Fit, order: list[int]) -> Array:
    """Of the markers (6 m, 6 m) in an order whose first is the origin, number 0."""
    shared = len(fitted.border_covariance) - BODY * (len(fitted.state.landmarks) // 4 - 1)
    columns = shared + (BODY * (np.array(order[1:]) - 1)[:, None] + np.arange(BODY)).ravel()
    covariance = np.zeros((BODY * len(order),) * 2)
    covariance[BODY:, BODY:] = fitted.border_covariance[np.ix_(columns, columns)]
    return covariance


def _check_fit(fitted: Fit) -> None:
    share = float(np.mean(fitted.inliers))
    if share < _LEAST_FIT:
        raise ValueError(
            f"{100 * share:.0f} % of the corners fit the survey, {100 * _LEAST_FIT:.0f} % should: "
            "check the readout time, the calibration, and that no id hangs twice"
        )


def _check_places(survey: Survey) -> None:
    if np.mean(survey.poor) > 0.5:
        off = np.median(np.linalg.norm(survey.deviations_of_shape[:, :PLACE], axis=1))
        size = np.median([marker.size for marker in survey.markers])
        raise ValueError(
            f"most markers would be known to {1e3 * off:.0f} mm only, of {1e3 * size:.0f} mm: go "
            "nearer, for longer, with a sharper picture, and show more of them at once"
        )


def _asked(camera: Camera, observations: Observations, fitted: Fit) -> ReadoutCheck:
    """The readout time that the corners ask for where one was given."""
    free = fit(
        camera,
        observations,
        fitted.state,
        replace(fitted.freedom, readout_time=True),
        fitted.deviation,
    )
    free = _believable(camera, observations, free)
    given = float(fitted.state.readout_time)
    return ReadoutCheck(given, float(free.state.readout_time), free.readout_time_deviation)


def _often(images: list[Spotted], chained: Chained) -> list[int]:
    """The origin first, then the other markers that enough images show."""
    counts: dict[int, int] = dict.fromkeys(chained.markers, 0)
    for k in chained.images:
        for marker in images[k].markers.tolist():
            if marker in counts:
                counts[marker] += 1
    origin, *others = chained.markers
    return [origin, *(marker for marker in others if counts[marker] >= _LEAST_SIGHTS)]


def _observations(
    camera: Camera, images: list[Spotted], markers: Sequence[Marker], chained: Chained,
    own: list[int], stamp_offset: float,
) -> tuple[Observations, Array]:  # fmt: skip
    """All corners, and the times (g,) of the images' middle rows since the first stamp."""
    start_ns = images[0].stamp_ns
    delay = stamp_offset - camera.readout_time * camera.first_row_time
    times = np.array([(image.stamp_ns - start_ns) * 1e-9 for image in images]) + delay
    place = {marker: k for k, marker in enumerate(own)}
    frames, points, pixels = [], [], []
    for k in chained.images:
        for marker, quad in zip(images[k].markers.tolist(), images[k].quads, strict=True):
            if marker in place:
                frames.append(np.full(4, k))
                points.append(4 * place[marker] + np.arange(4))
                pixels.append(quad)
    landmarks = np.concatenate([
        Pose(chained.markers[m].translation, chained.markers[m].rotation)(markers[m].corners)
        for m in own
    ])  # fmt: skip
    all_pixels, all_frames = np.concatenate(pixels), np.concatenate(frames)
    observations = Observations(
        times=times[all_frames],
        row_times=camera.row_time(all_pixels),
        pixels=all_pixels,
        landmarks=landmarks,
        points=np.concatenate(points),
        frames=all_frames,
        trusted=np.ones(len(all_frames), np.bool_),
        bodies=np.repeat(np.arange(len(own)) - 1, 4),
    )
    return observations, times
