"""The images of a sparse model of COLMAP, from ``images.bin`` or ``images.txt``."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path

from rs_localizer.io.maps.landmarks import MapError

# Number, quaternion, translation, number of the camera; then the name, ended by a zero.
_IMAGE = struct.Struct("<I7dI")
_COUNT = struct.Struct("<Q")
_FEATURE_BYTES = 24  # x, y and the number of the point
_FEATURE_WORDS = 3


@dataclass(frozen=True, slots=True)
class ModelImage:
    """An image of a model."""

    number: int
    features: int  # 0: the model does not list them


def read_images(folder: Path) -> dict[str, ModelImage]:
    """A model's images by their names.

    Raises:
        MapError: for anything that is not a model, OSError as any file.
    """
    binary, text = folder / "images.bin", folder / "images.txt"
    if binary.exists():
        found = _read_binary(binary.read_bytes())
    elif text.exists():
        found = _read_text(text)
    else:
        raise MapError(f"{folder} has neither {binary.name} nor {text.name}")
    if not found:
        raise MapError(f"the model in {folder} has no images")
    return found


def _read_binary(data: bytes) -> dict[str, ModelImage]:
    found: dict[str, ModelImage] = {}
    try:
        (count,) = _COUNT.unpack_from(data)
        position = _COUNT.size
        for _ in range(count):
            number = _IMAGE.unpack_from(data, position)[0]
            start = position + _IMAGE.size
            end = data.index(0, start)
            (features,) = _COUNT.unpack_from(data, end + 1)
            found[data[start:end].decode("utf-8")] = ModelImage(number, features)
            position = end + 1 + _COUNT.size + features * _FEATURE_BYTES
    except (struct.error, ValueError, OverflowError):  # ValueError also where a name is no text
        position = len(data) + 1
    if position > len(data):
        raise MapError("images.bin is truncated or damaged")
    return found


def _read_text(path: Path) -> dict[str, ModelImage]:
    found: dict[str, ModelImage] = {}
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line[:1] != "#"]
    # Every second line lists the features of an image, and may be empty.
    for line, features in zip_longest(lines[::2], lines[1::2], fillvalue=""):
        words = line.split(maxsplit=9)
        if not words:
            continue
        try:
            if len(words) != 10:
                raise ValueError
            count = len(features.split()) // _FEATURE_WORDS
            found[words[9]] = ModelImage(int(words[0]), count)
        except ValueError:
            raise MapError(
                f"images.txt: expected ID QW QX QY QZ TX TY TZ CAMERA NAME, found {line[:80]!r}"
            ) from None
    return found
