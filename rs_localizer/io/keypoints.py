# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""PointCloud2 -> keypoints, and -> a map."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.io.clouds import Rows, read_rows
from rs_localizer.io.maps.landmarks import Descriptors, Ids, Map, MapError, make_map
from rs_localizer.io.messages import MessageError, frame_id, stamp_ns


@dataclass(frozen=True, slots=True, eq=False)
class Keypoints:
    """The usable rows of a cloud: where the raw image shows something, and what."""

    stamp_ns: int  # of the image
    pixels: Array  # (n,2) raw (distorted) pixels, centre of the first pixel at 0, 0
    ids: Ids | None  # (n,) of landmarks
    descriptors: Descriptors | None  # (n,d)
    scores: Array | None  # (n,) higher is better
    dropped: int  # rows that held NaN or infinity

    def __len__(self) -> int:
        return len(self.pixels)


def read_keypoints(message: Any) -> Keypoints:
    """Read a sensor_msgs/PointCloud2 with u, v, id and/or descriptor, and optional score.

    Raises:
        EmptyCloudError: for a cloud without points.
        MessageError: for anything that cannot be read, saying what was found.
    """
    rows = read_rows(message, ("u", "v"), ("id", "descriptor", "score"))
    ids, descriptors = _marks(rows, message)
    return Keypoints(
        stamp_ns=stamp_ns(message),
        pixels=rows.columns("u", "v"),
        ids=ids,
        descriptors=descriptors,
        scores=rows.columns("score")[:, 0] if rows.has("score") else None,
        dropped=rows.dropped,
    )


def read_map(message: Any) -> Map:
    """Read a sensor_msgs/PointCloud2 with x, y, z, and id and/or descriptor.

    Raises:
        EmptyCloudError: for a cloud without points.
        MessageError: for anything that cannot be read, saying what was found.
    """
    frame = frame_id(message, "the frame of x, y, z")
    rows = read_rows(message, ("x", "y", "z"), ("id", "descriptor"))
    ids, descriptors = _marks(rows, message)
    try:
        landmarks = make_map(rows.columns("x", "y", "z"), ids, descriptors, frame)
        return Map(landmarks.points, landmarks.ids, landmarks.descriptors, frame, rows.dropped)
    except MapError as error:
        raise MessageError(str(error)) from error


def _marks(rows: Rows, message: Any) -> tuple[Ids | None, Descriptors | None]:
    """What the points are recognized by: ids (n,), descriptors (n,d)."""
    if not rows.has("id") and not rows.has("descriptor"):
        names = ", ".join(str(item.name) for item in message.fields)
        raise MessageError(f"the cloud has neither a field id nor descriptor; found {names}")
    ids = rows.table["id"].astype(np.int64) if rows.has("id") else None
    if not rows.has("descriptor"):
        return ids, None
    descriptors = rows.table["descriptor"]
    native = descriptors.dtype.newbyteorder("=")
    width = math.prod(descriptors.shape[1:])  # also without a row left
    return ids, np.ascontiguousarray(descriptors.reshape(len(descriptors), width), dtype=native)
