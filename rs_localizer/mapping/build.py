"""A map from views: structure, motion, refinement with the rolling shutter, metres.

1. Keyframes are matched and mapped by COLMAP, with a global shutter.
2. Every view is localized on that map, with its shutter: what it shows, and a first motion.
3. Motion and the most useful landmarks are adjusted together, each keypoint at its row's time.
4. All landmarks are triangulated with that motion, and so is what gives the map its metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.io.maps.colmap import medoid
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.mapping.anchors import Anchors, Placement, placement
from rs_localizer.mapping.errors import MappingError
from rs_localizer.mapping.following import follow
from rs_localizer.mapping.inertial_placing import (
    GivenImu,
    InertialPlace,
    place_by_imu,
    refuse_early,
)
from rs_localizer.mapping.keyframes import Keyframes, choose_keyframes
from rs_localizer.mapping.refine import MapFreedom, RefinedMap, refine
from rs_localizer.mapping.sightings import Sightings
from rs_localizer.mapping.sights import Seen, all_seen, for_adjustment
from rs_localizer.mapping.similarity import Similarity, scaled
from rs_localizer.mapping.structure import Effort, Stage, Structure, build_structure
from rs_localizer.mapping.tied import tied
from rs_localizer.mapping.triangulation import Sights, Triangulated, triangulate
from rs_localizer.mapping.views import View

# Settings of the localizer are in metres: so far (m) is the median landmark taken to be from where
# it is seen, until it is known how far it is.
_USUAL_DISTANCE = 2.5
# A view with fewer features is blurred, dark, or of a blank wall.
_FEW_FEATURES = 50
_LEAST_VIEWS = 3
# Share of the keypoints that fit a good map: nine in ten do.
_LEAST_FIT = 0.8
# Share of the keyframes that must hang together.
_LEAST_PART = 0.5
# A landmark counts when so many views agree, and it is known to this part of its usual distance.
_LEAST_SIGHTS, _MOST_DEVIATION = 3, 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Given:
    """What a map is built from."""

    views: Sequence[View]  # in the order of their stamps
    camera: Camera  # of all of them, with its readout time (0: a global shutter, or not known)
    anchors: Anchors
    estimate_readout: bool = False
    frame: str = "map"
    imu: GivenImu | None = None

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

    def poses(self) -> tuple[Array, Array]:
        """map_from_camera (g,3,3), (g,3) at the middle rows, in the refinement's frame."""
        return self.refined.poses()

    def sights(self, seen: Seen) -> Sights:
        """Keypoints with the pose at the time of their rows."""
        camera = self.refined.camera
        readout_time = self.refined.readout_time
        times = self.times[seen.images] + readout_time * camera.row_time(seen.pixels)
        states = self.refined.spline.states(times)
        return Sights(states.rotations, states.positions, seen.pixels, seen.landmarks)

    def seen(self, views: IntArray, landmarks: IntArray, pixels: Array) -> Seen:
        """What those of the views (n,) show that have a pose."""
        place = np.minimum(np.searchsorted(self.rows, views), len(self.rows) - 1)
        known = self.rows[place] == views
        return Seen(place[known], landmarks[known], pixels[known])


@dataclass(frozen=True, slots=True, eq=False)
class Built:
    """A map and how it came about; all in the map's frame, in metres if it is scaled."""

    landmarks: Map
    camera: Camera  # with its readout time and scan direction, as they were found
    place: InertialPlace
    keyframes: Keyframes
    structure: Structure  # as COLMAP had it, moved into this frame as a whole
    kept: IntArray  # (l,) rows of the structure's points that are landmarks
    refined: RefinedMap  # in a frame of its own
    posed: IntArray  # (g,) rows of the views with a pose
    rotations: Array  # (g,3,3) map_from_camera at their middle rows
    positions: Array  # (g,3)
    deviation: float  # px, of the keypoints' noise

    @property
    def placement(self) -> Placement:
        return self.place.placement

    def middle_rows(self, stamps_ns: Sequence[int]) -> tuple[IntArray, Array, Array]:
        """Times (g,) ns of the middle rows, positions (g,3), quaternions (g,4) of the poses.

        Args:
            stamps_ns: of all views.
        """
        delay = -self.camera.readout_time * self.camera.first_row_time
        times = np.array(stamps_ns, np.int64)[self.posed] + round(1e9 * delay)
        return times, self.positions, Rotation.from_matrix(self.rotations).as_quat()


def build_map(given: Given, work: Workshop) -> Built:
    """Build a map.

    Raises:
        ImportError: without pycolmap.
        ValueError: when the images make no map, saying what was found.
    """
    keyframes = _keyframes(given)
    if given.imu is not None and not given.anchors.tell_scale:
        refuse_early(given.imu, given.stamps_ns)
    structure = _structure(given, keyframes, work)
    descriptors = _descriptors(given.views, structure)
    first = Map(structure.points, None, descriptors, given.frame)
    with work.stage("follow", len(given.views)) as step:
        followed = follow(given.views, first, given.camera, lambda: step(1))
    if len(followed.views) < _LEAST_VIEWS:
        raise MappingError(
            f"{len(followed.views)} of {len(given.views)} images could be localized on the first "
            "map: it is wrong, as repeated texture or a wrong calibration make it"
        )
    seen = all_seen(given.views, structure, followed)
    sightings, start, used = for_adjustment(
        given.stamps_ns, followed, seen, structure.points, work.effort.adjusted
    )
    freedom = MapFreedom()
    if given.anchors.marker_map is not None:
        corners = _corners(given, sightings.stamps_ns)
        places = given.anchors.marker_map.points
        sightings, start, freedom = tied(given.camera, sightings, start, corners, places)
    with work.stage("refine", 3) as step:
        freedom = replace(freedom, readout_time=given.estimate_readout)
        refined = refine(given.camera, sightings, start, freedom, done=lambda _: step(1))
    _check_fit(refined)
    motion = Motion(followed.views[used], refined.times, refined)
    shown = motion.seen(followed.views[seen.images], seen.landmarks, seen.pixels)
    found = triangulate(refined.camera, motion.sights(shown), len(structure.points))
    by_all = place_by_imu(_placement(given, motion), refined, given.imu)
    similarity = by_all.placement.similarity
    kept = _kept(found, motion)
    landmarks = _landmarks(found, kept, descriptors, similarity, given.frame)
    rotations, positions = motion.poses()
    return Built(
        landmarks=landmarks,
        camera=refined.camera_as_found,
        place=by_all,
        keyframes=keyframes,
        structure=structure.moved(similarity),
        kept=kept,
        refined=refined,
        posed=motion.rows,
        rotations=similarity.rotation @ rotations,
        positions=similarity(positions),
        deviation=refined.deviation,
    )


def _keyframes(given: Given) -> Keyframes:
    views = given.views
    if len(views) < _LEAST_VIEWS:
        raise MappingError(f"{len(views)} images make no map; at least {_LEAST_VIEWS} are needed")
    features = float(np.median([len(view.features) for view in views]))
    if features < _FEW_FEATURES:
        raise MappingError(
            f"the images show {features:.0f} features each (median), at least {_FEW_FEATURES} are "
            "needed: are they blurred, dark, or of blank walls?"
        )
    motions = np.array([view.motion for view in views])
    sharpness = np.array([view.sharpness for view in views])
    return choose_keyframes(motions, sharpness, given.camera.size)


def _structure(given: Given, keyframes: Keyframes, work: Workshop) -> Structure:
    """The first structure, of about the right size."""
    found = build_structure(
        given.views, keyframes.chosen, given.camera, work.folder, work.effort, work.stage
    )
    total = len(keyframes.chosen)
    if found.parts[0] < max(_LEAST_VIEWS, _LEAST_PART * total):
        listed = ", ".join(map(str, found.parts))
        raise MappingError(
            f"the {total} keyframes fall apart: {listed} of them hang together, and nothing joins "
            "these parts; record what lies between them, slowly, without blank walls"
        )
    places = found.positions[np.searchsorted(found.views, found.seen_views)]
    away = np.linalg.norm(found.points[found.seen_points] - places, axis=1)
    factor = _USUAL_DISTANCE / float(np.median(away))
    return found.moved(scaled(factor))


def _descriptors(views: Sequence[View], structure: Structure) -> np.ndarray:
    """Of each point the medoid (p,d) of its features' descriptors."""
    order = np.argsort(structure.seen_points, kind="stable")
    ends = np.cumsum(np.bincount(structure.seen_points, minlength=len(structure.points)))
    all_rows = np.stack(
        [
            views[view].features.descriptors[feature]
            for view, feature in zip(
                structure.seen_views[order].tolist(),
                structure.seen_features[order].tolist(),
                strict=True,
            )
        ]
    ).astype(np.float32)
    return np.stack([rows[medoid(rows)] for rows in np.split(all_rows, ends[:-1])])


def _corners(given: Given, stamps_ns: IntArray) -> Sightings:
    """Corners of markers in the images with these stamps."""
    views, corners, pixels = given.anchors.seen(given.views)
    stamps = given.stamps_ns[views]
    images = np.minimum(np.searchsorted(stamps_ns, stamps), len(stamps_ns) - 1)
    known = stamps_ns[images] == stamps
    return Sightings(stamps_ns, images[known], corners[known], pixels[known])


def _check_fit(refined: RefinedMap) -> None:
    """Images too far apart leave the motion between them open, and the map may follow it."""
    share = float(np.mean(refined.inliers))
    if share < _LEAST_FIT:
        raise MappingError(
            f"after the refinement {100 * share:.0f} % of the keypoints fit the map, "
            f"{100 * _LEAST_FIT:.0f} % should: use more images per second, film more slowly, or "
            "check the readout time and the calibration"
        )


def _placement(given: Given, motion: Motion) -> Placement:
    seen = motion.seen(*given.anchors.seen(given.views))
    camera = motion.refined.camera
    found = triangulate(camera, motion.sights(seen), given.anchors.count)
    return placement(given.anchors, found, *motion.poses())


def _kept(found: Triangulated, motion: Motion) -> IntArray:
    """Rows of the points that are good enough to be landmarks."""
    _, positions = motion.poses()
    away = np.linalg.norm(found.points - np.median(positions, axis=0), axis=1)
    spread = np.sqrt(np.trace(found.covariances, axis1=1, axis2=2))
    good = (found.counts >= _LEAST_SIGHTS) & (spread < _MOST_DEVIATION * np.nanmedian(away))
    if not good.any():
        raise MappingError(
            f"none of {len(good)} landmarks is seen by {_LEAST_SIGHTS} images that determine it"
        )
    return np.flatnonzero(good)


def _landmarks(
    found: Triangulated, kept: IntArray, descriptors: np.ndarray, to_map: Similarity, frame: str
) -> Map:
    turn = to_map.scale * to_map.rotation
    return Map(
        to_map(found.points[kept]),
        np.arange(len(kept)),
        np.ascontiguousarray(descriptors[kept]),
        frame,
        covariances=turn @ found.covariances[kept] @ turn.T,
    )
