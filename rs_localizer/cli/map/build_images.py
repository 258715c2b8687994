"""The images of ``map build``: looked at one after the other, not all of them kept."""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from tqdm import tqdm

from rs_localizer.cli import UsageError
from rs_localizer.cli.image_input import opened, shutter_values, tell_left_out, time_faults
from rs_localizer.core.camera import Camera
from rs_localizer.io.images import Image
from rs_localizer.mapping.anchors import PointSight
from rs_localizer.mapping.views import Looker, View
from rs_localizer.offline.detect import Cameras
from rs_localizer.offline.image_sources import Carried
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.settings import build

# Images a hair before their time are in time.
_EARLY = 0.9


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """What was seen."""

    views: list[View]
    camera: Camera  # without its readout time
    images: int
    points: tuple[PointSight, ...]


@dataclass(frozen=True, slots=True)
class Shutter:
    """What is known of it."""

    readout_time: float | None  # s; None: not known
    scan_direction: str


def shutter_of(args: argparse.Namespace) -> Shutter:
    """As given, or as it stands beside the images of a recording."""
    known = build(shutter_values(args))
    return Shutter(known.readout_time or None, known.scan_direction)


def look_at_images(args: argparse.Namespace, looker: Looker, scan_direction: str) -> Looked:
    """Look at the images that are kept: so many a second, and those in which points are given."""
    wanted = sorted({seconds for _, seconds, _, _ in args.point})
    cameras, camera = Cameras(scan_direction), None
    views: list[View] = []
    images, stamps = 0, list[int]()
    refused, named = dict[str, str](), dict[float, int]()
    with opened(args, args.images, args.start) as source, tqdm(
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
            seen_by = cameras.of(shot, image)
            if camera is not None and seen_by is not camera:
                raise ValueError("the camera_info changes on the way; cut the recording there")
            camera = seen_by
            stamps.append(image.stamp_ns)
            asked = [s for s in wanted if s not in named and _time(image, stamps) >= s - 1e-3]
            named |= dict.fromkeys(asked, len(views))
            if asked or _due(image, views, args.images_per_second):
                views.append(looker.look(image))
    if camera is None:
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
