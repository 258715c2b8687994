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
    import cv2
    import numpy as np
    from tqdm import tqdm

    from rs_localizer.cli.map import check_readout, print_step
    from rs_localizer.io.atomic_files import atomic_directory
    from rs_localizer.io.calibration import read_calibration
    from rs_localizer.io.maps.colmap import read_model, write_model
    from rs_localizer.io.maps.landmarks import MapError
    from rs_localizer.offline.image_sources import have_times, name_time
    from rs_localizer.settings import build
    from rs_localizer.tools.mapping.global_shutter import GlobalShutterModel, Shutter, undo_shutter
    from rs_localizer.tools.rectified import map_depths, motion_between, rectified

_LIST, _IMAGES = "images.txt", "images"
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
    images: Path | None = option(
        f"of the model: also write them as of a global shutter, to OUT/{_IMAGES}", "FOLDER"
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
    if args.images is not None:
        missing = [name for name in images if not (args.images / name).is_file()]
        if missing:
            raise ValueError(f"{args.images} has no {missing[0]}, an image of the model")
    with atomic_directory(args.out, replaced(args, _LIST)) as built:
        result = undo_shutter(camera, model, images, stamps, _known(args), print_step)
        check_readout(args, result.refined.readout_check, "see --shutter estimated")
        built.mkdir()
        write_model(built, result.camera, result.images, result.points)
        share = None if args.images is None else _write_images(args, result, built / _IMAGES)
    _tell(args, result, len(images), len(model.points))
    if share is not None:
        print(f"{args.out / _IMAGES}: {1 - share:.1%} of the pixels are left black: not known")


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
        if not have_times([Path(name) for name in names]):
            raise UsageError(
                f"the names of the images are not times (such as {names[0]}): give --rate, "
                "the images per second of the numbers in them (1e9 for ns since a video's start)"
            )
        return {name: name_time(Path(name)) or 0 for name in names}
    stamps = {}
    for name in names:
        numbers = _NUMBER.findall(Path(name).stem)
        if not numbers:
            raise UsageError(f"the name {name} has no number for --rate")
        stamps[name] = round(1e9 * int(numbers[-1]) / rate)
    if len(set(stamps.values())) < len(stamps):
        raise UsageError("images of the same number: --rate is for images of one video")
    return stamps


def _write_images(args: Any, result: GlobalShutterModel, folder: Path) -> float:
    """The images of the model; the share of their pixels that is known."""
    depths = map_depths(result.points.points)
    shares = []
    for name, ends in tqdm(result.ends.items(), unit="image", desc="rectify", disable=None):
        image = cv2.imread(
            str(args.images / name), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
        )
        size = None if image is None else (image.shape[1], image.shape[0])
        if image is None or image.dtype != np.uint8 or size != result.camera.size:
            raise ValueError(
                f"{args.images / name} is no image of 8 bits and of the model's "
                f"{result.camera.size[0]}x{result.camera.size[1]} pixels"
            )
        pixels = np.asarray(image, np.uint8)
        made, known = rectified(result.camera, pixels, motion_between(*ends), depths, args.row)
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(cv2.imencode(file.suffix, made)[1].tobytes())
        shares.append(float(known.mean()))
    return float(np.mean(shares))


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
