# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Clouds of every layout are read; those that cannot be are refused with what was found."""

import array
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rs_localizer.io.bags import make_message
from rs_localizer.io.clouds import (
    make_cloud,
    read_correspondences,
    read_keypoints,
    read_map,
    select_inliers,
    thin_cloud,
)
from rs_localizer.io.messages import MessageError

PLAIN = [(name, 4 * i, 7) for i, name in enumerate("xyzuv")]
# Exact in single precision.
ROWS = [[0.5 * i, -i, 2.0 + i, 100.25 + i, 200.5 - i] for i in range(12)]


@pytest.fixture
def cloud(make_cloud_message) -> SimpleNamespace:
    return make_cloud_message(ROWS, PLAIN, point_step=20)


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(("height", "row_padding"), [(1, 5), (4, 7)])
@pytest.mark.parametrize("id_type", [1, 2, 3, 4, 5, 6])
def test_any_layout(make_cloud_message, big_endian, height, row_padding, id_type):
    # Mixed types at odd offsets in no order, gaps, and unknown fields among them.
    fields = [
        ("id", 0, id_type), ("v", 5, 8), ("rgb", 13, 6), ("x", 17, 7), ("u", 31, 8),
        ("score", 21, 7 + id_type % 2), ("intensity", 39, 3), ("z", 41, 7), ("y", 45, 8),
    ]  # fmt: skip
    rows = [[i, r[4], 7, r[0], r[3], 0.25 * i, -9, r[2], r[1]] for i, r in enumerate(ROWS)]
    message = make_cloud_message(
        rows, fields, point_step=57, height=height, row_padding=row_padding, big_endian=big_endian
    )
    for data in (message.data, array.array("B", message.data.tobytes())):  # rosbags, rclpy
        message.data = data
        read = read_correspondences(message)
        assert (read.stamp_ns, read.frame, read.dropped) == (5_000_000_007, "map", 0)
        assert read.points.tolist() == [row[:3] for row in ROWS]
        assert read.pixels.tolist() == [row[3:] for row in ROWS]
        assert read.scores.tolist() == [0.25 * i for i in range(12)]
        assert read.table["id"].tolist() == list(range(12))
        assert set(read.table.dtype.names) == {"x", "y", "z", "u", "v", "score", "id"}


@pytest.mark.parametrize(("column", "bad"), [(0, np.nan), (2, np.inf), (4, -np.inf), (5, np.nan)])
def test_rows_that_are_not_finite_are_dropped_and_counted(make_cloud_message, column, bad):
    rows = [[*row, 1.0] for row in ROWS]
    rows[3][column] = rows[7][column] = bad
    read = read_correspondences(make_cloud_message(rows, [*PLAIN, ("score", 20, 8)], point_step=28))
    kept = [i for i in range(12) if i not in (3, 7)]
    assert read.dropped == 2
    assert read.points.tolist() == [ROWS[i][:3] for i in kept]
    assert len(read.pixels) == len(read.scores) == len(read.table) == 10


def test_a_signaling_nan_is_dropped_silently(cloud):
    data = cloud.data.copy()
    data[20:24] = np.array([0x7F800001], "<u4").view(np.uint8)
    cloud.data = data
    read = read_correspondences(cloud)
    assert (read.dropped, read.scores) == (1, None)


@pytest.mark.parametrize(
    ("of_message", "of_field", "text"),
    [
        ({"data": np.zeros(239, np.uint8)}, {}, "truncated.* 240 bytes, found 239"),
        ({"width": 2**32 - 1, "height": 2**32 - 1, "point_step": 2**32 - 1}, {},
         "row_step is 240, too small for 4294967295 points of 4294967295 bytes"),
        ({"fields": []}, {}, "no field x, y, z, u, v; found none"),
        ({}, {"datatype": 5}, "'v' must be one of FLOAT32, FLOAT64; found INT32"),
        ({}, {"offset": 2**32 - 1}, "'v' ends at byte 4294967299"),
        ({"header": SimpleNamespace(frame_id="")}, {},
         "header.frame_id is empty; it must name the frame of x, y, z"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_said(cloud, of_message, of_field, text):
    vars(cloud.fields[4]).update(of_field)
    vars(cloud).update(of_message)
    with pytest.raises(MessageError, match=text):
        read_correspondences(cloud)


@pytest.mark.parametrize("big_endian", [False, True])
def test_inliers_keep_their_fields_and_types(make_cloud_message, big_endian):
    fields = [("u", 0, 7), ("v", 4, 7), ("x", 8, 8), ("y", 16, 8), ("z", 24, 7), ("id", 29, 4)]
    rows = [[r[3], r[4], r[0] + 1e-9, r[1], r[2], 1000 * i] for i, r in enumerate(ROWS)]
    message = make_cloud_message(rows, fields, point_step=40, big_endian=big_endian)
    inliers = np.zeros(12, dtype=bool)
    inliers[[2, 5, 11]] = True
    table = read_correspondences(message).table
    kept = select_inliers(table, inliers, 0.125 * np.arange(12.0))
    result = make_cloud(make_message, 3_000_000_004, "hall", kept)

    assert (result.header.stamp.sec, result.header.stamp.nanosec) == (3, 4)
    assert result.header.frame_id == "hall"
    assert (result.width, result.row_step) == (3, 3 * result.point_step)
    types = {field.name: (field.datatype, field.count) for field in result.fields}
    assert types == {name: (number, 1) for name, _, number in fields} | {"residual": (7, 1)}
    again = read_correspondences(result)
    assert again.points.tolist() == [[rows[i][2], rows[i][3], rows[i][4]] for i in (2, 5, 11)]
    assert again.pixels.tolist() == [ROWS[i][3:] for i in (2, 5, 11)]
    assert again.table["id"].tolist() == [2000, 5000, 11000]
    offset = next(field.offset for field in result.fields if field.name == "residual")
    raw = result.data.tobytes()
    residuals = [np.frombuffer(raw, "<f4", 1, offset + i * result.point_step)[0] for i in range(3)]
    assert residuals == [0.25, 0.625, 1.375]


def test_of_many_points_the_best_are_kept_in_their_order(make_cloud_message):
    rows = [[*row, score] for row, score in zip(ROWS, [3, 9, 1, 8, 7] * 3, strict=False)]
    fields = [*PLAIN, ("score", 20, 7)]
    read = read_correspondences(make_cloud_message(rows, fields, point_step=24))
    assert thin_cloud(read, 12, (640, 480)) is read
    few = thin_cloud(read, 4, (640, 480))
    assert few.scores.tolist() == [9, 8, 9, 9]  # of the eights, the first one
    assert few.points[:, 0].tolist() == [0.5, 1.5, 3.0, 5.5]
    assert len(few.table) == len(few.pixels) == 4


def test_without_scores_each_part_of_the_image_keeps_as_many(make_cloud_message):
    crowd = [[0.0, 0.0, 1.0, 10.0, 10.0]] * 200
    spread = [
        [1.0, 0.0, 1.0, 40.0 * column, 40.0 * row] for column in range(1, 16) for row in range(12)
    ]
    read = read_correspondences(make_cloud_message(crowd + spread, PLAIN, point_step=20))
    few = thin_cloud(read, 190, (640, 480))
    assert len(few.points) == 190
    assert np.count_nonzero(few.points[:, 0] == 1.0) > 0.95 * len(spread)


COUNT = 6
RNG = np.random.default_rng(0)
BINARY = RNG.integers(0, 256, (COUNT, 32), dtype=np.uint8)
FLOATS = RNG.normal(size=(COUNT, 7)).astype(np.float32)
VALUES = {
    **{name: np.arange(COUNT) + 0.5 * k for k, name in enumerate("uvxyz")},
    "id": np.arange(COUNT) * 10, "score": np.arange(COUNT) - 2.0, "other": np.full(COUNT, 9),
}  # fmt: skip
UV, XYZ = (("u", "f4"), ("v", "f8")), (("x", "f4"), ("y", "f8"), ("z", "f4"))
BITS, NUMBERS = ("descriptor", "u1", (32,)), ("descriptor", "f4", (7,))


def packed(*fields: tuple[Any, ...], order: str = "<") -> Any:
    """A message with these fields (name, type, perhaps count), as a structured array packs them."""
    rows = np.zeros(COUNT, list(fields))
    for name in rows.dtype.names:
        described = BINARY if rows.dtype[name].base == np.uint8 else FLOATS
        rows[name] = described if name == "descriptor" else VALUES[name]
    message = make_cloud(make_message, 5_000_000_007, "map", rows)
    if order == "<":
        return message
    big = rows.astype([(n, rows.dtype[n].newbyteorder(">")) for n in rows.dtype.names])
    return SimpleNamespace(**vars(message) | {"data": big.view(np.uint8), "is_bigendian": True})


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("marks", [(("id", "i2"),), (BITS,), (NUMBERS,), (("id", "i2"), BITS)])
def test_keypoints_and_landmarks_of_any_layout(order, marks):
    keypoints = read_keypoints(packed(("other", "i4"), *UV, *marks, ("score", "f4"), order=order))
    assert keypoints.stamp_ns == 5_000_000_007
    assert keypoints.pixels.tolist() == np.stack([VALUES["u"], VALUES["v"]], axis=1).tolist()
    assert keypoints.scores.tolist() == VALUES["score"].tolist()
    landmarks = read_map(packed(*marks, *XYZ, order=order))
    assert landmarks.frame == "map"
    assert landmarks.points.tolist() == np.stack([VALUES[n] for n in "xyz"], axis=1).tolist()
    for read in (keypoints, landmarks):
        assert (None if read.ids is None else read.ids.tolist()) == (
            VALUES["id"].tolist() if marks[0][0] == "id" else None
        )
        expected = {BITS: BINARY, NUMBERS: FLOATS}.get(marks[-1])
        if expected is None:
            assert read.descriptors is None
        else:
            assert read.descriptors.dtype == expected.dtype
            assert read.descriptors.tolist() == expected.tolist()


def test_a_keypoint_with_nan_in_its_descriptor_is_dropped():
    message = packed(*UV, NUMBERS)
    data = message.data.copy()
    start = 2 * message.point_step + message.fields[2].offset
    data[start : start + 4] = np.array([np.nan], "<f4").view(np.uint8)
    message.data = data
    read = read_keypoints(message)
    assert (read.dropped, len(read)) == (1, COUNT - 1)
    assert read.descriptors.tolist() == np.delete(FLOATS, 2, axis=0).tolist()


@pytest.mark.parametrize(
    ("mark", "text"),
    [
        ((), "neither a field id nor descriptor; found u, v"),
        ((("descriptor", "i2", (4,)),), "'descriptor' must be one of UINT8, FLOAT32; found INT16"),
        ((("id", "u4", (2,)),), "'id' must hold one value, found 2"),
    ],
)
def test_bad_keypoints(mark, text):
    with pytest.raises(MessageError, match=text):
        read_keypoints(make_cloud(make_message, 0, "camera", np.zeros(2, [*UV, *mark])))
