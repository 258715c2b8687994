"""Where images come from, offline: a video, a folder of files, a bag."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from rs_localizer.core.camera import Camera
from rs_localizer.frames import Refusal
from rs_localizer.io.bags import BagReader, make_message
from rs_localizer.io.images import Image
from rs_localizer.io.messages import make_header
from rs_localizer.lab.recording import CAMERA_FRAME, make_camera_info
from rs_localizer.lab.video import read_video
from rs_localizer.marker_frames import read

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO_TYPE = "sensor_msgs/msg/CameraInfo"
SUFFIXES = (".jpg", ".jpeg", ".png")

# A time of 0 means "none" to ROS.
_START_NS = 1_000_000_000
# Names of image files that are a time in ns, as EuRoC's and TUM-VI's: from 1973 (before, a name
# may be a time of today in us) to what a stamp of ROS can hold.
_EARLIEST_NS, _LATEST_NS = 10**17, 2**31 * 10**9


class SourceError(ValueError):
    """Images that cannot be used; the message says what was found."""


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One image of a source, and the camera that took it."""

    image: Image | Refusal
    camera_info: Any  # sensor_msgs/CameraInfo
    compressed: Any | None  # the image as sensor_msgs/CompressedImage, where it was compressed


def from_video(path: Path, camera: Camera, rate: float) -> Iterator[Shot]:
    """The images of a video: image ``k`` has the time ``k / rate``.

    Raises:
        ValueError: when it cannot be read.
    """
    for index, (jpeg, gray) in enumerate(read_video(path)):
        stamp_ns = _START_NS + round(index * 1e9 / rate)
        image = Image(stamp_ns, CAMERA_FRAME, gray)
        yield _shot(image, camera, jpeg, "jpeg")


def from_files(files: list[Path], camera: Camera, rate: float | None) -> Iterator[Shot]:
    """JPEG and PNG files; their names are times in ns, or they follow each other at a rate."""
    for index, file in enumerate(files):
        stamp_ns = int(file.stem) if rate is None else _START_NS + round(index * 1e9 / rate)
        data = file.read_bytes()
        name = "png" if file.suffix.lower() == ".png" else "jpeg"
        seconds, nanoseconds = divmod(stamp_ns, 10**9)
        stamp = SimpleNamespace(sec=seconds, nanosec=nanoseconds)
        header = SimpleNamespace(stamp=stamp, frame_id=CAMERA_FRAME)
        found = read(SimpleNamespace(header=header, format=name, data=data))
        if isinstance(found, Refusal):
            found = Refusal(found.reason, f"{file.name}: {found.detail}")
        yield _shot(found, camera, data, name, stamp_ns)


def image_files(folder: Path) -> list[Path]:
    """The JPEG and PNG files of a folder by name, or by number if the names are numbers.

    Raises:
        SourceError: when there is none.
    """
    files = [file for file in folder.iterdir() if file.suffix.lower() in SUFFIXES]
    if not files:
        raise SourceError(f"{folder} has no images: no file ends in {', '.join(SUFFIXES)}")
    if all(file.stem.isdecimal() for file in files):
        return sorted(files, key=lambda file: int(file.stem))
    return sorted(files)


def have_times(files: list[Path]) -> bool:
    """Whether the names of image files are times in ns."""
    names = [file.stem for file in files]
    return all(n.isdecimal() and _EARLIEST_NS <= int(n) < _LATEST_NS for n in names)


def find_topic(bag: BagReader, types: tuple[str, ...], given: str | None, option: str) -> str:
    """The topic of one of these types, given or the only one.

    Raises:
        SourceError: when it is not there, or several could be meant.
    """
    of_type = sorted(topic for topic, kind in bag.topics.items() if kind in types)
    known = ", ".join(of_type) or "none"
    if given is not None:
        if given not in of_type:
            raise SourceError(f"{bag.path} has no topic {given} of that kind; it has {known}")
        return given
    if len(of_type) != 1:
        what = "several topics" if of_type else "no topic"
        choose = f"; choose one with {option}" if of_type else ""
        raise SourceError(f"{bag.path} has {what} of type {' or '.join(types)}: {known}{choose}")
    return of_type[0]


def from_bag(
    bag: BagReader, image_topic: str, info_topic: str | None, camera: Camera | None
) -> Iterator[Shot]:
    """The images of a bag, each with the latest CameraInfo (before the first one: the first)."""
    topics = [image_topic]
    latest: Any = None
    if info_topic is not None:
        topics.append(info_topic)
        latest = next((message for _, _, message in bag.messages([info_topic])), None)
        if latest is None:
            raise SourceError(f"{bag.path} has no message on {info_topic}; give --calibration")
    for topic, _, message in bag.messages(topics):
        if topic == info_topic:
            latest = message
            continue
        image = read(message)
        compressed = message if hasattr(message, "format") else None
        if camera is not None:
            yield _shot(image, camera, compressed)
        else:
            yield Shot(image, latest, compressed)


def _shot(
    image: Image | Refusal,
    camera: Camera,
    compressed: Any,
    name: str | None = None,
    stamp_ns: int = 0,
) -> Shot:
    if isinstance(image, Image):
        stamp_ns = image.stamp_ns
    if name is not None:
        compressed = make_message(
            IMAGE_TYPES[1],
            header=make_header(make_message, stamp_ns, CAMERA_FRAME),
            format=name,
            data=np.frombuffer(compressed, np.uint8),
        )
    return Shot(image, make_camera_info(camera, stamp_ns), compressed)
