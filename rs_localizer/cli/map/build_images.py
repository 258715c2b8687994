"""The images of ``map build``: looked at one after the other, not all of them kept."""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from rs_localizer.cli import UsageError
from rs_localizer.cli.image_source import tell_left_out, time_faults
from rs_localizer.cli.shots import opened
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.bags import is_bag
from rs_localizer.io.images import Image
from rs_localizer.io.recording import PARAMETERS
from rs_localizer.mapping.anchors import PointSight
from rs_localizer.mapping.build import check_features
from rs_localizer.mapping.views import Looker, View
from rs_localizer.offline.detect import Cameras
from rs_localizer.offline.image_sources import Carried
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.settings import build, load_params_file

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


def shutter_of(args: argparse.Namespace) -> Shutter:
    """As given, or as it stands beside the images of a recording."""
    if args.readout_time is not None:
        return Shutter(args.readout_time, args.scan_direction)
    beside = args.images / PARAMETERS
    if is_bag(args.images) and beside.exists():
        known = build(load_params_file(beside))
        return Shutter(known.readout_time or None, args.scan_direction or known.scan_direction)
    return Shutter(None, args.scan_direction)


def look_at_images(args: argparse.Namespace, looker: Looker) -> Looked:
    """Look at the images that are kept: so many a second, and those in which points are given."""
    wanted = sorted({seconds for _, seconds, _, _ in args.point})
    cameras, camera = Cameras(ScanDirection.TOP_TO_BOTTOM), None
    views: list[View] = []
    size = None
    images, stamps = 0, list[int]()
    refused, named = dict[str, str](), dict[float, int]()
    with opened(args, args.images, args.start, calibrated=False) as source, tqdm(
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
                raise ValueError("the camera changes on the way; cut the recording there")
            camera, size = seen_by, image.pixels.shape
            stamps.append(image.stamp_ns)
            asked = [s for s in wanted if s not in named and _time(image, stamps) >= s - 1e-3]
            named |= dict.fromkeys(asked, len(views))
            if asked or _due(image, views, args.images_per_second):
                views.append(looker.look(image))
                if len(views) == _EARLY_VIEWS:
                    check_features(views)
    if size is None:
        why = "; ".join(refused.values())
        raise ValueError(f"{args.images} has no image that can be read; {why}")
    tell_left_out(refused, {})
    period = float(np.median(np.diff(stamps))) * 1e-9 if len(stamps) > 1 else np.nan
    for fault in time_faults(args, source.clock, period):
        print(f"warning: {fault}")
    return Looked(views, camera, images, _points(args, named))


def _time(image: Image, stamps: list[int]) -> float:
    """s since the first image."""
    return (image.stamp_ns - stamps[0]) * 1e-9


def _due(image: Image, views: list[View], rate: float) -> bool:
    if not views:
        return True
    since = (image.stamp_ns - views[-1].stamp_ns) * 1e-9
    return since >= _EARLY / rate


def _points(args: argparse.Namespace, named: dict[float, int]) -> tuple[PointSight, ...]:
    sights = []
    for name, seconds, u, v in args.point:
        if seconds not in named:
            raise UsageError(f"--point {name}: the images end before {seconds:g} s")
        sights.append(PointSight(name, named[seconds], (u, v)))
    return tuple(sights)
