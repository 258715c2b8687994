"""The images that a command is given, and their camera: a video, a folder, or a bag."""

from __future__ import annotations

import argparse
import contextlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rs_localizer.cli import UsageError
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagReader, is_bag, open_bag
from rs_localizer.io.calibration.files import read_calibration
from rs_localizer.io.image_clock import ImageClock
from rs_localizer.io.video import has_times
from rs_localizer.offline.image_sources import (
    IMAGE_TYPES,
    INFO_TYPE,
    Carried,
    Shot,
    find_topic,
    from_bag,
    from_files,
    from_video,
    have_times,
    image_files,
)


@dataclass(frozen=True, slots=True)
class Source:
    """Images, as far as they are open."""

    shots: Iterator[Shot] | Iterator[Shot | Carried]
    total: int | None  # None: unknown
    clock: ImageClock | None  # of images without times of their own


@contextlib.contextmanager
def opened(
    args: argparse.Namespace, path: Path, start: float | None = None, calibrated: bool = True
) -> Iterator[Source]:
    """Images with the lens of ``args.calibration`` or, of a bag, its camera_info.

    Args:
        args: with ``rate``, and the topics ``image`` and ``camera_info`` of a bag.
        path: of the images.
        start: time of the first one, s; not of a bag.
        calibrated: refuse images without a calibration.

    Raises:
        UsageError: for options that do not go with it, or that are missing.
    """
    if not is_bag(path):
        for name in ("image", "camera_info"):
            if getattr(args, name) is not None:
                raise UsageError(f"--{name.replace('_', '-')} is a topic of a bag")
        if args.calibration is None and calibrated:
            raise UsageError("a video or folder has no camera_info: give --calibration")
        camera = None if args.calibration is None else read_calibration(args.calibration)
        yield of_files(path, camera, clock_of(path, args.rate, start))
        return
    for name, value in (("rate", args.rate), ("start", start)):
        if value is not None:
            raise UsageError(f"--{name} is for videos and folders; a bag has its own times")
    with open_bag(path) as bag:
        given = None if args.calibration is None else read_calibration(args.calibration)
        yield of_bag(bag, given, args, calibrated)


def of_bag(
    bag: BagReader, camera: Camera | None, args: argparse.Namespace, calibrated: bool = True
) -> Source:
    """The images of a bag; without a camera, with that of its camera_info."""
    topic = find_topic(bag, IMAGE_TYPES, args.image, "--image")
    info = None
    if camera is None and (calibrated or INFO_TYPE in bag.topics.values()):
        info = find_topic(bag, (INFO_TYPE,), args.camera_info, "--camera-info")
    return Source(from_bag(bag, topic, info, camera), bag.count([topic]), None)


def clock_of(path: Path, rate: float | None, start: float | None = None) -> ImageClock:
    """What gives the images of a video or folder their times.

    Raises:
        UsageError: when they have none, and there is no rate.
    """
    if rate is None and not path.is_dir() and not has_times(path):
        raise UsageError("this video has no presentation times: give --rate; the readout time "
                         "scales with it")  # fmt: skip
    if rate is None and path.is_dir() and not have_times(image_files(path)):
        raise UsageError("the names of the files are not times in ns: give --rate")
    return ImageClock(rate, None if start is None else round(start * 1e9))


def of_files(path: Path, camera: Camera | None, clock: ImageClock) -> Source:
    """The images of a video or folder."""
    if not path.is_dir():
        return Source(from_video(path, camera, clock), None, clock)
    files = image_files(path)
    return Source(from_files(files, camera, clock), len(files), clock)


def tell_times(clock: ImageClock | None) -> None:
    """Say where the times of images are from that have been read, and what speaks against them."""
    if clock is None:
        return
    print(clock.told())
    if fault := clock.fault():
        print(f"warning: {fault}")
