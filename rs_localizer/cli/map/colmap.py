# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map refine --colmap``: a model of COLMAP as of a global shutter."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rs_localizer.cli import WORKING, replaced, with_values
from rs_localizer.cli.options import UsageError, option
from rs_localizer.cli.settings_args import given_values, row_time

if WORKING:
    from rs_localizer.cli.map import check_readout, print_step
    from rs_localizer.io.atomic_files import atomic_directory
    from rs_localizer.io.calibration import read_calibration
    from rs_localizer.io.maps.colmap import read_model, write_model
    from rs_localizer.io.maps.landmarks import MapError
    from rs_localizer.offline.image_sources import name_times
    from rs_localizer.settings import build
    from rs_localizer.tools.mapping.global_shutter import GlobalShutterModel, Shutter, undo_shutter

_LIST = "images.txt"
_NUMBER = re.compile(r"\d+")
# What a recording needs, and a model has itself or cannot have.
_OF_RECORDINGS = ("recordings", "out", "map", "hold")


@dataclass(frozen=True, kw_only=True)
class ColmapOptions:
    """a model of COLMAP of one camera, for programs that know a global shutter only."""

    colmap: tuple[Path, Path] | None = option(
        "instead of RECORDING: folder of a sparse model, text or binary, and one to create",
        "IN OUT",
    )
    rate: float | None = option(
        "images per second of the numbers in the images' names, which else are times in ns", "HZ",
        limits=(0.0, math.inf), above=True,
    )  # fmt: skip
    row: str = option(
        "of the poses: first, middle, last, or a row time from -0.5 to 0.5", "ROW", "middle"
    )


def run(args: Any) -> None:
    for name in _OF_RECORDINGS:
        if getattr(args, name) not in (None, []):
            raise UsageError(f"--colmap goes without {'--' * (name != 'recordings')}{name}")
    if args.shutter == "global":
        raise UsageError("a model of a global shutter needs no refinement")
    folder, out = args.colmap
    args = with_values(args, out=out, row=row_time(args.row))
    try:
        model = read_model(folder)
        images, camera = model.images, model.camera
    except MapError as error:
        raise MapError(f"{folder}: {error}") from error
    if args.calibration is not None:
        camera = read_calibration(args.calibration)
    stamps = image_stamps(list(images), args.rate)
    with atomic_directory(args.out, replaced(args, _LIST)) as built:
        result = undo_shutter(camera, model, images, stamps, _known(args), print_step)
        check_readout(args, result.refined.readout_check, "see --shutter estimated")
        built.mkdir()
        write_model(built, result.camera, result.images, result.points)
    _tell(args, result, len(images), len(model.points))


def _known(args: Any) -> Shutter:
    values = given_values(args)
    config = build(values)
    readout = config.readout_time if args.shutter != "estimated" else 0.0
    if args.shutter == "given" and not readout:
        raise UsageError("--shutter given needs -p readout_time:=S or --params")
    direction = str(config.scan_direction) if readout or "scan_direction" in values else None
    return Shutter(readout or None, direction, args.intrinsics, args.row)


def image_stamps(names: list[str], rate: float | None) -> dict[str, int]:
    """When images were taken, ns, by their names: times in ns, or numbers at a rate.

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
        numbers = _NUMBER.findall(Path(name).stem)
        if not numbers:
            raise UsageError(f"the name {name} has no number for --rate")
        stamps[name] = round(1e9 * int(numbers[-1]) / rate)
    if len(set(stamps.values())) < len(stamps):
        raise UsageError("images of the same number: --rate is for images of one video")
    return stamps


def _tell(args: Any, result: GlobalShutterModel, images: int, points: int) -> None:
    kept = sum(len(image.points) for image in result.images.values())
    shutter = result.camera
    rows = [
        ("images with a pose", f"{len(result.images)} of {images}"),
        ("points", f"{len(result.points.ids)} of {points}"),
        ("keypoints that fit", f"{kept} of {result.keypoints}"),
        (
            "error with a global shutter",
            f"{result.before:.3f} px rms before, {result.after:.3f} after",
        ),
        ("noise of u and of v", f"{result.refined.deviation:.3f} px"),
        ("readout time", f"{1e3 * shutter.readout_time:.3f} ms {shutter.scan_direction}"),
    ]
    for name, text in rows:
        print(f"{name:28} {text}")
    fit = result.shutter
    if fit is not None and not fit.visible:
        print(
            f"warning: the images show no rolling shutter ({1e3 * fit.readout_time:.1f} +- "
            f"{1e3 * fit.deviation:.1f} ms fits best): the model is that of a global one"
        )
    elif args.shutter != "given" and fit is None and not shutter.readout_time:
        why = "too few images follow each other"
        if result.refined.apart:
            why = "no smooth motion joins the images, each has a pose of its own: too little"
        print(f"warning: {why} to show a rolling shutter: give it")
    print(f"written: {args.out}")
