# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Sources of images, offline: a video, a folder of files, a bag."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Reason
from rs_localizer.io.bags import BagReader
from rs_localizer.io.image_clock import ImageClock
from rs_localizer.io.images import Image, read_image
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.recording import CAMERA_FRAME, make_camera_info, make_image
from rs_localizer.io.video import Video
from rs_localizer.offline.replay import CARRIED_TYPES, as_tf2
from rs_localizer.pipeline.inputs import IMAGE_TYPES
from rs_localizer.pipeline.refusal import Refusal, read_or_refuse

_FORMATS = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png"}  # of image files
_VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".mjpeg", ".mjpg", ".m4v", ".h264", ".ts",
           ".insv")  # fmt: skip

# Names of image files that are a time since 1970, of 2001 to 2038: by the number of their digits
# in s (with a fraction, as TUM's), ms, us, or, as EuRoC's, in ns, which may also be of 1973 on.
_UNITS = {10: 10**9, 13: 10**6, 16: 10**3, 18: 1, 19: 1}
_TIME = re.compile(r"([1-9]\d*)(?:[._](\d{1,9}))?")
_EARLIEST_NS, _LATEST_NS = 10**17, 2**31 * 10**9
# Between two images of a video or a walk.
_SHORTEST_NS, _LONGEST_NS = 10**6, 2 * 10**9


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One image of a source, and the camera that took it."""

    image: Image | Refusal
    camera_info: Any  # sensor_msgs/CameraInfo; None: nobody has calibrated it
    compressed: Any | None  # the image as sensor_msgs/CompressedImage, where it was compressed
    recorded_ns: int  # when it was recorded; of a file, its stamp


@dataclass(frozen=True, slots=True, eq=False)
class Carried:
    """A message of a bag that is no image, and that replay will need."""

    topic: str
    recorded_ns: int
    message: Any


def from_video(path: Path, camera: Camera | None, clock: ImageClock) -> Iterator[Shot]:
    """Yield the images of a video.

    Raises:
        ValueError: when it cannot be read, or has no times and the clock no rate.
    """
    video, frame = Video(path), CAMERA_FRAME
    for jpeg, gray, seconds in video:
        now = clock.stamp(None if seconds is None else round(1e9 * seconds))
        if now is None:
            lost = Refusal(Reason.NO_STAMP, "it has no presentation time")
            yield Shot(lost, _info(camera, 0, frame), None, 0)
        else:
            compressed = make_image(now, "jpeg", jpeg)
            yield Shot(Image(now, frame, gray), _info(camera, now, frame), compressed, now)
    clock.missing, clock.captured = video.fault, video.captured


def from_files(files: list[Path], camera: Camera | None, clock: ImageClock) -> Iterator[Shot]:
    """Yield images of files; their names are times in ns, or they follow at a rate."""
    times = name_times(files)
    clock.absolute = times is not None
    for file in files:
        now = clock.stamp(None if times is None else times[file])
        assert now is not None  # a clock without a rate has refused
        packed = _FORMATS[file.suffix.lower()]
        compressed = make_image(now, packed, file.read_bytes())
        image = read_or_refuse(read_image, compressed, Reason.BAD_IMAGE)
        if isinstance(image, Refusal):
            image = Refusal(image.reason, f"{file.name}: {image.detail}")
        yield Shot(image, _info(camera, now, CAMERA_FRAME), compressed, now)


def image_files(folder: Path) -> list[Path]:
    """Return the image files of a folder by name, or by number if the names are numbers.

    Raises:
        ValueError: when there is none.
    """
    every = [file for file in folder.iterdir() if file.is_file()]  # /dev/zero has no end
    files = [file for file in every if file.suffix.lower() in _FORMATS]
    if not files:
        raise ValueError(
            f"{folder} has no images: no file ends in {', '.join(_FORMATS)}; convert others to PNG "
            "without turning or scaling them"
        )
    if (times := name_times(files)) is not None:
        return sorted(files, key=times.__getitem__)
    if all(file.stem.isdecimal() for file in files):
        return sorted(files, key=lambda file: int(file.stem))
    return sorted(files)


def holds_images(path: Path) -> str:
    """Describe the images of a path that is no recording, as ``is a video``; empty: none."""
    if path.is_dir():
        count = sum(file.suffix.lower() in _FORMATS for file in path.iterdir())
        return f"is a folder of {count} images" if count else ""
    if path.suffix.lower() in _FORMATS:
        return "is an image"
    return "is a video" if path.is_file() and path.suffix.lower() in _VIDEOS else ""


def image_topics(bag: BagReader) -> list[str]:
    """Return the topics of a bag with images."""
    return sorted(topic for topic, kind in bag.topics.items() if kind in IMAGE_TYPES)


def _since_1970(file: Path) -> int | None:
    match = _TIME.fullmatch(file.stem)
    unit = None if match is None else _UNITS.get(len(match[1]))
    if match is None or unit is None or (match[2] and unit != _UNITS[10]):
        return None
    time = int(match[1]) * unit + int((match[2] or "0").ljust(9, "0"))
    return time if _EARLIEST_NS <= time < _LATEST_NS else None


def name_times(files: Sequence[Path]) -> dict[Path, int] | None:
    """Return the times (ns) that the names of image files are, one each; None: they are none.

    Nanoseconds since a device was started have up to 16 digits, as microseconds since 1970 have:
    the interval of the images tells them apart.
    """
    times = [_since_1970(file) for file in files]
    if all(file.stem.isdecimal() for file in files) and len(files) > 1:
        numbers = [int(file.stem) for file in files]
        if _SHORTEST_NS <= float(np.median(np.diff(sorted(numbers)))) <= _LONGEST_NS:
            times = list(numbers)
    known = {file: time for file, time in zip(files, times, strict=True) if time is not None}
    return known if len(set(known.values())) == len(files) else None


def from_bag(
    bag: BagReader, image_topic: str, info_topic: str | None, camera: Camera | None
) -> Iterator[Shot | Carried]:
    """Yield the images of a bag, each with the latest CameraInfo (before the first: the first).

    Between them comes what replay needs besides: transforms and inertial measurements.
    """
    carried = [topic for topic, kind in bag.topics.items() if kind in CARRIED_TYPES]
    topics = [image_topic, *carried]
    latest: Any = None
    if info_topic is not None:
        topics.append(info_topic)
        latest = next((message for _, _, message in bag.messages([info_topic])), None)
        if latest is None:
            raise ValueError(f"{bag.path} has no message on {info_topic}; give --calibration")
    for topic, recorded_ns, message in bag.messages(topics):
        if topic == info_topic:
            latest = message
        elif topic in carried:
            yield Carried(topic, recorded_ns, as_tf2(message))
        else:
            image = read_or_refuse(read_image, message, Reason.BAD_IMAGE)
            compressed = message if hasattr(message, "format") else None
            info = latest
            if camera is not None:  # the image knows its frame, on which transforms hang
                frame = str(message.header.frame_id) or CAMERA_FRAME
                info = make_camera_info(camera, stamp_ns(message), frame)
            yield Shot(image, info, compressed, recorded_ns)


def _info(camera: Camera | None, stamp: int, frame: str) -> Any:
    return None if camera is None else make_camera_info(camera, stamp, frame)
