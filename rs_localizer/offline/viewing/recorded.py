"""What a recording shows beside the poses: matches or keypoints, and images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.io.bags import BagReader
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.io.images import Gray, read_any_image
from rs_localizer.io.keypoints import read_keypoints
from rs_localizer.io.messages import MessageError, stamp_ns
from rs_localizer.io.topics import COMPRESSED_IMAGE, CORRESPONDENCES
from rs_localizer.offline.image_sources import image_topics
from rs_localizer.offline.replay import Topics

_MEDIA = {b"\xff\xd8": "image/jpeg", b"\x89P": "image/png"}


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """An image: compressed as it came where viewers can read that, else gray."""

    stamp_ns: int
    data: bytes | Gray
    media_type: str = ""  # of the bytes


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Where an image was matched, or has keypoints."""

    stamp_ns: int
    pixels: Array  # (n,2) raw
    points: Array  # (n,3) m, map; of keypoints (0,3)


def shown(bag: BagReader, topics: Topics) -> Iterator[Picture | Cloud]:
    """All that can be read of these."""
    matched = CORRESPONDENCES in topics.of
    pictures = _picture_topic(bag)
    wanted = [topics.frames, *([] if pictures is None else [pictures])]
    for topic, _, message in bag.messages(wanted):
        try:
            item = _picture(message) if topic == pictures else _cloud(message, matched)
        except MessageError:  # replay has refused it, too
            continue
        yield item


def _picture_topic(bag: BagReader) -> str | None:
    """The only one, or that of the name that ``detect --images`` gives; else none can be meant."""
    found = image_topics(bag)
    named = [topic for topic in found if topic.strip("/") == COMPRESSED_IMAGE]
    chosen = found if len(found) == 1 else named
    return chosen[0] if len(chosen) == 1 else None


def _picture(message: Any) -> Picture:
    stamp = stamp_ns(message)
    if hasattr(message, "format"):
        data = bytes(message.data)
        media_type = _MEDIA.get(data[:2], "")
        if media_type:
            return Picture(stamp, data, media_type)
    return Picture(stamp, read_any_image(message).pixels)


def _cloud(message: Any, matched: bool) -> Cloud:
    if matched:
        found = read_correspondences(message)
        return Cloud(found.stamp_ns, found.pixels, found.points)
    keypoints = read_keypoints(message)
    return Cloud(keypoints.stamp_ns, keypoints.pixels, np.zeros((0, 3)))
