# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Correspondences from footage: a board's corners, or tracked ones with points of depths or COLMAP.

No gyroscope is used here. Without a board the points are those of an adjustment with a rolling
shutter (:mod:`rs_localizer.tools.mapping.refinement`) of the very images that are judged, so linear
velocities and the scale prove nothing; turn rates do, before a gyroscope.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from benchmarks.real.clips import clip_of, opencv_lens, shutter_of
from benchmarks.real.footage import Footage, Gray
from benchmarks.real.recordings import Frame, Recording
from rs_localizer.config import FeatureConfig, NodeConfig
from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.io.images import Image
from rs_localizer.markers.prints import Chessboard
from rs_localizer.pipeline.pose_at_time import middle_row_ns
from rs_localizer.tools.mapping.anchors import Anchors
from rs_localizer.tools.mapping.build import Given, ViewMotion, Workshop, build_map
from rs_localizer.tools.mapping.map_keypoints import MapFreedom, MapObservations, Start
from rs_localizer.tools.mapping.seen_images import Looker
from rs_localizer.tools.mapping.shutter_fit import likely_axes, refine_with_shutter
from rs_localizer.tools.mapping.structure import Effort
from rs_localizer.tools.mapping.triangulation import triangulate

Pixels = NDArray[np.float32]
_CORNERS = 150  # of an image
_SPACING = 0.02  # of the image's width, between two corners
_QUALITY = 0.01  # of the best corner's
_WINDOW, _LEVELS = (21, 21), 4  # of the tracker: a hand moves corners by 5 % of the width
_THERE_AND_BACK = 0.3  # px, between a corner and where it comes back to
_LEAST_VIEWS = 3  # of a point
_MOST_SPREAD = 0.03  # of its distance, a point's deviation: as of landmarks of ``map build``


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Corners of f images that were followed from one to the next."""

    stamps_ns: IntArray  # (f,)
    size: tuple[int, int]  # width, height
    images: IntArray  # (n,) which image
    points: IntArray  # (n,) which point it shows
    pixels: Array  # (n,2) raw

    @property
    def count(self) -> int:
        """How many points there are."""
        return int(self.points.max()) + 1 if len(self.points) else 0


def tracked(footage: Footage, most: int) -> Tracks:
    """Corners of the first so many images (KLT).

    Raises:
        ValueError: for footage without images.
    """
    stamps, rows, before = [], [], None
    pixels: Pixels = np.zeros((0, 2), np.float32)
    ids, fresh = np.zeros(0, np.int64), 0
    for stamp, image in islice(footage.images(), most):
        if before is not None:
            pixels, ids = _followed(before, image, pixels, ids)
        new = _fresh(image, pixels)
        pixels = np.concatenate([pixels, new])
        ids = np.concatenate([ids, fresh + np.arange(len(new))])
        fresh += len(new)
        rows.append((ids, pixels.astype(np.float64)))
        stamps.append(stamp)
        before = image
    if before is None:
        raise ValueError(f"{footage.name} has no images")
    counts = [len(ids) for ids, _ in rows]
    return Tracks(
        np.array(stamps, np.int64),
        (before.shape[1], before.shape[0]),
        np.repeat(np.arange(len(rows)), counts),
        np.concatenate([ids for ids, _ in rows]),
        np.concatenate([pixels for _, pixels in rows]),
    )


def _followed(before: Gray, image: Gray, pixels: Pixels, ids: IntArray) -> tuple[Pixels, IntArray]:
    if not len(ids):
        return pixels, ids

    def flow(one: Gray, other: Gray, start: Pixels) -> tuple[Any, Any]:
        return cv2.calcOpticalFlowPyrLK(
            one, other, start, np.empty_like(start), winSize=_WINDOW, maxLevel=_LEVELS
        )[:2]

    there, found = flow(before, image, pixels)
    back, again = flow(image, before, there)
    size = np.array(image.shape[::-1]) - 1.0
    kept = (found[:, 0] == 1) & (again[:, 0] == 1)
    kept &= np.linalg.norm(back - pixels, axis=1) < _THERE_AND_BACK
    kept &= np.all((there >= 0.0) & (there <= size), axis=1)
    return there[kept], ids[kept]


def _fresh(image: Gray, pixels: Pixels) -> Pixels:
    wanted, apart = _CORNERS - len(pixels), _SPACING * image.shape[1]
    free = np.full(image.shape, 255, np.uint8)
    for u, v in pixels:
        cv2.circle(free, (round(float(u)), round(float(v))), round(apart), 0, -1)
    found = None
    if wanted > 0:
        found = cv2.goodFeaturesToTrack(image, wanted, _QUALITY, apart, mask=free)
    return np.asarray([] if found is None else found, np.float32).reshape(-1, 2)


def record(
    footage: Footage, camera: Camera | None, config: NodeConfig, most: int, folder: Path
) -> Recording:
    """The recording of the first so many images.

    Args:
        camera: the lens; None: that of the footage, else COLMAP finds it.
        config: of which the readout time (0: the footage's, else it is estimated), scan direction
            and stamp offset are used.
        folder: for COLMAP's files.

    Raises:
        ValueError: when the images make no map, or do not tell the readout time.
    """
    tracks = tracked(footage, most)
    lens, given = camera or footage.camera, config.readout_time or footage.readout_time or None
    direction = None if given is None else config.scan_direction
    if footage.depths is None:
        found, points = _by_colmap(footage, tracks, lens, given, direction, folder)
    else:
        assert lens is not None  # who writes depths writes the lens
        found, points = _by_depths(footage, tracks, lens, given, direction)
    if not found.readout_time > 0.0:
        raise ValueError("the images do not tell the readout time: give -p readout_time:=0.02")
    timing = replace(config, readout_time=found.readout_time)
    known: BoolArray = np.isfinite(points[:, 0])
    frames = []
    for k, stamp in enumerate(tracks.stamps_ns.tolist()):
        of = (tracks.images == k) & known[tracks.points]
        frames.append(
            Frame(middle_row_ns(timing, found, stamp), points[tracks.points[of]], tracks.pixels[of])
        )
    return Recording(footage.name, found, frames)


def record_board(
    footage: Footage, board: Chessboard, lens: Camera | None, config: NodeConfig, most: int,
    cache: Path,
) -> Recording:  # fmt: skip
    """The recording of so many images that show a printed board.

    Args:
        lens: None: that of the footage, else OpenCV finds it.
        config: as of :func:`record`; an unknown readout time is that of ``calibrate``.
        cache: where corners and calibration are kept.
    """
    shots = ((1e-9 * stamp, image) for stamp, image in footage.images())
    clip = clip_of(footage.name, shots, board, cache, most)
    readout, direction = config.readout_time or footage.readout_time, config.scan_direction
    if not readout:
        shutter = shutter_of(clip, cache)
        readout, direction = shutter.readout_time, shutter.scan_direction
    timing = replace(config, readout_time=readout)
    lens = lens or footage.camera or opencv_lens(clip)
    camera = replace(lens, readout_time=readout, scan_direction=direction)
    frames = [
        Frame(middle_row_ns(timing, camera, image.stamp_ns), image.points, image.pixels)
        for image in clip.images
    ]
    return Recording(footage.name, camera, frames)


def _by_depths(
    footage: Footage, tracks: Tracks, lens: Camera, given: float | None, direction: str | None
) -> tuple[Camera, Array]:
    """The camera with its shutter, and points (p,3); NaN: not known."""
    depths = footage.depths
    assert depths is not None
    placed = np.full((len(tracks.points), 3), np.nan)
    for k in range(len(tracks.stamps_ns)):
        of = tracks.images == k
        pixels = tracks.pixels[of]
        local = np.column_stack([lens.rays(pixels), np.ones(len(pixels))])
        local *= depths.at(k, pixels, tracks.size)[:, None]
        placed[of] = local @ depths.rotations[k].T + depths.positions[k]
    points = np.full((tracks.count, 3), np.nan)
    order = np.argsort(tracks.points, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(tracks.points[order])) + 1):
        sure = rows[np.isfinite(placed[rows, 0])]
        if len(sure) and len(rows) >= _LEAST_VIEWS:
            points[tracks.points[rows[0]]] = np.median(placed[sure], axis=0)
    places = np.flatnonzero(np.isfinite(points[:, 0]))
    numbers = np.full(tracks.count, -1)
    numbers[places] = np.arange(len(places))
    used = numbers[tracks.points] >= 0
    seen = MapObservations(
        tracks.stamps_ns, tracks.images[used], numbers[tracks.points[used]], tracks.pixels[used]
    )
    count = len(tracks.stamps_ns)
    start = Start(points[places], depths.rotations[:count], depths.positions[:count])
    shutter = given, likely_axes(lens.size, direction)
    refined, _, _ = refine_with_shutter(lens, seen, start, MapFreedom(), shutter, lambda _: None)
    points[places] = np.where(refined.refined[:, None], refined.points, np.nan)
    return refined.camera_as_found, points


def _by_colmap(
    footage: Footage, tracks: Tracks, lens: Camera | None, given: float | None,
    direction: str | None, folder: Path,
) -> tuple[Camera, Array]:  # fmt: skip
    """Likewise, without depths: a map as of ``map build``, and corners triangulated in it."""
    with TemporaryDirectory(dir=folder) as images, TemporaryDirectory(dir=folder) as work:
        looker = Looker(FeatureConfig().max_keypoints, Path(images))
        shots = islice(footage.images(), len(tracks.stamps_ns))
        views = [looker.detect_in(Image(stamp, "camera", image)) for stamp, image in shots]
        inputs = Given(views, lens, Anchors(), given, direction)
        built = build_map(inputs, Workshop(Path(work), Effort(), _quiet))
    motion = ViewMotion(built.posed, built.refined.times, built.refined)
    sights = motion.sights(tracks.images, tracks.points, tracks.pixels)
    found = triangulate(built.refined.camera, sights, tracks.count)
    away = np.linalg.norm(found.points - np.median(built.refined.poses()[1], axis=0), axis=1)
    good = (found.counts >= _LEAST_VIEWS) & (found.spread < _MOST_SPREAD * away)
    return built.camera, np.where(good[:, None], found.points, np.nan)


@contextmanager
def _quiet(name: str, total: int) -> Iterator[Callable[[int], object]]:
    del name, total
    yield lambda _: None
