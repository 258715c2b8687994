"""The images that a command is given, and their camera: a video, a folder, or a bag."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rs_localizer.cli import UsageError
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import is_bag, open_bag
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


@contextmanager
def shots_of(args: argparse.Namespace) -> Iterator[Iterator[Shot | Carried]]:
    """The images of ``args.recording`` with the lens of ``args.calibration`` or, of a bag, its
    camera_info; topics as ``args.image`` and ``args.camera_info`` name them.
    """
    path: Path = args.recording
    given = None if args.calibration is None else read_calibration(args.calibration)
    if is_bag(path):
        if args.rate is not None:
            raise UsageError("--rate is for videos and folders; a bag has its own times")
        with open_bag(path) as bag:
            topic = find_topic(bag, IMAGE_TYPES, args.image, "--image")
            info = None
            if given is None:
                info = find_topic(bag, (INFO_TYPE,), args.camera_info, "--camera-info")
            yield from_bag(bag, topic, info, given)
        return
    if given is None:
        raise UsageError("a video or folder has no camera_info: give --calibration")
    with file_shots(path, args.rate, given) as shots:
        yield shots


@contextmanager
def file_shots(path: Path, rate: float | None, camera: Camera) -> Iterator[Iterator[Shot]]:
    """The images of a video or folder; afterwards it is told what their times are."""
    clock = ImageClock(rate)
    if not path.is_dir():
        if rate is None and not has_times(path):
            raise UsageError("this video has no presentation times: give --rate; the readout time "
                             "scales with it")  # fmt: skip
        yield from_video(path, camera, clock)
    else:
        files = image_files(path)
        if rate is None and not have_times(files):
            raise UsageError("the names of the files are not times in ns: give --rate")
        yield from_files(files, camera, clock)
    print(clock.told())
    if fault := clock.fault():
        print(f"warning: {fault}")
