"""Videos as JPEG images with their presentation times."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]

_JPEG_START = b"\xff\xd8"
# Markers that stand alone; all others are followed by their length.
_START, _END, _SCAN = 0xD8, 0xD9, 0xDA
_LONELY = {0x01, _START, *range(0xD0, 0xD8)}
# For videos that are not JPEG already; artefacts stay below the noise of a corner.
_QUALITY = 95
# Raw rows: a camera's note that the picture should be shown upright turns the shutter, too.
_AS_IT_IS = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION


class VideoError(ValueError):
    """A video that cannot be read; the message names the file."""


class VideoImage(NamedTuple):
    """One image of a video."""

    jpeg: bytes
    image: Image  # grey (height, width)
    seconds: float | None  # presentation time since the first image; None: the file does not say


def read_video(path: Path | str) -> Iterator[VideoImage]:
    """The images of a video, in the order of presentation.

    A plain stream of JPEG images (``.mjpeg``) keeps its bytes and has no times; anything else that
    OpenCV reads is compressed anew.

    Raises:
        VideoError: when the file is missing or holds no image.
    """
    path = Path(path)
    if not path.is_file():
        raise VideoError(f"{path} does not exist")
    with path.open("rb") as file:
        is_stream = file.read(2) == _JPEG_START
    found = False
    for item in _from_stream(path) if is_stream else _from_container(path):
        found = True
        yield item
    if not found:
        raise VideoError(f"{path} holds no image that OpenCV can read")


def _from_stream(path: Path) -> Iterator[VideoImage]:
    for jpeg in split_jpegs(path.read_bytes()):
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), _AS_IT_IS)
        if image is not None:
            yield VideoImage(jpeg, np.asarray(image, np.uint8), None)


def has_times(path: Path | str) -> bool:
    """Whether a video has presentation times; a single image needs none.

    Raises:
        VideoError: when it cannot be read.
    """
    first = list(itertools.islice(read_video(path), 2))
    return first[-1].seconds is not None


def _from_container(path: Path) -> Iterator[VideoImage]:
    last = -1.0
    video = cv2.VideoCapture(str(path))
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)  # as with _AS_IT_IS
    try:
        while True:
            read, color = video.read()
            if not read:
                return
            _, jpeg = cv2.imencode(".jpg", color, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
            grey = color if color.ndim == 2 else cv2.cvtColor(color, cv2.COLOR_BGR2GRAY)
            # Of the image just read. OpenCV 4.6 says 0 for those last images that a decoder with
            # B frames holds back, and for all images of a raw stream.
            seconds = 1e-3 * float(video.get(cv2.CAP_PROP_POS_MSEC))
            known = seconds > last
            last = max(last, seconds)
            yield VideoImage(jpeg.tobytes(), np.asarray(grey, np.uint8), seconds if known else None)
    finally:
        video.release()


def split_jpegs(data: bytes) -> Iterator[bytes]:
    """The whole images of a stream of JPEGs; one that breaks off is left out.

    Segments are walked by their lengths: an embedded thumbnail has a start and an end of its own.
    """
    start = data.find(_JPEG_START)
    while start >= 0:
        end = _jpeg_end(data, start)
        if end is not None:
            yield data[start:end]
        start = data.find(_JPEG_START, start + 2 if end is None else end)


def _jpeg_end(data: bytes, start: int) -> int | None:
    """Where the image that starts here ends; None: it breaks off or is none."""
    at = start
    while at + 1 < len(data):
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker == _END:
            return at + 2
        if marker == 0xFF:  # padding
            at += 1
        elif marker in _LONELY:
            at += 2
        elif at + 4 > len(data):
            return None
        else:
            at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
            if marker == _SCAN:
                at = _scan_end(data, at)
    return None


def _scan_end(data: bytes, at: int) -> int:
    """The next marker after compressed data, in which 0xFF is followed by 0 or a restart."""
    while True:
        at = data.find(b"\xff", at)
        if at < 0 or at + 1 >= len(data):
            return len(data)
        if data[at + 1] != 0 and not 0xD0 <= data[at + 1] < 0xD8:
            return at
        at += 2
