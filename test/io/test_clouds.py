# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Clouds of every layout are read; those that cannot be are refused with what was found."""

import array
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rs_localizer.io.bags import make_message
from rs_localizer.io.clouds import make_cloud, read_correspondences, select_inliers, thinned
from rs_localizer.io.messages import MessageError

PLAIN = [(name, 4 * i, 7) for i, name in enumerate("xyzuv")]
# Exact in single precision.
ROWS = [[0.5 * i, -i, 2.0 + i, 100.25 + i, 200.5 - i] for i in range(12)]


@pytest.fixture
def cloud(make_cloud_message) -> SimpleNamespace:
    return make_cloud_message(ROWS, PLAIN, point_step=20)


def test_a_plain_cloud(cloud):
    read = read_correspondences(cloud)
    assert read.stamp_ns == 5_000_000_007
    assert read.frame == "map"
    assert read.points.tolist() == [row[:3] for row in ROWS]
    assert read.pixels.tolist() == [row[3:] for row in ROWS]
    assert read.points.dtype == read.pixels.dtype == np.float64
    assert read.scores is None
    assert read.dropped == 0


@pytest.mark.parametrize("big_endian", [False, True])
@pytest.mark.parametrize(("height", "row_padding"), [(1, 0), (1, 5), (3, 0), (4, 7)])
@pytest.mark.parametrize("score_type", [7, 8])
@pytest.mark.parametrize("id_type", [1, 2, 3, 4, 5, 6])
def test_any_layout(make_cloud_message, big_endian, height, row_padding, score_type, id_type):
    # Mixed types at odd offsets in no order, gaps, and unknown fields among them.
    fields = [
        ("id", 0, id_type), ("v", 5, 8), ("rgb", 13, 6), ("x", 17, 7), ("score", 21, score_type),
        ("u", 31, 8), ("intensity", 39, 3), ("z", 41, 7), ("y", 45, 8),
    ]  # fmt: skip
    rows = [[i, r[4], 7, r[0], 0.25 * i, r[3], -9, r[2], r[1]] for i, r in enumerate(ROWS)]
    message = make_cloud_message(
        rows, fields, point_step=57, height=height, row_padding=row_padding, big_endian=big_endian
    )
    for data in (message.data, array.array("B", message.data.tobytes())):  # rosbags, rclpy
        message.data = data
        read = read_correspondences(message)
        assert read.points.tolist() == [row[:3] for row in ROWS]
        assert read.pixels.tolist() == [row[3:] for row in ROWS]
        assert read.scores is not None
        assert read.scores.tolist() == [0.25 * i for i in range(12)]
        assert read.table["id"].tolist() == list(range(12))
        assert set(read.table.dtype.names or ()) == {"x", "y", "z", "u", "v", "score", "id"}


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("column", range(6))
def test_rows_that_are_not_finite_are_dropped_and_counted(make_cloud_message, bad, column):
    rows = [[*row, 1.0] for row in ROWS]
    rows[3][column] = rows[7][column] = bad
    message = make_cloud_message(rows, [*PLAIN, ("score", 20, 8)], point_step=28)
    read = read_correspondences(message)
    kept = [i for i in range(12) if i not in (3, 7)]
    assert read.dropped == 2
    assert read.points.tolist() == [ROWS[i][:3] for i in kept]
    assert read.pixels.tolist() == [ROWS[i][3:] for i in kept]
    assert read.scores is not None
    assert len(read.scores) == len(read.table) == 10


def test_a_signaling_nan_is_dropped_silently(cloud):
    data = cloud.data.copy()
    data[20:24] = np.array([0x7F800001], "<u4").view(np.uint8)
    cloud.data = data
    assert read_correspondences(cloud).dropped == 1


def change_field(which: str, **values: Any) -> Callable[[Any], None]:
    def change(message: Any) -> None:
        for field in message.fields:
            if field.name == which:
                vars(field).update(values)

    return change


def change_message(**values: Any) -> Callable[[Any], None]:
    return lambda message: vars(message).update(values)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (change_message(data=np.zeros(239, np.uint8)), "truncated.* 240 bytes, found 239"),
        (
            change_message(width=2**32 - 1, height=2**32 - 1, point_step=2**32 - 1),
            "row_step is 240, too small for 4294967295 points of 4294967295 bytes",
        ),
        (change_message(point_step=19), "point_step is 19, but field 'v' ends at byte 20"),
        (change_message(fields=[]), "no field x, y, z, u, v; found none"),
        (change_field("v", datatype=5), "'v' must be one of FLOAT32, FLOAT64; found INT32"),
        (change_field("u", count=3), "'u' must hold one value, found 3"),
        (change_field("z", offset=2**32 - 1), "'z' ends at byte 4294967299"),
        (
            change_message(header=SimpleNamespace(frame_id="")),
            "header.frame_id is empty; it must name the frame of x, y, z",
        ),
    ],
)
def test_what_cannot_be_read_is_said(cloud, change, text):
    change(cloud)
    with pytest.raises(MessageError, match=text):
        read_correspondences(cloud)


@settings(max_examples=300, deadline=None)
@given(
    data=st.binary(max_size=300),
    width=st.integers(0, 2**32 - 1) | st.integers(0, 12),
    height=st.integers(0, 2**32 - 1) | st.integers(0, 3),
    point_step=st.integers(0, 2**32 - 1) | st.integers(0, 60),
    row_step=st.integers(0, 2**32 - 1) | st.integers(0, 300),
    big_endian=st.booleans(),
    fields=st.lists(
        st.tuples(
            st.sampled_from(["x", "y", "z", "u", "v", "score", "id", "other"]),
            st.integers(0, 2**32 - 1) | st.integers(0, 40),
            st.integers(0, 9),
            st.integers(0, 2),
        ),
        max_size=9,
    ),
    plain=st.booleans(),
)
def test_nothing_that_is_sent_raises_another_error(
    data, width, height, point_step, row_step, big_endian, fields, plain
):
    described = [(*field, 1) for field in PLAIN] if plain else fields
    message = SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="map"),
        width=width,
        height=height,
        point_step=point_step,
        row_step=row_step,
        is_bigendian=big_endian,
        fields=[SimpleNamespace(name=n, offset=o, datatype=t, count=c) for n, o, t, c in described],
        data=np.frombuffer(data, np.uint8),
    )
    try:
        read = read_correspondences(message)
    except MessageError:
        return
    assert len(read.points) + read.dropped == width * height
    assert np.all(np.isfinite(read.points))
    assert np.all(np.isfinite(read.pixels))


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
    assert (result.height, result.width, result.row_step) == (1, 3, 3 * result.point_step)
    types = {field.name: (field.datatype, field.count) for field in result.fields}
    assert types == {name: (number, 1) for name, _, number in fields} | {"residual": (7, 1)}
    assert not result.is_bigendian
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
    assert thinned(read, 12, (640, 480)) is read
    few = thinned(read, 4, (640, 480))
    assert few.scores is not None
    assert few.scores.tolist() == [9, 8, 9, 9]  # of the eights, the first one
    assert few.points[:, 0].tolist() == [0.5, 1.5, 3.0, 5.5]
    assert len(few.table) == len(few.pixels) == 4


def test_without_scores_each_part_of_the_image_keeps_as_many(make_cloud_message):
    crowd = [[0.0, 0.0, 1.0, 10.0, 10.0]] * 200
    spread = [
        [1.0, 0.0, 1.0, 40.0 * column, 40.0 * row] for column in range(1, 16) for row in range(12)
    ]
    read = read_correspondences(make_cloud_message(crowd + spread, PLAIN, point_step=20))
    few = thinned(read, 190, (640, 480))
    assert len(few.points) == 190
    assert np.count_nonzero(few.points[:, 0] == 1.0) == len(spread)
