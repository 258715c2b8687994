# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A map from views: COLMAP's structure, the rolling shutter, metres.

1. COLMAP extracts, matches and maps the keyframes, with a global shutter; without a calibration it
   finds the lens as well.
2. The views between them are localized on that map.
3. Motion and the most useful landmarks are adjusted together, each keypoint at its row's time. A
   readout time that nobody knows is estimated along both axes of the image, and believed where it
   explains the images better than a global shutter.
4. All landmarks are triangulated with that motion, and so is what gives the map its metres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.tools.mapping import MappingError
from rs_localizer.tools.mapping.anchors import (
    Anchors,
    Placement,
    determined_corners,
    marker_constraints,
    placement,
)
from rs_localizer.tools.mapping.colmap import Effort, Stage, Structure, build_structure
from rs_localizer.tools.mapping.gauge import Similarity, laid_on_held, scaled
from rs_localizer.tools.mapping.observations import (
    MapObservations,
    Start,
    adjusted_part,
)
from rs_localizer.tools.mapping.refine import DRIFT, RefinedMap, refine
from rs_localizer.tools.mapping.shutter_fit import (
    LEAST_FIT,
    colmap_freedom,
    fit_shutter,
    likely_axes,
)
from rs_localizer.tools.mapping.track_on_map import track_on_map
from rs_localizer.tools.mapping.triangulation import Sights, Triangulated, moves, triangulate
from rs_localizer.tools.mapping.views import View, blurred
from rs_localizer.tools.readout_belief import ReadoutCheck, ShutterFit

# Settings of the localizer are in metres: so far (m) is the median landmark taken to be from where
# it is seen, until it is known how far it is.
USUAL_DISTANCE = 2.5
# A view with fewer features is blurred, dark, or of a blank wall.
_FEW_FEATURES = 50
_LEAST_VIEWS = 3
# Pictures in which features move by less than this share of their size (median) show no depth.
_LEAST_PARALLAX = 0.01
# COLMAP gets all views of a short recording and so many a second of a long one: at a turn of 60
# degrees a second, neighbours have three quarters of a picture of 60 degrees in common.
_KEYFRAMES, _KEYFRAMES_PER_SECOND = 60, 4.0
# Share of the keyframes that must hang together.
_LEAST_PART = 0.5
# Errors that landmarks share are told of so many modes. Of a walk of 12 s around a room they are
# 96 % of all (squared, in the landmarks' own deviations); they are as long as a SIFT descriptor.
_MODES = 40
# A landmark counts when so many views agree, and it is known to this part of its usual distance.
_LEAST_SIGHTS, _MOST_DEVIATION = 3, 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Given:
    """What a map is built from."""

    views: Sequence[View]  # in the order of their stamps
    camera: Camera | None  # its lens; None: COLMAP finds it
    anchors: Anchors
    readout_time: float | None = None  # s, 0: a global shutter; None: estimated
    scan_direction: str | None = None  # None: unknown
    frame: str = "map"

    @property
    def stamps_ns(self) -> IntArray:
        return np.array([view.stamp_ns for view in self.views], np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Workshop:
    """Where and how the work is done."""

    folder: Path  # for COLMAP's files, which stay
    effort: Effort
    stage: Stage  # of each part: its name and number of steps in; what counts them comes out


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Where the camera was when it took some of the views."""

    rows: IntArray  # (g,) of the views
    times: Array  # (g,) s since the refinement's start, of the middle rows
    refined: RefinedMap

    def sights(self, views: IntArray, landmarks: IntArray, pixels: Array) -> Sights:
        """Keypoints (n,) of those views that have a pose, with that at the time of their rows."""
        place = np.minimum(np.searchsorted(self.rows, views), len(self.rows) - 1)
        known = self.rows[place] == views
        at, pixels = place[known], pixels[known]
        camera = self.refined.camera
        times = self.times[at] + self.refined.readout_time * camera.row_time(pixels)
        states = self.refined.spline.states(times)
        return Sights(states.rotations, states.positions, pixels, landmarks[known])

    def moves(self, seen: tuple[IntArray, IntArray, Array], triangulated: Triangulated) -> Array:
        """How a deviation of each error of the motion moves points (p,3,k) triangulated so."""
        others = [replace(self, refined=drift) for drift in self.refined.drifts]
        by_drift = moves(
            self.refined.camera, self.sights(*seen), triangulated,
            [(other.refined.camera, other.sights(*seen)) for other in others],
        )  # fmt: skip
        return by_drift / DRIFT


@dataclass(frozen=True, slots=True, eq=False)
class Built:
    """A map and how it came about; all in the map's frame, in metres if it is scaled."""

    landmarks: Map
    camera: Camera  # with its lens, readout time and scan direction, as they were found
    placement: Placement
    keyframes: IntArray  # rows of the views that COLMAP got
    blurred: BoolArray  # of the views
    structure: Structure  # as COLMAP had it, moved into this frame as a whole
    kept: IntArray  # (l,) rows of the structure's points that are landmarks
    shutter: ShutterFit | None  # None: it was given, and the images do not contradict it
    readout_check: ReadoutCheck | None  # of a given one
    refined: RefinedMap  # in a frame of its own
    posed: IntArray  # (g,) rows of the views with a pose
    rotations: Array  # (g,3,3) map_from_camera at their middle rows
    positions: Array  # (g,3)

    def middle_rows(self, stamps_ns: Sequence[int]) -> tuple[IntArray, Array, Array]:
        """Times (g,) ns of the middle rows, positions (g,3), quaternions (g,4) of the poses.

        Args:
            stamps_ns: of all views.
        """
        delay = -self.camera.readout_time * self.camera.first_row_time
        times = np.array(stamps_ns, np.int64)[self.posed] + round(1e9 * delay)
        return times, self.positions, Rotation.from_matrix(self.rotations).as_quat()


def build_map(inputs: Given, work: Workshop) -> Built:
    """Build a map.

    Raises:
        ValueError: when the images make no map, saying what was found.
    """
    check_views(inputs.views)
    unsharp = blurred(inputs.views)
    keyframes = choose_keyframes(inputs.stamps_ns, inputs.views)
    structure = _structure(inputs, keyframes, work)
    camera = replace(
        structure.camera,
        readout_time=inputs.readout_time or 0.0,
        scan_direction=likely_axes(structure.camera.size, inputs.scan_direction)[0],
    )
    with work.stage("track", len(inputs.views)) as step:
        rows, shown, start = track_on_map(inputs.views, structure, camera, lambda: step(1))
    used, adjusted, near = adjusted_part(shown, start, work.effort.adjusted)
    refined, shutter, check = _refined(inputs, adjusted, near, camera, work)
    estimated = None if inputs.camera is not None else structure.camera.focal_length
    check_fit(refined.fit_share, estimated)
    motion = Motion(rows[used], refined.times, refined)
    seen = rows[shown.images], shown.landmarks, shown.pixels
    triangulated = triangulate(refined.camera, motion.sights(*seen), len(structure.points))
    anchors = inputs.anchors.seen(inputs.views)
    held = triangulate(refined.camera, motion.sights(*anchors), inputs.anchors.count)
    place = placement(inputs.anchors, held, *refined.poses())
    similarity = place.similarity
    kept = _kept(triangulated, motion)
    modes = motion.moves(seen, triangulated)[kept]
    holding, by = triangulated.chosen(kept), modes
    if inputs.anchors.marker_map is not None:
        corners = np.flatnonzero(determined_corners(inputs.anchors.marker_map, held))
        holding, by = held.chosen(corners), motion.moves(anchors, held)[corners]
    modes = laid_on_held(triangulated.points[kept], modes, holding, by)
    rotations, positions = motion.refined.poses()
    return Built(
        landmarks=_landmarks(
            triangulated.chosen(kept), modes, structure.descriptors[kept], similarity, inputs.frame
        ),
        camera=refined.camera_as_found,
        placement=place,
        keyframes=keyframes,
        blurred=unsharp,
        structure=structure.moved(similarity),
        kept=kept,
        shutter=shutter,
        readout_check=check,
        refined=refined,
        posed=motion.rows,
        rotations=similarity.rotation @ rotations,
        positions=similarity(positions),
    )  # fmt: skip


def check_views(views: Sequence[View]) -> None:
    """Refuse, before minutes of work, views that will make no map.

    Raises:
        MappingError: saying what was found and what to film instead.
    """
    if len(views) < _LEAST_VIEWS:
        raise MappingError(f"{len(views)} images make no map; at least {_LEAST_VIEWS} are needed")
    check_features(views)
    first, step = views[0], max(1, len(views) // 8)
    moved = [_moved(first, view) for view in views[step::step]]
    if all(share < _LEAST_PARALLAX for share in moved):
        raise MappingError(
            f"the camera hardly moves (features by {100.0 * max(moved):.1f} % of the picture's "
            "size): walk sideways and around what is to be mapped"
        )


def check_features(views: Sequence[View]) -> None:
    """Refuse views that show too little.

    Raises:
        MappingError: saying what was found.
    """
    features = float(np.median([len(view.features) for view in views]))
    if features < _FEW_FEATURES:
        raise MappingError(
            f"the images show {features:.0f} features each (median), at least {_FEW_FEATURES} are "
            "needed: are they blurred, dark, or of blank walls?"
        )


def _moved(one: View, other: View) -> float:
    """How far features move (median), by the size of the picture; infinite: they are others."""
    if min(len(one.features), len(other.features)) < _FEW_FEATURES:
        return math.inf
    matcher = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True)
    matches = matcher.match(
        one.features.descriptors.astype(np.float32), other.features.descriptors.astype(np.float32)
    )
    here = one.features.pixels[[match.queryIdx for match in matches]]
    there = other.features.pixels[[match.trainIdx for match in matches]]
    if len(matches) < _FEW_FEATURES:
        return math.inf
    size = np.ptp(np.vstack([here, there]), axis=0).max()
    return float(np.median(np.linalg.norm(there - here, axis=1)) / size)


def choose_keyframes(stamps_ns: IntArray, views: Sequence[View]) -> IntArray:
    """Rows (k,) of the views that COLMAP gets: evenly spaced, the sharpest of each few."""
    seconds = 1e-9 * float(stamps_ns[-1] - stamps_ns[0])
    count = max(_KEYFRAMES, math.ceil(_KEYFRAMES_PER_SECOND * seconds))
    slots = np.array_split(np.arange(len(views)), min(count, len(views)))
    return np.array([max(slot, key=lambda row: views[row].sharpness) for slot in slots], np.int64)


def _structure(inputs: Given, keyframes: IntArray, work: Workshop) -> Structure:
    """The first structure, of about the right size."""
    structure = build_structure(
        inputs.views[0].image.parent, keyframes, inputs.camera, work.folder, work.effort, work.stage
    )
    total = len(keyframes)
    if structure.parts[0] < max(_LEAST_VIEWS, _LEAST_PART * total):
        listed = " and ".join(map(str, structure.parts))
        raise MappingError(
            f"reconstruction is disconnected (components of {listed} keyframes, of {total}): "
            "record what lies between them, slowly, without blank walls"
        )
    places = structure.positions[np.searchsorted(structure.views, structure.seen_views)]
    depths = np.linalg.norm(structure.points[structure.seen_points] - places, axis=1)
    return structure.moved(scaled(USUAL_DISTANCE / float(np.median(depths))))


def _refined(
    inputs: Given, observations: MapObservations, start: Start, camera: Camera, work: Workshop
) -> tuple[RefinedMap, ShutterFit | None, ReadoutCheck | None]:
    """The refined map; a shutter that was unknown or wrong; check of a given one."""
    freedom = colmap_freedom(observations, start, inputs.camera is None)
    freedom = replace(freedom, drifts=_MODES)
    if inputs.anchors.marker_map is not None:
        corners = _corners(inputs, observations.stamps_ns)
        places = inputs.anchors.marker_map.points
        observations, start, deviations = marker_constraints(
            camera, observations, start, corners, places
        )
        freedom = replace(freedom, deviations=deviations)
    directions = likely_axes(camera.size, inputs.scan_direction)
    unknown, check = inputs.readout_time is None, None
    with work.stage("refine", 3 * (1 + len(directions)) if unknown else 3) as step:

        def done(_: str) -> None:
            step(1)

        if not unknown:
            refined = refine(camera, observations, start, freedom, done=done)
            check = refined.readout_check
            if check is None or not check.differs:
                return refined, None, check
            # A map adjusted with the wrong one is bent to it, and fits it nearly as well.
            directions = [ScanDirection(camera.scan_direction)]
        fitted = fit_shutter(camera, observations, start, freedom, directions, done)
        return *fitted, check


def _corners(inputs: Given, stamps_ns: IntArray) -> MapObservations:
    """Corners of markers in the images with these stamps."""
    views, corners, pixels = inputs.anchors.seen(inputs.views)
    stamps = inputs.stamps_ns[views]
    images = np.minimum(np.searchsorted(stamps_ns, stamps), len(stamps_ns) - 1)
    known = stamps_ns[images] == stamps
    return MapObservations(stamps_ns, images[known], corners[known], pixels[known])


def check_fit(share: float, focal_length: float | None) -> None:
    """Images too far apart leave the motion between them open, and the map may follow it.

    Args:
        share: of the keypoints that fit.
        focal_length: px, that COLMAP found; None: it was given.

    Raises:
        MappingError: saying what to do.
    """
    if share >= LEAST_FIT:
        return
    lens = "" if focal_length is None else (
        f"; COLMAP found a focal length of {focal_length:.0f} px, which a flat scene does not "
        "determine: give --calibration, or show more depth"
    )  # fmt: skip
    raise MappingError(
        f"after the refinement {100 * share:.0f} % of the keypoints fit the map, "
        f"{100 * LEAST_FIT:.0f} % should: use more images per second, film more slowly, or "
        f"check the readout time and the calibration{lens}"
    )


def _kept(triangulated: Triangulated, motion: Motion) -> IntArray:
    """Rows of the points that are good enough to be landmarks."""
    _, positions = motion.refined.poses()
    away = np.linalg.norm(triangulated.points - np.median(positions, axis=0), axis=1)
    good = triangulated.counts >= _LEAST_SIGHTS
    good &= triangulated.spread < _MOST_DEVIATION * np.nanmedian(away)
    if not good.any():
        raise MappingError(
            f"none of {len(good)} landmarks is seen by {_LEAST_SIGHTS} images that determine it"
        )
    return np.flatnonzero(good)


def _landmarks(
    known: Triangulated, modes: Array, descriptors: np.ndarray, to_map: Similarity, frame: str
) -> Map:
    turn = to_map.scale * to_map.rotation
    return Map(
        to_map(known.points),
        np.arange(len(known.points)),
        np.ascontiguousarray(descriptors),
        frame,
        covariances=turn @ known.covariances @ turn.T,
        error_modes=np.asarray(turn @ modes, np.float32),
    )
