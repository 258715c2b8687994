# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A map from views: COLMAP's structure, the rolling shutter, metres.

1. COLMAP extracts, matches and maps the keyframes, with a global shutter; without a calibration it
   finds the lens as well.
2. The views between them are localized on that map.
3. Motion and the most useful landmarks are adjusted together, each keypoint at its row's time. A
   readout time that nobody knows is estimated, and believed where it explains the images better
   than a global shutter.
4. All landmarks are triangulated with that motion, and so is what gives the map its metres.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from rs_localizer.config import NodeConfig
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import make_message
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.images import Image
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.recording import CAMERA_FRAME, MAP_FRAME, make_camera_info
from rs_localizer.offline.replay import inlier_columns
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.pipeline.keypoints import Extracted, keypoints
from rs_localizer.tools.mapping.anchors import (
    Anchors,
    Placement,
    determined_corners,
    marker_constraints,
    placement,
)
from rs_localizer.tools.mapping.gauge import Similarity, laid_on_held, scaled
from rs_localizer.tools.mapping.map_keypoints import ADJUSTED, MapObservations, Start, adjusted_part
from rs_localizer.tools.mapping.refinement import (
    DRIFT,
    LEAST_FIT,
    RefinedMap,
    colmap_freedom,
    likely_axis,
    refine_with_shutter,
)
from rs_localizer.tools.mapping.structure import (
    LEAST_VIEWS,
    SeenImage,
    Structure,
    build_structure,
    check_views,
    choose_keyframes,
)
from rs_localizer.tools.mapping.triangulation import Sights, Triangulated, moves, triangulate
from rs_localizer.tools.readout_belief import ReadoutCheck, ShutterFit

# A map that a global shutter has bent is off by more than good ones (px).
_THRESHOLD = 4.0


def track_on_map(
    views: Sequence[SeenImage], structure: Structure, camera: Camera
) -> tuple[IntArray, MapObservations, Start]:
    """Return rows (k,) of the views with a pose, and what they show.

    Keyframes are where COLMAP has them, the others are localized.

    Args:
        views: in the order of their stamps.
        structure: of about the right size, in metres.
        camera: with its readout time; 0: a global shutter, or unknown.
    """
    seen, start = structure.seen, structure.start
    frames = _frames(structure, camera)
    ends = np.searchsorted(seen.images, np.arange(len(structure.views) + 1)).tolist()
    keyframes = {view: k for k, view in enumerate(structure.views.tolist())}
    rows, poses, points, pixels = [], [], [], []
    for row, view in enumerate(tqdm(views, "track", unit="image", disable=None)):
        k = keyframes.get(row)
        if k is not None:
            own = slice(ends[k], ends[k + 1])
            poses.append((start.rotations[k], start.positions[k]))
            points.append(seen.landmarks[own])
            pixels.append(seen.pixels[own])
            rows.append(row)
        else:
            image = Image(view.stamp_ns, CAMERA_FRAME, np.zeros((0, 0), np.uint8))
            found = frames.localize_keypoints(
                keypoints(Extracted(image, view.features), make_message)
            )
            if found:
                poses.append((found.estimate.rotation.T, found.estimate.position))
                points.append(found.inliers["id"].astype(np.int64))
                pixels.append(inlier_columns(found, "uv"))
                rows.append(row)
    counts = [len(of) for of in points]
    shown = MapObservations(
        np.array([views[row].stamp_ns for row in rows], np.int64),
        np.repeat(np.arange(len(rows)), counts),
        np.concatenate([*points, np.zeros(0, np.int64)]),
        np.concatenate([*pixels, np.zeros((0, 2))]),
    )
    rotations = np.array([rotation for rotation, _ in poses]).reshape(-1, 3, 3)
    positions = np.array([position for _, position in poses]).reshape(-1, 3)
    return np.array(rows, np.int64), shown, Start(start.points, rotations, positions)


def _frames(structure: Structure, camera: Camera) -> CameraFrames:
    """Return what localizes keypoints on the structure, as the node does."""
    config = NodeConfig(
        inlier_threshold=_THRESHOLD, readout_time=camera.readout_time,
        scan_direction=str(camera.scan_direction),
    )  # fmt: skip
    frames = CameraFrames(config)
    frames.calibrate(read_camera_info(make_camera_info(camera, 0)))
    points = structure.start.points
    frames.landmarks.use_map(Map(points, np.arange(len(points)), structure.descriptors, MAP_FRAME))
    return frames


# Settings of the localizer are in metres: so far (m) is the median landmark taken to be from where
# it is seen, until it is known how far it is.
USUAL_DISTANCE = 2.5
# Share of the keyframes that must hang together.
_LEAST_PART = 0.5
# Errors that landmarks share are told of this many modes. Of a walk of 12 s around a room they are
# 96 % of all (squared, in the landmarks' own deviations); they are as long as a SIFT descriptor.
_MODES = 40
# A landmark counts when this many views agree, and it is known to this part of its usual distance.
_LEAST_SIGHTS, _MOST_DEVIATION = 3, 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Given:
    """Inputs of a map."""

    views: Sequence[SeenImage]  # in the order of their stamps
    camera: Camera | None  # its lens; None: COLMAP finds it
    anchors: Anchors
    readout_time: float | None = None  # s, 0: a global shutter; None: estimated
    scan_direction: str | None = None  # None: unknown
    frame: str = "map"


@dataclass(frozen=True, slots=True, eq=False)
class ViewMotion:
    """Motion of the camera, and the views that it took on it."""

    rows: IntArray  # (g,) of the views
    times: Array  # (g,) s since the refinement's start, of the middle rows
    refined: RefinedMap

    def sights(self, views: IntArray, landmarks: IntArray, pixels: Array) -> Sights:
        """Return keypoints (n,) of the views with a pose, with their pose at the row's time."""
        place = np.minimum(np.searchsorted(self.rows, views), len(self.rows) - 1)
        known = self.rows[place] == views
        at, pixels = place[known], pixels[known]
        camera = self.refined.camera
        times = self.times[at] + self.refined.readout_time * camera.row_time(pixels)
        states = self.refined.spline.states(times)
        return Sights(states.rotations, states.positions, pixels, landmarks[known])

    def moves(self, seen: tuple[IntArray, IntArray, Array], triangulated: Triangulated) -> Array:
        """Return how a deviation of each motion error moves triangulated points (p,3,k)."""
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
    structure: Structure  # as COLMAP had it, moved into this frame as a whole
    kept: IntArray  # (l,) rows of the structure's points that are landmarks
    shutter: ShutterFit | None  # None: it was given, and the images do not contradict it
    readout_check: ReadoutCheck | None  # of a given one
    refined: RefinedMap  # in a frame of its own
    posed: IntArray  # (g,) rows of the views with a pose
    rotations: Array  # (g,3,3) map_from_camera at their middle rows
    positions: Array  # (g,3)

    def middle_rows(self, stamps_ns: Sequence[int]) -> tuple[IntArray, Array, Array]:
        """Return times (g,) ns, positions (g,3) and quaternions (g,4) at the middle rows.

        Args:
            stamps_ns: of all views.
        """
        delay = -self.camera.readout_time * self.camera.first_row_time
        times = np.array(stamps_ns, np.int64)[self.posed] + round(1e9 * delay)
        return times, self.positions, Rotation.from_matrix(self.rotations).as_quat()


def build_map(inputs: Given, folder: Path) -> Built:
    """Build a map.

    Args:
        inputs: the images, and what is known of them.
        folder: for COLMAP's files, which stay.

    Raises:
        ValueError: when the images make no map, saying what was found.
    """
    check_views(inputs.views)
    keyframes = choose_keyframes(inputs.views)
    structure = _structure(inputs, keyframes, folder)
    camera = replace(
        structure.camera,
        readout_time=inputs.readout_time or 0.0,
        scan_direction=likely_axis(structure.camera.size, inputs.scan_direction),
    )
    tracked = track_on_map(inputs.views, structure, camera)
    return built_from(inputs, structure, tracked, camera)


def built_from(
    inputs: Given, structure: Structure, tracked: tuple[IntArray, MapObservations, Start],
    camera: Camera,
) -> Built:  # fmt: skip
    """Build a map from a first structure.

    Args:
        tracked: rows of the views with a pose, what they show, and a first guess of their poses.
        camera: its lens, with the readout time, or 0 if nobody knows it.

    Raises:
        ValueError: when the images make no map, saying what was found.
    """
    rows, shown, start = tracked
    used, adjusted, near = adjusted_part(shown, start, ADJUSTED)
    refined, shutter, check = _refined(inputs, adjusted, near, camera)
    if refined.fit_share < LEAST_FIT:  # the motion is open, and the map may follow it
        lens = "" if inputs.camera is not None else (
            f"; COLMAP found a focal length of {structure.camera.focal_length:.0f} px, which a "
            "flat scene does not determine: give --calibration, or show more depth"
        )  # fmt: skip
        raise ValueError(
            f"after the refinement {100 * refined.fit_share:.0f} % of the keypoints fit the map, "
            f"{100 * LEAST_FIT:.0f} % should: use more images per second, film more slowly, or "
            f"check the readout time and the calibration{lens}"
        )
    motion = ViewMotion(rows[used], refined.times, refined)
    seen = rows[shown.images], shown.landmarks, shown.pixels
    triangulated = triangulate(refined.camera, motion.sights(*seen), len(structure.start.points))
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
    known, turn = triangulated.chosen(kept), similarity.scale * similarity.rotation
    landmarks = Map(
        similarity(known.points), np.arange(len(kept)),
        np.ascontiguousarray(structure.descriptors[kept]), inputs.frame,
        covariances=turn @ known.covariances @ turn.T,
        error_modes=np.asarray(turn @ modes, np.float32),
    )  # fmt: skip
    return Built(
        landmarks=landmarks, camera=refined.camera_as_found, placement=place,
        structure=replace(structure, start=structure.start.moved(similarity)), kept=kept,
        shutter=shutter, readout_check=check, refined=refined, posed=motion.rows,
        rotations=similarity.rotation @ rotations, positions=similarity(positions),
    )  # fmt: skip


def _structure(inputs: Given, keyframes: IntArray, folder: Path) -> Structure:
    """Return the first structure, of about the right size."""
    stamps = {row: inputs.views[row].stamp_ns for row in keyframes.tolist()}
    structure = build_structure(inputs.views[0].image.parent, stamps, inputs.camera, folder)
    total = len(keyframes)
    if structure.parts[0] < max(LEAST_VIEWS, _LEAST_PART * total):
        listed = " and ".join(map(str, structure.parts))
        raise ValueError(
            f"reconstruction is disconnected (components of {listed} keyframes, of {total}): "
            "record what lies between them, slowly, without blank walls"
        )
    size = usual_size(structure.seen, structure.start)
    return replace(structure, start=structure.start.moved(size))


def usual_size(seen: MapObservations, start: Start) -> Similarity:
    """Return the similarity to the size of a room: priors of motions are in metres."""
    return scaled(USUAL_DISTANCE / float(np.median(np.linalg.norm(start.local(seen), axis=1))))


def _refined(
    inputs: Given, observations: MapObservations, start: Start, camera: Camera
) -> tuple[RefinedMap, ShutterFit | None, ReadoutCheck | None]:
    """Return the refined map, a shutter that was unknown or wrong, the check of a given one."""
    freedom = replace(colmap_freedom(inputs.camera is None), drifts=_MODES)
    if inputs.anchors.marker_map is not None:
        stamps_ns = observations.stamps_ns
        views, corners, pixels = inputs.anchors.seen(inputs.views)
        stamps = np.array([view.stamp_ns for view in inputs.views], np.int64)[views]
        images = np.minimum(np.searchsorted(stamps_ns, stamps), len(stamps_ns) - 1)
        known = stamps_ns[images] == stamps
        shown = MapObservations(stamps_ns, images[known], corners[known], pixels[known])
        places = inputs.anchors.marker_map.points
        observations, start, deviations = marker_constraints(
            camera, observations, start, shown, places
        )
        freedom = replace(freedom, deviations=deviations)
    return refine_with_shutter(camera, observations, start, freedom, inputs.readout_time)


def _kept(triangulated: Triangulated, motion: ViewMotion) -> IntArray:
    """Return rows of the points that are good enough to be landmarks."""
    _, positions = motion.refined.poses()
    away = np.linalg.norm(triangulated.points - np.median(positions, axis=0), axis=1)
    good = triangulated.counts >= _LEAST_SIGHTS
    good &= triangulated.spread < _MOST_DEVIATION * np.nanmedian(away)
    if not good.any():
        raise ValueError(
            f"none of {len(good)} landmarks is seen by {_LEAST_SIGHTS} images that determine it"
        )
    return np.flatnonzero(good)


def result_rows(built: Built, images: int, views: int) -> dict[str, str]:
    """Return the table of results; of so many images so many ``views`` were looked at."""
    refined, landmarks = built.refined, built.landmarks
    assert landmarks.covariances is not None
    spread = np.sqrt(np.trace(landmarks.covariances, axis1=1, axis2=2))
    unit = "mm" if built.placement.scaled else "units of the map / 1000"
    return {
        "images": f"{images}, {views} used, {len(built.posed)} with a pose",
        "landmarks": f"{len(landmarks)} of {len(built.structure.start.points)} points",
        "deviation of a landmark": f"{1e3 * np.median(spread):.1f} {unit} (median)",
        "deviation that landmarks share": f"{_shared(built):.1f} {unit} (median)",
        "noise": f"{refined.before:.2f} px, after the refinement {refined.after:.2f} px",
        "readout time": _shutter(built),
        "scale": built.placement.basis,
        "z is up": built.placement.up,
    }


def _shared(built: Built) -> float:
    """Return the median deviation that a landmark shares with others, in 1/1000 of the map."""
    assert built.landmarks.error_modes is not None
    return 1e3 * float(np.median(np.linalg.norm(built.landmarks.error_modes, axis=(1, 2))))


# Advice is given where more than this share of the images has no pose.
_MANY = 0.1
# A walk comes back if this share of what its last images show was shown by its first ones, a tenth
# of all each. What lies between holds together by neighbours alone, whose errors add up.
_AGAIN, _ENDS = 0.1, 0.1


def filming_advice(built: Built, views: Sequence[SeenImage]) -> list[str]:
    """Return sentences on how to film a better map."""
    said, lost = list[str](), np.setdiff1d(np.arange(len(views)), built.posed)
    if len(lost) > _MANY * len(views):
        begin, last = (1e-9 * (views[k].stamp_ns - views[0].stamp_ns) for k in lost[[0, -1]])
        said.append(
            f"{len(lost) / len(views):.0%} of the images, from {begin:.1f} to {last:.1f} s, have "
            "no pose: film there more slowly"
        )
    if len(built.structure.parts) > 1:
        said.append(
            f"{sum(built.structure.parts[1:])} keyframes are not connected with the others: film "
            "what lies between, and come back to where you began"
        )
    if not comes_back(built.structure.seen):
        unit = "mm" if built.placement.scaled else "thousandths of the map's unit"
        said.append(
            f"the last images show nothing that the first ones do: landmarks share errors of "
            f"{_shared(built):.1f} {unit}, larger ones towards the ends; come back to where you "
            "began, or show markers at both ends"
        )
    if not (built.shutter.visible if built.shutter else not built.refined.apart):
        said.append(
            "for the readout time, film at the camera's own rate (no time lapse, no stabilization) "
            "and rotate the camera quickly, sideways and up and down, for some seconds"
        )
    return said


def comes_back(seen: MapObservations) -> bool:
    """Return whether the last images show landmarks that the first ones show."""
    count = len(seen.stamps_ns)
    ends = max(1, round(_ENDS * count))
    first = np.unique(seen.landmarks[seen.images < ends])
    last = np.unique(seen.landmarks[seen.images >= count - ends])
    return len(np.intersect1d(first, last)) >= _AGAIN * min(len(first), len(last))


def _shutter(built: Built) -> str:
    fit, known = built.shutter, built.camera.readout_time
    if fit is None:
        if built.refined.apart:
            return "invisible: no smooth motion joins the images, each has a pose of its own"
        return f"{1e3 * known:.2f} ms (given)" if known else "unknown, or none"
    best = f"{1e3 * fit.readout_time:.2f} +- {1e3 * fit.deviation:.2f} ms, {fit.direction}"
    if fit.visible:
        return f"{best} (estimated)"
    return f"invisible in these images (best fit {best})"
