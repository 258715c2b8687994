# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Image files as a bag holds images: JPEG and PNG as they are, what else OpenCV reads as PNG."""

import io
import warnings
from pathlib import Path

import cv2
import numpy as np

from rs_localizer.io.images import check_size
from rs_localizer.io.messages import MessageError

_AS_THEY_ARE = {".jpg": "jpeg", ".jpeg": "jpeg", ".png": "png"}
_PACKED_ANEW = (".webp", ".tif", ".tiff", ".pgm", ".ppm", ".bmp", ".avif", ".jp2")
SUFFIXES = (*_AS_THEY_ARE, *_PACKED_ANEW)
"""Ends of names of files that are read."""

_PHOTOS = "heif-convert of libheif"
_RAW = "darktable-cli"
FOREIGN = {
    **dict.fromkeys((".heic", ".heif"), _PHOTOS),
    **dict.fromkeys((".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"), _RAW),
    ".jxl": "djxl of libjxl", ".gif": "ffmpeg",
}  # fmt: skip
"""Ends of names of images that are not read: a program that converts them."""

# Raw rows: a camera's note that the picture should be shown upright turns the shutter, too.
_ORIENTATION = 0x0112  # TIFF 6.0; OpenCV 5.0 follows it in TIFF files whatever it is told
_AS_IT_IS = cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION


def packed_image(file: Path) -> tuple[bytes, str]:
    """Return the bytes of a JPEG or PNG and its format, as of a sensor_msgs/CompressedImage.

    Raises:
        MessageError: for what OpenCV cannot decode, or would decode to too much.
    """
    suffix, data = file.suffix.lower(), file.read_bytes()
    if suffix in _AS_THEY_ARE:
        return data, _AS_THEY_ARE[suffix]
    check_size(_claimed_size(data), len(data), "it")
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), _AS_IT_IS)
    except cv2.error as error:
        raise MessageError(f"it cannot be decoded: {error}") from error
    if decoded is None:
        raise MessageError(
            f"this OpenCV decodes no such {suffix}, or it is damaged: convert it to PNG"
        )
    if decoded.dtype not in (np.uint8, np.uint16):
        raise MessageError(f"its pixels are {decoded.dtype}, not of 8 or 16 bits")
    _, png = cv2.imencode(".png", decoded, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    return png.tobytes(), "png"


def _claimed_size(data: bytes) -> tuple[int, int]:
    """Return width and height of the header, which a decoder allocates at once.

    Raises:
        MessageError: when it cannot be read, or turns the image.
    """
    from PIL import Image  # only those who have such files need it

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of tags, and of many pixels
            with Image.open(io.BytesIO(data)) as header:
                size, turned = header.size, header.getexif().get(_ORIENTATION, 1)
    except Image.DecompressionBombError as error:
        raise MessageError(str(error)) from error
    except (OSError, ValueError, SyntaxError) as error:
        raise MessageError(f"it has no header that can be read: {error}") from error
    if header.format == "TIFF" and turned != 1:
        raise MessageError(
            f"its note to turn the image (Orientation {turned}), which OpenCV follows, hides the "
            "rows of the sensor: set it to 1 (exiftool -Orientation#=1 FILE)"
        )
    return size
