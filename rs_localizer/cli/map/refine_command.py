# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map refine``: a map adjusted with the rolling shutter that saw it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from rs_localizer.cli import earlier_result, refuse_existing, write_all
from rs_localizer.cli.options import ResultOptions, UsageError, argument, option
from rs_localizer.cli.recording_input import (
    LensOptions,
    given_lens,
    given_settings,
    given_values,
    recorded,
)
from rs_localizer.io.atomic_files import atomic_directory
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_files import write_calibration
from rs_localizer.io.maps.colmap import read_model, write_model
from rs_localizer.io.maps.files import SUFFIX, read_map_file, write_npz
from rs_localizer.io.maps.landmarks import Map, MapError
from rs_localizer.offline.image_sources import name_times
from rs_localizer.settings import build
from rs_localizer.tools.mapping.global_shutter import GlobalShutterModel, undo_shutter
from rs_localizer.tools.mapping.map_keypoints import MapFreedom, RecordedMap, from_recording
from rs_localizer.tools.mapping.refinement import RefinedMap, refine


@dataclass(frozen=True, kw_only=True)
class Options(LensOptions, ResultOptions):
    recording: Path = argument("a bag of correspondences or keypoints", "RECORDING", Path())
    map: Path | None = option("the map (default: the points of the recording)", "MAP")
    out: Path | None = option(f"ends in {SUFFIX}", "OUT")
    intrinsics: bool = option("adjust the lens as well", default=False)
    colmap: tuple[Path, Path] | None = option(
        "instead of RECORDING: folder of a sparse model of COLMAP, text or binary, of one camera, "
        "and one to create, for programs that know a global shutter only", "IN OUT",
    )  # fmt: skip
    rate: float | None = option(
        "with --colmap: images per second of the numbers in the images' names, which else are "
        "times in ns", "HZ", above=0.0,
    )  # fmt: skip


def run(args: Options) -> None:
    if args.colmap is not None:
        _undo_shutter(args, *args.colmap)
        return
    if args.recording == Path() or args.out is None:
        raise UsageError("give RECORDING and --out OUT, or --colmap IN OUT")
    if args.out.suffix != SUFFIX:
        raise UsageError(f"--out must end in {SUFFIX}, got {args.out}")
    config = given_settings(args)
    refuse_existing(args)
    landmarks = None if args.map is None else read_map_file(args.map, config.map_frame)
    with open_bag(args.recording) as bag:
        lens, clouds = recorded(args, bag, config, landmarks)
    camera = replace(lens, readout_time=config.readout_time, scan_direction=config.scan_direction)
    localized = from_recording(camera, clouds, landmarks)
    spread = config.map_deviation
    deviations = np.full(len(localized.landmarks), spread) if spread > 0.0 else None
    freedom = MapFreedom(
        readout_time=not config.readout_time > 0.0, lens=args.intrinsics, deviations=deviations
    )
    refined = refine(
        camera, localized.seen, localized.start, freedom, stamp_offset=config.stamp_offset
    )
    _print_result(localized, refined)
    if refined.readout_check is not None:
        refined.readout_check.refuse()
    _write(args, args.out, localized.landmarks, refined)


def _print_result(localized: RecordedMap, refined: RefinedMap) -> None:
    moved = np.linalg.norm(refined.points - localized.start.points, axis=1)[refined.refined]
    spread = np.sqrt(np.trace(refined.covariances[refined.refined], axis1=1, axis2=2))
    rows = {
        "images with a pose": f"{len(localized.seen.stamps_ns)} of {localized.images}",
        "landmarks refined": f"{np.count_nonzero(refined.refined)} of {len(refined.points)}",
        "noise before": f"{refined.before:.3f} px",
        "noise after": f"{refined.after:.3f} px",
        "keypoints that fit": f"{np.mean(refined.inliers):.1%}",
    }
    if len(moved):
        far = f"{1e3 * np.median(moved):.1f} mm (median), {1e3 * moved.max():.1f} at most"
        rows["landmarks moved by"] = far
        rows["deviation of a landmark"] = f"{1e3 * np.median(spread):.1f} mm (median)"
    deviation = refined.readout_time_deviation
    text = "" if np.isnan(deviation) else f" +- {1e3 * deviation:.3f}"
    rows["readout time"] = f"{1e3 * refined.readout_time:.3f}{text} ms"
    _print(rows)
    if refined.readout_time < 0.0:
        print("the readout time is negative: the scan direction is the reverse of what was set")


def _print(rows: dict[str, str]) -> None:
    for name, text in rows.items():
        print(f"{name:28} {text}")


def _write(args: Options, out: Path, landmarks: Map, result: RefinedMap) -> None:
    refined = replace(
        landmarks, points=result.points, covariances=result.covariances, error_modes=None
    )
    writers: dict[Path, Callable[[Path], object]] = {out: lambda part: write_npz(part, refined)}
    if args.intrinsics:
        lens = out.with_name(f"{out.stem}_camera_info.yaml")
        writers[lens] = partial(write_calibration, camera=result.camera)
    write_all(writers)
    if unchanged := np.count_nonzero(~result.refined):
        print(
            f"{unchanged} landmarks are unchanged: in fewer than two images, or from "
            "too few sides to be known better"
        )


# A model of COLMAP, as of a global shutter.


def _undo_shutter(args: Options, folder: Path, out: Path) -> None:
    for name in ("recording", "out", "map"):
        if getattr(args, name) not in (None, Path()):
            raise UsageError(f"--colmap goes without {'--' * (name != 'recording')}{name}")
    try:
        model = read_model(folder)
    except MapError as error:
        raise MapError(f"{folder}: {error}") from error
    camera, stamps = given_lens(args) or model.camera, image_stamps(list(model.images), args.rate)
    values = given_values(args)
    config = build(values)
    known = config.readout_time or "scan_direction" in values
    shutter = config.readout_time or None, str(config.scan_direction) if known else None
    with atomic_directory(out, earlier_result(args, "images.txt", out)) as built:
        result = undo_shutter(camera, model, stamps, shutter, args.intrinsics)
        if result.readout_check is not None:
            result.readout_check.refuse()
        built.mkdir()
        write_model(built, result.camera, result.images, result.points)
    _print_model(result, len(model.images), len(model.points))
    print(f"written: {out}")


def image_stamps(names: list[str], rate: float | None) -> dict[str, int]:
    """Return times of images (ns) by their names: times in ns, or numbers at a rate.

    Raises:
        UsageError: for names that are neither.
    """
    if rate is None:
        times = name_times([Path(name) for name in names])
        if times is None:
            raise UsageError(
                f"the names of the images are not times (such as {names[0]}): give --rate, "
                "the images per second of the numbers in them (1e9 for ns since a video's start)"
            )
        return {name: times[Path(name)] for name in names}
    stamps = {}
    for name in names:
        numbers = re.findall(r"\d+", Path(name).stem)
        if not numbers:
            raise UsageError(f"the name {name} has no number for --rate")
        stamps[name] = round(1e9 * int(numbers[-1]) / rate)
    if len(set(stamps.values())) < len(stamps):
        raise UsageError("images of the same number: --rate is for images of one video")
    return stamps


def _print_model(result: GlobalShutterModel, images: int, points: int) -> None:
    kept, shutter = sum(len(image.points) for image in result.images.values()), result.camera
    _print({
        "images with a pose": f"{len(result.images)} of {images}",
        "points": f"{len(result.points.ids)} of {points}",
        "keypoints that fit": f"{kept} of {result.keypoints}",
        "error with a global shutter": (
            f"{result.before:.3f} px rms before, {result.after:.3f} after"
        ),
        "noise of u and of v": f"{result.refined.deviation:.3f} px",
        "readout time": f"{1e3 * shutter.readout_time:.3f} ms {shutter.scan_direction}",
    })  # fmt: skip
    fit = result.shutter
    if fit is not None and not fit.visible:
        print(
            f"warning: the images show no rolling shutter ({1e3 * fit.readout_time:.1f} +- "
            f"{1e3 * fit.deviation:.1f} ms fits best): the model is that of a global one"
        )
    elif fit is None and not shutter.readout_time:
        print("warning: no smooth motion joins enough images to show a rolling shutter: give it")
