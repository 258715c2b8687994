# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Videos as JPEG images with their presentation times."""

import contextlib
import itertools
import mmap
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.io.images import ALONE, decode
from rs_localizer.io.messages import MessageError

Image = NDArray[np.uint8]

_JPEG_START = b"\xff\xd8"
_START, _END, _SCAN = 0xD8, 0xD9, 0xDA
# For videos that are not JPEG already; artefacts stay below the noise of a corner.
_QUALITY = 95


class VideoError(ValueError):
    """A video that cannot be read; the message names the file."""


class VideoImage(NamedTuple):
    """One image of a video."""

    jpeg: bytes
    image: Image  # grey (height, width)
    seconds: float | None  # presentation time since the first image; None: the file does not say


def count_lenses(path: Path) -> int:
    """How many cameras filmed into one file: its streams of one size, as in Insta360's .insv.

    Raises:
        VideoError: when it cannot be read.
        ImportError: without PyAV.
    """
    with _container(path) as container:
        return len(_lenses(container))


def read_video(path: Path | str, lens: int | None = None) -> Iterator[VideoImage]:
    """The images of a video, in the order of presentation.

    A plain stream of JPEG images (``.mjpeg``) keeps its bytes and has no times; anything else that
    OpenCV reads is compressed anew.

    Args:
        path: of the video.
        lens: of :func:`count_lenses`, from 0 on: its images, whose times are since the first image
            of the first lens; None: the only stream, or the one that OpenCV takes.

    Raises:
        VideoError: when the file is missing or holds no image.
        ImportError: with a lens, without PyAV.
    """
    path = Path(path)
    if not path.is_file():
        raise VideoError(f"{path} does not exist")
    with path.open("rb") as file:
        is_stream = file.read(2) == _JPEG_START
    if lens is not None:
        images = _of_lens(path, lens)
    else:
        images = _from_stream(path) if is_stream else _from_container(path)
    first = next(images, None)
    if first is None:
        raise VideoError(f"{path} holds no image that OpenCV can read")
    yield first
    yield from images


@contextlib.contextmanager
def _container(path: Path) -> Iterator[Any]:
    import av

    try:
        with av.open(str(path)) as container:
            yield container
    except av.FFmpegError as error:
        raise VideoError(f"{path} cannot be read: {error}") from error


def _lenses(container: Any) -> list[Any]:
    streams = container.streams.video
    return [stream for stream in streams if stream.format.width == streams[0].format.width
            and stream.format.height == streams[0].format.height]  # fmt: skip


def _of_lens(path: Path, lens: int) -> Iterator[VideoImage]:
    """By PyAV: OpenCV opens one stream of a file only."""
    with _container(path) as container:
        lenses = _lenses(container)
        if lens >= len(lenses):
            raise VideoError(f"{path} is of {len(lenses)} lenses, and has no number {lens + 1}")
        begin = float((lenses[0].start_time or 0) * lenses[0].time_base)
        lenses[lens].thread_type = "AUTO"
        for frame in container.decode(lenses[lens]):
            color = frame.to_ndarray(format="bgr24")
            yield _compressed(color, None if frame.time is None else float(frame.time) - begin)


def _from_stream(path: Path) -> Iterator[VideoImage]:
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for jpeg in split_jpegs(data):
            with contextlib.suppress(MessageError):
                yield VideoImage(jpeg, decode(jpeg, "jpeg"), None)


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
    # Raw rows: a note that the picture should be shown upright turns the shutter, too.
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    try:
        while True:
            read, color = video.read()
            if not read:
                return
            # Of the image just read. OpenCV 4.6 says 0 for those last images that a decoder with
            # B frames holds back, and for all images of a raw stream.
            seconds = 1e-3 * float(video.get(cv2.CAP_PROP_POS_MSEC))
            is_new = seconds > last
            last = max(last, seconds)
            yield _compressed(color, seconds if is_new else None)
    finally:
        video.release()


def _compressed(color: Any, seconds: float | None) -> VideoImage:
    _, jpeg = cv2.imencode(".jpg", color, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    grey = color if color.ndim == 2 else cv2.cvtColor(color, cv2.COLOR_BGR2GRAY)
    return VideoImage(jpeg.tobytes(), np.asarray(grey, np.uint8), seconds)


def split_jpegs(data: bytes | mmap.mmap) -> Iterator[bytes]:
    """The whole images of a stream of JPEGs; one that breaks off is left out.

    Segments are walked by their lengths: an embedded thumbnail has a start and an end of its own.
    """
    start = data.find(_JPEG_START)
    while start >= 0:
        is_whole, end = _walk_jpeg(data, start)
        if is_whole:
            yield data[start:end]
        start = data.find(_JPEG_START, max(start + 2, end))


def _walk_jpeg(data: bytes | mmap.mmap, start: int) -> tuple[bool, int]:
    """Whether the image that starts here has an end, and where that is, or where it breaks off."""
    at = start + 2
    while at + 1 < len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == _END:
            return True, at + 2
        if marker == _START:  # the next one
            break
        if marker == 0xFF:  # padding
            at += 1
        elif marker in ALONE:
            at += 2
        elif at + 4 > len(data):
            break
        else:
            end = at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
            if end > len(data):
                break
            at = _scan_end(data, end) if marker == _SCAN else end
    return False, at


def _scan_end(data: bytes | mmap.mmap, at: int) -> int:
    """The next marker after compressed data, in which 0xFF is followed by 0 or a restart."""
    while True:
        at = data.find(b"\xff", at)
        if at < 0 or at + 1 >= len(data):
            return len(data)
        if data[at + 1] != 0 and not 0xD0 <= data[at + 1] < 0xD8:
            return at
        at += 2
