# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Videos as JPEG images with their presentation times."""

import contextlib
import itertools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.io.images import most_pixels

Image = NDArray[np.uint8]

_JPEG_START = b"\xff\xd8"
# Artefacts stay below the noise of a corner.
_QUALITY = 95


class VideoError(ValueError):
    """A video that cannot be read; the message names the file."""


class VideoImage(NamedTuple):
    """One image of a video."""

    jpeg: bytes
    image: Image  # grey (height, width)
    seconds: float | None  # presentation time by the file's clock; None: the file does not say


class Video:
    """The images of a video, in the order of presentation; to be iterated over once.

    They are read by PyAV (extra ``video``) and compressed anew. A plain stream of JPEG images
    (``.mjpeg``) has no times.

    Args:
        path: of the video.

    Raises:
        VideoError: when the file is missing, or, as it is read, holds no image.
    """

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)
        self.lasts = self.until = 0.0  # s, by the header (0: unknown), and of the last image
        self.damaged = 0  # packets that could not be decoded
        self.captured: float | None = None  # images/s by the note of a phone; None: there is none
        if not self.path.is_file():
            raise VideoError(f"{path} does not exist")

    def __iter__(self) -> Iterator[VideoImage]:
        with self.path.open("rb") as file:
            timed = file.read(len(_JPEG_START)) != _JPEG_START
        image = None
        for image in self._images():
            self.until = max(self.until, image.seconds or 0.0)
            yield image if timed else image._replace(seconds=None)
        if image is None:
            raise VideoError(f"{self.path} holds no image that can be read")

    @property
    def fault(self) -> str | None:
        """Fault of a video with damaged or missing images: the end of a file is not believed."""
        if self.damaged:
            said = f"has {self.damaged} images that cannot be decoded"
        elif self.until + _LONGER < self.lasts:
            said = f"lasts {self.lasts:.1f} s by its header, and its images end at {self.until:.1f}"
        else:
            return None
        return f"{self.path.name} {said}: it is damaged or cut off"

    def _images(self) -> Iterator[VideoImage]:
        most = most_pixels(self.path.stat().st_size)
        with _container(self.path, most) as container:
            stream = _stream(container, most)
            stream.codec_context.options = {"max_pixels": str(most)}  # of images that follow
            stream.thread_type = "AUTO"
            timed = not container.format.flags & _NO_TIMES
            last = -np.inf
            self.captured = _captured(container.metadata)
            own = stream.duration  # None in Matroska, which says how long all streams last
            self.lasts = float(own * stream.time_base) if own else (container.duration or 0) * 1e-6
            for packet in container.demux(stream):
                for frame in self._decoded(packet):
                    seconds = float(frame.time) if timed and frame.time is not None else last
                    is_new, last = seconds > last, max(last, seconds)
                    yield compress_image(
                        frame.to_ndarray(format="bgr24"), seconds if is_new else None
                    )

    def _decoded(self, packet: Any) -> list[Any]:
        """Decode the images of a packet; a damaged one has none."""
        import av

        try:
            return list(packet.decode())
        except av.FFmpegError:
            self.damaged += 1
            return []


# FFmpeg's AVFMT_NOTIMESTAMPS, of raw streams.
_NO_TIMES = 0x0080
# s that another stream, or the last image, may last.
_LONGER = 2.0


@contextlib.contextmanager
def _container(path: Path, most: int) -> Iterator[Any]:
    import av

    try:
        # FFmpeg decodes the first images as it opens a file.
        with av.open(str(path), options={"max_pixels": str(most)}) as container:
            yield container
    except (av.FFmpegError, ValueError, UnicodeDecodeError) as error:
        if isinstance(error, VideoError):
            raise
        raise VideoError(f"{path} cannot be read: {error}") from error


def _stream(container: Any, most: int) -> Any:
    """Return the first stream of images that has a decoder and at most this many pixels."""
    streams = [stream for stream in container.streams.video if stream.codec_context is not None]
    for stream in streams:
        if 0 < stream.width * stream.height <= most:
            return stream
    large = "".join(
        f": {stream.width} x {stream.height} are too much for a file of its size"
        for stream in streams[:1]
        if stream.width * stream.height > most
    )
    raise VideoError(f"{container.name} has no stream of images that can be decoded{large}")


def _captured(notes: Mapping[str, str]) -> float | None:
    """Return the images per second that a phone took; None if the file does not say."""
    try:
        rate = float(notes.get("com.android.capture.fps", "nan"))
    except ValueError:
        return None
    return rate if 0.0 < rate < np.inf else None


def has_times(path: Path | str) -> bool:
    """Return True for a video with presentation times; a single image needs none.

    Raises:
        VideoError: when it cannot be read.
    """
    first = list(itertools.islice(Video(path), 2))
    return first[-1].seconds is not None


def compress_image(color: Any, seconds: float | None) -> VideoImage:
    """Compress an image (h,w,3) or (h,w) of a video to the form that is kept: JPEG and grey."""
    _, jpeg = cv2.imencode(".jpg", color, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    grey = color if color.ndim == 2 else cv2.cvtColor(color, cv2.COLOR_BGR2GRAY)
    return VideoImage(jpeg.tobytes(), np.asarray(grey, np.uint8), seconds)
