# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""PointCloud2 <-> structured arrays, and correspondences.

Fields are looked up by name and may lie anywhere in a row; unknown ones are ignored. The data are
read in place through a NumPy structured view, whatever their padding and byte order.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.io.maps.landmarks import Descriptors, Ids, Map, MapError, make_map
from rs_localizer.io.messages import Make, MessageError, frame_id, make_header, stamp_ns

# sensor_msgs/PointField: the number of a type and its NumPy code.
_FORMATS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_NAMES = {number: np.dtype(code).name.upper() for number, code in _FORMATS.items()}
_NUMBERS = {np.dtype(code): number for number, code in _FORMATS.items()}
# Types that each known field may have; a name means the same in every cloud.
_TYPES = dict.fromkeys(("x", "y", "z", "u", "v", "score"), (7, 8)) | {
    "id": (1, 2, 3, 4, 5, 6),
    "descriptor": (2, 7),
}
_ARRAYS = ("descriptor",)  # several values per point
# NumPy has no larger rows.
_LONGEST_ROW = 2**31 - 1
# Points that a cell of the grid holds on average, over which they are spread.
_PER_CELL = 8

Field = tuple[str, int, int, int]  # name, offset, datatype, count


class EmptyCloudError(MessageError):
    """A well-formed cloud without a single point."""


@dataclass(frozen=True, slots=True, eq=False)
class Correspondences:
    """The usable rows of a cloud: map points and where the raw image shows them."""

    stamp_ns: int  # of the image
    frame: str  # in which the points are given
    points: Array  # (n,3) m
    pixels: Array  # (n,2) raw (distorted) pixels, centre of the first pixel at 0, 0
    scores: Array | None  # (n,) higher is better
    dropped: int  # rows that held NaN or infinity
    table: NDArray[Any]  # (n,) structured: the known fields of these rows as they came


def read_correspondences(message: Any) -> Correspondences:
    """Read a sensor_msgs/PointCloud2 with x, y, z, u, v and optional score and id.

    Rows with a value that is not finite are dropped and counted.

    Raises:
        EmptyCloudError: for a cloud without points.
        MessageError: for anything that cannot be read, saying what was found.
    """
    frame = frame_id(message, "the frame of x, y, z")
    rows = _read_rows(message, ("x", "y", "z", "u", "v"), ("score", "id"))
    points, pixels = rows.columns("x", "y", "z"), rows.columns("u", "v")
    scores = rows.values.get("score")
    return Correspondences(
        stamp_ns(message), frame, points, pixels, scores, rows.dropped, rows.table
    )


def thin_cloud(cloud: Correspondences, most: int, size: tuple[int, int]) -> Correspondences:
    """Return the cloud with at most ``most`` rows, in their order.

    Those with the best scores; without scores, as many of each part of the image as there are.

    Args:
        size: width and height of the image, px.
    """
    if len(cloud.points) <= most:
        return cloud
    if cloud.scores is not None:
        chosen = np.sort(np.argsort(-cloud.scores, kind="stable")[:most])
    else:
        chosen = choose_balanced(cloud.pixels, np.zeros(len(cloud.points)), size, most)
    return replace(
        cloud,
        points=cloud.points[chosen],
        pixels=cloud.pixels[chosen],
        scores=None if cloud.scores is None else cloud.scores[chosen],
        table=cloud.table[chosen],
    )


def choose_balanced(pixels: Array, scores: Array, size: tuple[int, int], most: int) -> IntArray:
    """Return rows (k,) of the best pixels of each cell of a grid, then of the second best ...

    Args:
        pixels: (n,2)
        scores: (n,) higher is better.
        size: width and height of the image.
        most: how many to keep.
    """
    count = len(pixels)
    if count <= most:
        return np.arange(count)
    side = np.sqrt(size[0] * size[1] * _PER_CELL / most)
    columns, rows = (np.clip(pixels, 0.0, size) // side).astype(np.int64).T
    cells = rows * (int(size[0] // side) + 1) + columns
    order = np.lexsort((-scores, cells))
    ranks = np.arange(count) - np.searchsorted(cells[order], cells[order])
    return np.sort(order[np.lexsort((-scores[order], ranks))[:most]])


@dataclass(frozen=True, slots=True, eq=False)
class _Rows:
    """The rows of a cloud without NaN and infinity in the fields that were asked for."""

    table: NDArray[Any]  # (n,) structured: these fields as they came
    dropped: int  # rows that held NaN or infinity
    values: dict[str, Array]  # (n,) of each field of one real number

    def columns(self, *names: str) -> Array:
        """Return fields of one real number each as an array (n, len(names))."""
        return np.stack([self.values[name] for name in names], axis=1)


def _read_rows(message: Any, required: Sequence[str], optional: Sequence[str]) -> _Rows:
    """Return the rows of a sensor_msgs/PointCloud2 with these fields, without unusable rows."""
    table = _view(message, required, optional)
    values: dict[str, Array] = {}
    finite = np.ones(len(table), dtype=np.bool_)
    for name, (kind, *_) in (table.dtype.fields or {}).items():
        if kind.base.kind != "f":
            continue
        if name in _ARRAYS:
            finite &= np.isfinite(table[name].reshape(len(table), -1)).all(axis=1)
        else:
            with np.errstate(invalid="ignore"):  # a signaling NaN warns when it is converted
                values[name] = table[name].astype(np.float64)
            finite &= np.isfinite(values[name])
    dropped = len(table) - int(np.count_nonzero(finite))
    if dropped:
        values, table = {name: column[finite] for name, column in values.items()}, table[finite]
    return _Rows(table, dropped, values)


def _view(message: Any, required: Sequence[str], optional: Sequence[str]) -> NDArray[Any]:
    """Return the known fields of a cloud as a structured array (n,) over the message's own data."""
    width, height = int(message.width), int(message.height)
    point_step, row_step = int(message.point_step), int(message.row_step)
    if width == 0 or height == 0:
        raise EmptyCloudError(f"the cloud has no points: width {width}, height {height}")
    if height == 1:
        row_step = width * point_step  # some publishers leave it at 0
    elif row_step < width * point_step:
        raise MessageError(
            f"row_step is {row_step}, too small for {width} points of {point_step} bytes"
        )
    # Sizes are Python integers here: a message can claim 2^64 points.
    expected = (height - 1) * row_step + width * point_step
    if len(message.data) < expected:
        raise MessageError(
            f"the data are truncated: {width} x {height} points of {point_step} bytes take "
            f"{expected} bytes, found {len(message.data)}"
        )
    names = [str(item.name) for item in message.fields]
    if missing := [name for name in required if name not in names]:
        raise MessageError(
            f"the cloud has no field {', '.join(missing)}; found {', '.join(names) or 'none'}"
        )
    fields = tuple(
        (str(item.name), int(item.offset), int(item.datatype), int(item.count))
        for item in message.fields
        if item.name in (*required, *optional)
    )
    row_type = _row_type(fields, point_step, bool(message.is_bigendian))
    rows: NDArray[Any] = np.ndarray(
        (height, width), row_type, message.data, strides=(row_step, point_step)
    )
    return rows.reshape(-1)


@lru_cache(maxsize=16)
def _row_type(fields: tuple[Field, ...], point_step: int, big_endian: bool) -> np.dtype[Any]:
    """Return the structured type of one row; a camera's clouds all have the same."""
    if point_step > _LONGEST_ROW:
        raise MessageError(f"point_step is {point_step}, more than {_LONGEST_ROW}")
    names = [field[0] for field in fields]
    order = ">" if big_endian else "<"
    codes: list[Any] = []
    for name, offset, number, count in fields:
        if names.count(name) > 1:
            raise MessageError(f"the cloud has {names.count(name)} fields {name!r}")
        if number not in _TYPES[name]:
            allowed = ", ".join(_NAMES[allowed] for allowed in _TYPES[name])
            actual = _NAMES.get(number, f"the unknown type {number}")
            raise MessageError(f"field {name!r} must be one of {allowed}; found {actual}")
        count = count or 1  # 0 is an old way to write 1
        if count > 1 and name not in _ARRAYS:
            raise MessageError(f"field {name!r} must hold one value, found {count}")
        code = np.dtype(order + _FORMATS[number])
        end = offset + count * code.itemsize
        if end > point_step:
            raise MessageError(f"point_step is {point_step}, but field {name!r} ends at byte {end}")
        codes.append((code, (count,)) if name in _ARRAYS else code)
    offsets = [field[1] for field in fields]
    return np.dtype({"names": names, "formats": codes, "offsets": offsets, "itemsize": point_step})


def select_inliers(table: NDArray[Any], inliers: NDArray[np.bool_], residuals: Array) -> Any:
    """Return packed little-endian rows (k,) of the inliers in a cloud's table, with residuals.

    Args:
        table: (n,) :attr:`Correspondences.table`.
        inliers: (n,) which rows to keep.
        residuals: (n,) px.
    """
    rows = np.flatnonzero(inliers)
    kept = [table[name][rows] for name in table.dtype.names or ()]
    return make_rows(_packed(table.dtype), [*kept, residuals[rows]])


@lru_cache(maxsize=16)
def _packed(row_type: np.dtype[Any]) -> np.dtype[Any]:
    fields: Mapping[str, Any] = row_type.fields or {}
    return np.dtype([(n, fields[n][0].newbyteorder("<")) for n in fields] + [("residual", "<f4")])


def make_rows(kinds: Any, columns: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Return packed rows (k,) of these fields (a dtype), from a column (k,...) of each."""
    rows = np.empty(len(columns[0]), kinds)
    for name, column in zip(rows.dtype.names or (), columns, strict=True):
        rows[name] = column
    return rows


def point_fields(kind: str) -> list[tuple[str, str]]:
    """Return the fields of a cloud of markers' corners, with coordinates of this type."""
    pixels = [("u", "<f4"), ("v", "<f4"), ("score", "<f4"), ("id", "<u4")]
    return [*((name, kind) for name in "xyz"), *pixels]


def make_cloud(make: Make, stamp: int, frame: str, rows: NDArray[Any]) -> Any:
    """Make a sensor_msgs/PointCloud2 of packed little-endian rows (k,)."""
    row_type = rows.dtype
    fields = [
        make(
            "sensor_msgs/msg/PointField",
            name=name,
            offset=offset,
            datatype=_NUMBERS[kind.base.newbyteorder("=")],
            count=math.prod(kind.shape),
        )
        for name, (kind, offset, *_) in (row_type.fields or {}).items()
    ]
    return make(
        "sensor_msgs/msg/PointCloud2",
        header=make_header(make, stamp, frame),
        height=1,
        width=len(rows),
        fields=fields,
        is_bigendian=False,
        point_step=row_type.itemsize,
        row_step=row_type.itemsize * len(rows),
        data=np.ascontiguousarray(rows).view(np.uint8),
        is_dense=True,
    )


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
    rows = _read_rows(message, ("u", "v"), ("id", "descriptor", "score"))
    marks, scores = _marks(rows, message), rows.values.get("score")
    return Keypoints(stamp_ns(message), rows.columns("u", "v"), *marks, scores, rows.dropped)


def read_map(message: Any) -> Map:
    """Read a sensor_msgs/PointCloud2 with x, y, z, and id and/or descriptor.

    Raises:
        EmptyCloudError: for a cloud without points.
        MessageError: for anything that cannot be read, saying what was found.
    """
    frame = frame_id(message, "the frame of x, y, z")
    rows = _read_rows(message, ("x", "y", "z"), ("id", "descriptor"))
    try:
        landmarks = make_map(rows.columns("x", "y", "z"), *_marks(rows, message), frame)
        return replace(landmarks, dropped=rows.dropped)
    except MapError as error:
        raise MessageError(str(error)) from error


def _marks(rows: _Rows, message: Any) -> tuple[Ids | None, Descriptors | None]:
    """Return ids (n,) and descriptors (n,d) by which the points are recognized."""
    known = rows.table.dtype.names or ()
    if not {"id", "descriptor"} & set(known):
        names = ", ".join(str(item.name) for item in message.fields)
        raise MessageError(f"the cloud has neither a field id nor descriptor; found {names}")
    ids = rows.table["id"].astype(np.int64) if "id" in known else None
    if "descriptor" not in known:
        return ids, None
    descriptors = rows.table["descriptor"]
    native = descriptors.dtype.newbyteorder("=")
    width = math.prod(descriptors.shape[1:])  # also without a row left
    return ids, np.ascontiguousarray(descriptors.reshape(len(descriptors), width), dtype=native)
