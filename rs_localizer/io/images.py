# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""sensor_msgs/Image and CompressedImage -> gray images, raw rows where the sensor has them.

50 megapixels work, they only take long. A compressed image may be small and its pixels many: what
its header says is held against a limit before anything is decoded.
"""

import math
import struct
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rs_localizer.io.messages import MessageError, stamp_ns

Gray = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class _Encoding:
    channels: int  # per pixel, in the message
    kind: str  # NumPy's code of a channel, without byte order
    to_gray: int = -1  # OpenCV's conversion
    luma: int | None = None  # the channel that is gray already
    planes: float = 1.0  # bytes of the whole image, in those of its first plane


def _encodings() -> dict[str, _Encoding]:
    table = {
        "mono8": _Encoding(1, "u1", luma=0),
        "8UC1": _Encoding(1, "u1", luma=0),
        "mono16": _Encoding(1, "u2", luma=0),
        "16UC1": _Encoding(1, "u2", luma=0),
        "8UC3": _Encoding(3, "u1", cv2.COLOR_BGR2GRAY),
        "8UC4": _Encoding(4, "u1", cv2.COLOR_BGRA2GRAY),
        # Two bytes per pixel, of which one is the brightness.
        **dict.fromkeys(("yuv422", "uyvy"), _Encoding(2, "u1", luma=1)),
        **dict.fromkeys(("yuv422_yuy2", "yuyv"), _Encoding(2, "u1", luma=0)),
        # Planes, as of libcamera's drivers: the brightness comes first.
        **dict.fromkeys(
            ("nv12", "nv21", "yuv420", "i420", "yv12"), _Encoding(1, "u1", luma=0, planes=1.5)
        ),
        "nv24": _Encoding(1, "u1", luma=0, planes=3.0),
    }
    for bits, kind in ((8, "u1"), (16, "u2")):
        table[f"bgr{bits}"] = _Encoding(3, kind, cv2.COLOR_BGR2GRAY)
        table[f"rgb{bits}"] = _Encoding(3, kind, cv2.COLOR_RGB2GRAY)
        table[f"bgra{bits}"] = _Encoding(4, kind, cv2.COLOR_BGRA2GRAY)
        table[f"rgba{bits}"] = _Encoding(4, kind, cv2.COLOR_RGBA2GRAY)
        # ROS names the first two pixels of the first two rows, OpenCV the next ones in its second.
        table[f"bayer_rggb{bits}"] = _Encoding(1, kind, cv2.COLOR_BayerBG2GRAY)
        table[f"bayer_bggr{bits}"] = _Encoding(1, kind, cv2.COLOR_BayerRG2GRAY)
        table[f"bayer_gbrg{bits}"] = _Encoding(1, kind, cv2.COLOR_BayerGR2GRAY)
        table[f"bayer_grbg{bits}"] = _Encoding(1, kind, cv2.COLOR_BayerGB2GRAY)
    return table


_ENCODINGS = _encodings()

# Name, start and end of what can be decompressed.
_FORMATS = (("JPEG", b"\xff\xd8", b"\xff\xd9"), ("PNG", b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"))
# Pixels per byte: of a dark scene, compressed much, and beside that of an image that is all alike.
# One bit per pixel comes to 8000, and a JPEG to 500, which takes 3 bytes each to decode.
_DENSEST, _ALIKE = 32, 4_000_000
_MOST_PIXELS = 150_000_000  # of a camera; a decoded one takes 8 bytes at most
# Chunks that a grey image depends on; PNG (third edition), section 5.6.
_STILL_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
# JPEG's markers of frames, by which the size is given.
_FRAME_HEADERS = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
_ALONE = {0x01, *range(0xD0, 0xD8)}  # all other markers of JPEG are followed by their length
# The range of 16-bit pixels is taken from this many, between these percentiles.
_LOOKED_AT, _RANGE = 100_000, (0.1, 99.9)
_LEVELS = 64  # of eight bits, that an image needs
# Raw rows: a camera's note that the picture should be shown upright turns the shutter, too.
_AS_IT_IS = cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH


@dataclass(frozen=True, slots=True, eq=False)
class Image:
    """A gray image of a message."""

    stamp_ns: int
    frame: str  # the camera's optical frame, or what the message says of it
    pixels: Gray  # (h,w)


def most_pixels(packed: int) -> int:
    """Return the most pixels that an image of this many packed bytes may have."""
    return min(_ALIKE + _DENSEST * packed, _MOST_PIXELS)


def read_image(message: Any) -> Image:
    """Read a sensor_msgs/Image, or a CompressedImage: JPEG or PNG.

    Raises:
        MessageError: when it cannot be read, saying what was found.
    """
    if hasattr(message, "format"):
        pixels = decode_image(bytes(message.data), str(message.format))
    else:
        pixels = _raw_pixels(message)
    return Image(stamp_ns(message), str(message.header.frame_id), pixels)


def _raw_pixels(message: Any) -> Gray:
    """Return the gray pixels of a sensor_msgs/Image."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    name = str(message.encoding)
    encoding = _ENCODINGS.get(name)
    if encoding is None:
        raise MessageError(
            f"the encoding {name!r} is not supported; supported are {', '.join(_ENCODINGS)}"
        )
    if width == 0 or height == 0:
        raise MessageError(f"the image has no pixels: width {width}, height {height}")
    kind = np.dtype((">" if message.is_bigendian else "<") + encoding.kind)
    pixel = encoding.channels * kind.itemsize
    row = width * pixel
    step = step or row  # some drivers leave it out
    if step < row:
        raise MessageError(f"step is {step}, too small for {width} pixels of {name}: {row} bytes")
    expected = (height - 1) * step + row
    if encoding.planes > 1.0:
        expected = max(expected, int(encoding.planes * height * width))
    if len(message.data) < expected:
        raise MessageError(
            f"the data are truncated: {width} x {height} pixels of {name} take {expected} bytes, "
            f"found {len(message.data)}"
        )
    shape = height, width, encoding.channels
    raw: NDArray[Any] = np.ndarray(shape, kind, message.data, strides=(step, pixel, kind.itemsize))
    if encoding.luma is not None:
        return _eight_bits(raw[:, :, encoding.luma])
    single = raw[:, :, 0] if encoding.channels == 1 else raw
    native = np.ascontiguousarray(single, single.dtype.newbyteorder("="))
    return _eight_bits(np.asarray(cv2.cvtColor(native, encoding.to_gray)))


def decode_image(packed: bytes, format_: str) -> Gray:
    """Decode the pixels (h,w) of a JPEG or PNG; ``format_`` is the format that is claimed.

    Raises:
        MessageError: for anything else, or an image that is truncated or damaged.
    """
    data = np.frombuffer(packed, np.uint8)
    start = data[:8].tobytes()
    formats = [item for item in _FORMATS if start.startswith(item[1])]
    if not formats:
        raise MessageError(
            f"the compressed image is neither JPEG nor PNG: its format is {format_!r} "
            f"and its {len(data)} bytes start with {start.hex(' ') or 'nothing'}"
        )
    name, _, end = formats[0]
    # OpenCV fills what is missing with gray and says nothing. Zeros may follow, of whole buffers.
    if not packed.rstrip(b"\0").endswith(end):
        raise MessageError(f"the {name} image is truncated: its {len(data)} bytes have no end mark")
    size = _claimed_size(packed, name)
    if size is None:
        raise MessageError(
            f"the {name} image of {len(data)} bytes cannot be decoded: no header has its size"
        )
    if math.prod(size) > most_pixels(len(data)):
        raise MessageError(
            f"the {name} image says that it is {size[0]} x {size[1]}, too much for {len(data)} "
            f"bytes, or more than {_MOST_PIXELS // 1_000_000} megapixels"
        )
    if name == "PNG":
        data = np.frombuffer(_still_png(packed), np.uint8)
    try:
        decoded = cv2.imdecode(data, _AS_IT_IS)
    except cv2.error as error:
        raise MessageError(f"the {name} image cannot be decoded: {error}") from error
    if decoded is None:
        raise MessageError(f"the {name} image of {len(data)} bytes cannot be decoded")
    return _eight_bits(np.asarray(decoded))


def _claimed_size(data: bytes, name: str) -> tuple[int, int] | None:
    """Return width and height of the header, which the decoder allocates; None: not found."""
    if name == "PNG":
        return struct.unpack_from(">II", data, 16) if len(data) >= 24 else None
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        marker, length = data[position + 1], int.from_bytes(data[position + 2 : position + 4])
        if marker in _FRAME_HEADERS:
            height, width = struct.unpack_from(">HH", data, position + 5)
            return width, height
        # Markers may be filled up with more of 0xFF.
        position += 1 if marker == 0xFF else 2 if marker in _ALONE else 2 + length
    return None


def _still_png(data: bytes) -> bytes:
    """Return the chunks of a still image; damaged ones of animations crash OpenCV 5.0.

    Raises:
        MessageError: when a chunk is longer than the data; the decoder allocates what it claims.
    """
    chunks, position, kind = [data[:8]], 8, b""
    while position + 12 <= len(data) and kind != b"IEND":
        start, kind = position, data[position + 4 : position + 8]
        position += 12 + int.from_bytes(data[position : position + 4])
        if kind in _STILL_CHUNKS:
            chunks.append(data[start:position])
    if position > len(data) or kind != b"IEND":
        raise MessageError(f"the PNG image of {len(data)} bytes has a chunk that is longer than it")
    return b"".join(chunks)


def _eight_bits(image: NDArray[Any]) -> Gray:
    """Reduce sixteen bits to the upper eight that are used, as sensors fill 10 or 12.

    Where those have few values, as of a thermal image, or beside a pixel that is always bright,
    all between nearly the darkest and nearly the brightest one; none is spread over several.
    """
    if image.dtype.itemsize == 1:
        return np.ascontiguousarray(image, np.uint8)
    step = max(1, math.isqrt(image.size // _LOOKED_AT))
    low, high = np.percentile(image[::step, ::step], _RANGE)
    unused = max(0, int(image.max()).bit_length() - 8)
    if not _LEVELS <= high - low < _LEVELS << unused:
        return np.ascontiguousarray(image >> unused, np.uint8)
    scaled = image.astype(np.float32)  # in place from here on: of 150 megapixels
    scaled -= low
    scaled *= 255.0 / max(255.0, high - low)
    return np.asarray(np.clip(scaled, 0.0, 255.0, out=scaled), np.uint8)
