# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map build``: images of a place -> a map of landmarks, in metres."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

from rs_localizer.cli import earlier_result, typed
from rs_localizer.cli.options import ResultOptions, UsageError, argument, option
from rs_localizer.cli.recording_input import (
    ImageOptions,
    check_there,
    opened,
    print_images,
    shutter_values,
)
from rs_localizer.config import FeatureConfig
from rs_localizer.io.atomic_files import atomic_directory
from rs_localizer.io.camera_files import lens_parameters
from rs_localizer.io.maps.files import write_npz
from rs_localizer.io.recording import CAMERA, MAP, MAP_FRAME
from rs_localizer.io.trajectories import Trajectory, write_tum
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.settings import build, write_parameters
from rs_localizer.tools.mapping.anchors import Anchors, PointSight
from rs_localizer.tools.mapping.build import Built, Given, build_map, filming_advice, result_rows
from rs_localizer.tools.mapping.structure import Looked, Looker, look_through, require


def shutter_of(args: Options) -> tuple[float | None, str | None]:
    """Return readout time and scan direction, given or from the images; None if unknown."""
    values = shutter_values(args)
    settings = build(values)
    # 0 is a global shutter where the user says so, and unknown in a file.
    said = any(text.startswith("readout_time:=") for text in args.assignments)
    readout_time = settings.readout_time if said or settings.readout_time else None
    return readout_time, settings.scan_direction if "scan_direction" in values else None


def look_at_images(args: Options, points: Sequence[_Point], looker: Looker) -> Looked:
    """Look at this many images a second, and at those in which points are given."""
    with opened(args, calibrated=False) as source:
        moments = [seconds for _, seconds, _, _ in points]
        looked = look_through(source.shots, looker, _IMAGES_PER_SECOND, moments)
    if not looked.views:
        why = "; ".join(looked.refused.values())
        raise ValueError(f"{args.recording} has no image that can be read; {why}")
    for name, seconds, *_ in points:
        if seconds not in looked.moments:
            raise UsageError(f"--point {name}: the images end before {seconds:g} s")
    readout_time = build(shutter_values(args)).readout_time
    print_images(looked.refused, source.clock, readout_time, looked.period)
    return looked


_Point = tuple[str, float, float, float]
COLMAP, POSES = "colmap", "poses.txt"
# A hand's motion is held by this many images a second.
_IMAGES_PER_SECOND = 15.0


@dataclass(frozen=True, kw_only=True)
class Options(ImageOptions, ResultOptions):
    recording: Path = argument("images of one camera, as for detect", "VIDEO|BAG|FOLDER")
    out: Path = option("to create", "DIR", required=True)
    markers: Path | None = option("marker map; some of it is in the images", "FILE")
    point: list[tuple[str, str, str, str]] = option(
        "a point in the first image at or after SECONDS from the start, by its raw pixel; each "
        "one in two images or more", "NAME SECONDS U V", list,
    )  # fmt: skip
    distance: tuple[str, str, str] | None = option(
        "between two of these points", "NAME NAME METRES"
    )


def run(args: Options) -> None:
    points, distance = _given(args)
    require()
    check_there([args.recording])
    markers = None if args.markers is None else read_marker_map(args.markers)
    shutter, frame = shutter_of(args), MAP_FRAME if markers is None else markers.map_frame
    with atomic_directory(args.out, earlier_result(args, MAP)) as out:
        out.mkdir()
        with TemporaryDirectory(dir=out) as images:
            looker = Looker(FeatureConfig().max_keypoints, Path(images), markers)
            looked = look_at_images(args, points, looker)
            sights = [
                PointSight(name, looked.moments[seconds], (u, v)) for name, seconds, u, v in points
            ]
            anchors = Anchors(markers, tuple(sights), distance)
            inputs = Given(looked.views, looked.camera, anchors, *shutter, frame)
            folder = out / COLMAP
            folder.mkdir()
            built = build_map(inputs, folder)
        _write(out, built, looked)
    _print_result(args, built, looked)


def _given(options: Options) -> tuple[list[_Point], tuple[str, str, float] | None]:
    """Return the given points and distance, after checking that they go together."""
    if options.markers is not None and (options.point or options.distance):
        raise UsageError("give either --markers or --point and --distance")
    try:
        points = [(name, float(s), float(u), float(v)) for name, s, u, v in options.point]
        metres = float(options.distance[2]) if options.distance else math.nan
    except ValueError as error:
        raise UsageError(f"--point and --distance: {error}") from error
    if options.distance is None:
        if points:
            raise UsageError("--point needs --distance")
        return points, None
    names, (one, other, _) = [name for name, *_ in points], options.distance
    if not metres > 0.0 or one == other:
        raise UsageError(f"--distance: must be two points and metres, got {one} {other} {metres}")
    for name in (one, other):
        if (count := names.count(name)) < 2:
            raise UsageError(
                f"--distance: the point {name} must be given by --point in two images or more, it "
                f"is in {count}"
            )
    return points, (one, other, metres)


def _write(out: Path, built: Built, looked: Looked) -> None:
    write_npz(out / MAP, built.landmarks)
    shutter = {
        "readout_time": built.camera.readout_time,
        "scan_direction": str(built.camera.scan_direction),
    }
    camera = built.camera
    # A file has the lens of a whole image; of a part of it, camera_info says which.
    whole = camera.roi is None and camera.binning == (1, 1)
    write_parameters(out / CAMERA, shutter, lens_parameters(camera) if whole else {})
    stamps, positions, quaternions = built.middle_rows([view.stamp_ns for view in looked.views])
    write_tum(out / POSES, Trajectory(stamps, positions, quaternions), ["of the middle rows"])


def _print_result(args: Options, built: Built, looked: Looked) -> None:
    print(args.out / MAP)
    for name, text in result_rows(built, looked.images, len(looked.views)).items():
        print(f"  {name:30} {text}")
    if not built.placement.scaled:
        print(
            "warning: nothing determines the scale: poses and velocities are in units of the map; "
            "give --markers, or --point and --distance"
        )
    if built.readout_check is not None and built.readout_check.differs:
        print(f"warning: {built.readout_check.message}; the map has what was estimated")
    for text in filming_advice(built, looked.views):
        print(f"to film otherwise: {text}")
    following = typed("replay", "IMAGES", "--map", str(args.out), "--out", "poses")
    print(f"next, for images of another walk: {following}")
