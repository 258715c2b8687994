# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map build``: images of a place -> a map of landmarks, in metres."""

from __future__ import annotations

import argparse
import math
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from rs_localizer.cli import WORKING, replaced, stage, with_values
from rs_localizer.cli.image_input import (
    ImageOptions,
    opened,
    shutter_values,
    tell_left_out,
    tell_telemetry,
    tell_times,
)
from rs_localizer.cli.options import UsageError, argument, number, option
from rs_localizer.config import FeatureConfig

if WORKING:
    import numpy as np
    from tqdm import tqdm

    from rs_localizer.cli.marker_map import read_checked_map
    from rs_localizer.core.camera import Camera
    from rs_localizer.core.scanning import ScanDirection
    from rs_localizer.io.atomic_files import atomic_directory
    from rs_localizer.io.calibration import write_calibration
    from rs_localizer.io.maps.files import write_npz
    from rs_localizer.io.recording import CAMERA, MAP, MAP_FRAME, PARAMETERS
    from rs_localizer.io.trajectories import Trajectory, write_tum
    from rs_localizer.offline.detect import Cameras
    from rs_localizer.offline.image_sources import Carried
    from rs_localizer.pipeline.refusal import Refusal
    from rs_localizer.settings import build, write_parameters
    from rs_localizer.tools.mapping.anchors import Anchors, Distance, PointSight
    from rs_localizer.tools.mapping.build import Built, Given, Workshop, build_map, check_features
    from rs_localizer.tools.mapping.colmap import Effort, require
    from rs_localizer.tools.mapping.report import advice, rows, written
    from rs_localizer.tools.mapping.views import Looker, View

# After so many, images without features are refused: two seconds of a usual video.
_EARLY_VIEWS = 30
# Images a hair before their time are in time.
_EARLY = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """What was seen."""

    views: list[View]
    camera: Camera | None  # without its readout time; None: nobody has calibrated it
    images: int
    points: tuple[PointSight, ...]


@dataclass(frozen=True, slots=True)
class Shutter:
    """What is known of it."""

    readout_time: float | None  # s; None: not known
    scan_direction: str | None


def shutter_of(args: Any) -> Shutter:
    """As given, or as it stands beside the images of a recording."""
    values = shutter_values(args)
    settings = build(values)
    # 0 is a global shutter where the user says so, and unknown in a file.
    said = any(text.startswith("readout_time:=") for text in args.assignments)
    unknown = not said and not settings.readout_time
    readout_time = None if unknown else settings.readout_time
    return Shutter(readout_time, settings.scan_direction if "scan_direction" in values else None)


def look_at_images(args: Any, looker: Looker) -> Looked:
    """Look at the images that are kept: so many a second, and those in which points are given."""
    wanted = sorted({seconds for _, seconds, _, _ in args.point})
    cameras, camera = Cameras(ScanDirection.TOP_TO_BOTTOM), None
    views: list[View] = []
    size = None
    images, stamps = 0, list[int]()
    refused, named = dict[str, str](), dict[float, int]()
    with opened(args, args.images, calibrated=False) as source, tqdm(
        total=source.total, unit="image", desc="look", disable=None
    ) as bar:  # fmt: skip
        for shot in source.shots:
            if isinstance(shot, Carried):
                continue
            images += 1
            bar.update()
            image = shot.image
            if isinstance(image, Refusal):
                refused.setdefault(image.reason, image.detail)
                continue
            seen_by = None if shot.camera_info is None else cameras.of(shot, image)
            if size not in (None, image.pixels.shape) or (views and seen_by is not camera):
                raise ValueError("the camera changes within the recording; cut it there")
            camera, size = seen_by, image.pixels.shape
            stamps.append(image.stamp_ns)
            since = (image.stamp_ns - stamps[0]) * 1e-9
            asked = [s for s in wanted if s not in named and since >= s - 1e-3]
            named |= dict.fromkeys(asked, len(views))
            due_ns = 1e9 * _EARLY / args.images_per_second
            if asked or not views or image.stamp_ns - views[-1].stamp_ns >= due_ns:
                views.append(looker.look(image))
                if len(views) == _EARLY_VIEWS:
                    check_features(views)
    if size is None:
        why = "; ".join(refused.values())
        raise ValueError(f"{args.images} has no image that can be read; {why}")
    tell_left_out(refused, {})
    period = float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else np.nan
    tell_times(source.clock, build(shutter_values(args)).readout_time, period)
    sights = []
    for name, seconds, u, v in args.point:
        if seconds not in named:
            raise UsageError(f"--point {name}: the images end before {seconds:g} s")
        sights.append(PointSight(name, named[seconds], (u, v)))
    return Looked(views, camera, images, tuple(sights))


COLMAP, POSES, REPORT = "colmap", "poses.txt", "report.md"
# A hand's motion is held by so many images a second.
_IMAGES_PER_SECOND = 15.0


@dataclass(frozen=True, kw_only=True)
class Options(ImageOptions):
    images: Path = argument("images of one camera, as for detect", "VIDEO|BAG|FOLDER")
    out: Path = option("to create", "DIR", required=True)
    overwrite: bool = option("replace an earlier result", default=False)
    markers: Path | None = option("marker map; some of it is in the images", "FILE")
    point: list[tuple[str, str, str, str]] = option(
        "a point in the first image at or after SECONDS from the start, by its raw pixel; each "
        "one in two images or more", "NAME SECONDS U V", list,
    )  # fmt: skip
    distance: list[tuple[str, str, str]] = option(
        "between two of these points", "NAME NAME METRES", list
    )
    images_per_second: float = option(
        "of a video that are used, at most", "N", _IMAGES_PER_SECOND, limits=(0.0, math.inf),
        above=True,
    )  # fmt: skip


def run(options: Options) -> None:
    points, distances = map(_point, options.point), map(_distance, options.distance)
    args = with_values(options, point=list(points), distance=list(distances))
    if args.markers is not None and (args.point or args.distance):
        raise UsageError("give either --markers or --point and --distance")
    _check_points(args)
    require()
    if not args.images.exists():
        raise ValueError(f"{args.images} does not exist")
    markers = None if args.markers is None else read_checked_map(args.markers)
    tell_telemetry(args, lens=False)
    shutter = shutter_of(args)
    with atomic_directory(args.out, replaced(args, MAP)) as out:
        out.mkdir()
        with TemporaryDirectory(dir=out) as images:
            looked = look_at_images(
                args, Looker(FeatureConfig().max_keypoints, Path(images), markers)
            )
            anchors = Anchors(markers, looked.points, tuple(args.distance))
            inputs = Given(
                looked.views, looked.camera, anchors, shutter.readout_time,
                shutter.scan_direction, MAP_FRAME if markers is None else markers.map_frame,
            )  # fmt: skip
            folder = out / COLMAP
            folder.mkdir()
            built = build_map(inputs, Workshop(folder, Effort(), stage))
        _write(out, built, looked)
    _tell(args, built, looked)


def _check_points(args: Any) -> None:
    """Before minutes of work: that each point of a distance is given in two images."""
    names = [name for name, *_ in args.point]
    if names and not args.distance:
        raise UsageError("--point needs --distance")
    for name in (end for distance in args.distance for end in (distance.one, distance.other)):
        if names.count(name) < 2:
            raise UsageError(
                f"--distance: the point {name} must be given by --point in two images or more, "
                f"it is in {names.count(name)}"
            )


def _write(out: Path, built: Built, looked: Looked) -> None:
    write_npz(out / MAP, built.landmarks)
    shutter = {
        "readout_time": built.camera.readout_time,
        "scan_direction": str(built.camera.scan_direction),
    }
    write_parameters(out / PARAMETERS, shutter)
    stamps, positions, quaternions = built.middle_rows([view.stamp_ns for view in looked.views])
    write_tum(out / POSES, Trajectory(stamps, positions, quaternions), ["of the middle rows"])
    if looked.camera is None:
        write_calibration(out / CAMERA, replace(built.camera, readout_time=0.0))
    (out / REPORT).write_text(written(built, looked.images, looked.views), encoding="utf-8")


def _tell(args: Any, built: Built, looked: Looked) -> None:
    print(args.out / MAP)
    for name, text in rows(built, looked.images, len(looked.views)):
        print(f"  {name:30} {text}")
    if not built.placement.scaled:
        print(
            "warning: nothing determines the scale: poses and velocities are in units of the map; "
            "give --markers, or --point and --distance"
        )
    if built.readout_check is not None and built.readout_check.differs:
        print(f"warning: {built.readout_check.message}; the map has what was estimated")
    if built.placement.doubt:
        print(f"warning: {built.placement.doubt}")
    for text in advice(built, looked.views):
        print(f"to film otherwise: {text}")
    out = shlex.quote(str(args.out))
    lens = f" --camera {out}/{CAMERA}" if looked.camera is None else ""
    print(
        f"next, for images of another walk: rs_localizer detect IMAGES --features sift{lens} --out "
        f"seen && rs_localizer replay seen --params {out}/{PARAMETERS} --map {out}/{MAP} --out "
        "poses"
    )


def _point(words: Sequence[str]) -> tuple[str, float, float, float]:
    """NAME SECONDS U V."""
    name, *numbers = words
    seconds, u, v = (_number("--point", text) for text in numbers)
    return name, seconds, u, v


def _distance(words: Sequence[str]) -> Distance:
    """NAME NAME METRES."""
    one, other, text = words
    metres = _number("--distance", text)
    if not metres > 0.0 or one == other:
        raise UsageError(f"--distance: must be two points and metres, got {' '.join(words)}")
    return Distance(one, other, metres)


def _number(option: str, text: str) -> float:
    try:
        return number()(text)
    except argparse.ArgumentTypeError as error:
        raise UsageError(f"{option}: {error}") from error
