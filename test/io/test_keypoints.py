# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Clouds of keypoints and of landmarks: every layout is read, the others are refused."""

import array
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rs_localizer.io.bags import make_message
from rs_localizer.io.clouds import make_cloud, read_keypoints, read_map
from rs_localizer.io.messages import MessageError

COUNT = 6
RNG = np.random.default_rng(0)
BINARY = RNG.integers(0, 256, (COUNT, 32), dtype=np.uint8)
FLOATS = RNG.normal(size=(COUNT, 7)).astype(np.float32)
VALUES = {
    **{name: np.arange(COUNT) + 0.5 * k for k, name in enumerate(("u", "v", "x", "y", "z"))},
    "id": np.arange(COUNT) * 10,
    "score": np.arange(COUNT) - 2.0,
    "other": np.full(COUNT, 9),
}


def cloud(*fields: tuple[Any, ...], order: str = "<", frame: str = "map") -> Any:
    """A message with these fields (name, type, perhaps count), as a structured array packs them."""
    kinds = [
        (name, order + kind if kind[0] in "<>" else kind, *more) for name, kind, *more in fields
    ]
    rows = np.zeros(COUNT, kinds)
    for name in rows.dtype.names or ():
        if name == "descriptor":
            rows[name] = BINARY[:, :32] if rows.dtype[name].base == np.uint8 else FLOATS
        else:
            rows[name] = VALUES[name]
    message = make_cloud(make_message, 5_000_000_007, frame, rows)
    if order == ">":
        big = rows.astype([(n, rows.dtype[n].newbyteorder(">")) for n in rows.dtype.names or ()])
        message = SimpleNamespace(
            **vars(message) | {"data": big.view(np.uint8), "is_bigendian": True}
        )
    return message


UV = (("u", "f4"), ("v", "f8"))
XYZ = (("x", "f4"), ("y", "f8"), ("z", "f4"))
BITS = ("descriptor", "u1", (32,))
NUMBERS = ("descriptor", "f4", (7,))


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("mark", [("id",), ("bits",), ("numbers",), ("id", "bits")])
@pytest.mark.parametrize("container", [np.asarray, lambda data: array.array("B", data.tobytes())])
def test_keypoints_and_landmarks_of_any_layout(order, mark, container):
    chosen = {"id": ("id", "i2"), "bits": BITS, "numbers": NUMBERS}
    marks = [chosen[name] for name in mark]
    message = cloud(("other", "i4"), *UV, *marks, ("score", "f4"), order=order)
    message.data = container(message.data)
    keypoints = read_keypoints(message)
    assert keypoints.stamp_ns == 5_000_000_007
    assert keypoints.pixels.tolist() == np.stack([VALUES["u"], VALUES["v"]], axis=1).tolist()
    assert keypoints.scores is not None
    assert keypoints.scores.tolist() == VALUES["score"].tolist()
    message = cloud(*marks, *XYZ, order=order)
    message.data = container(message.data)
    landmarks = read_map(message)
    assert landmarks.frame == "map"
    assert landmarks.points.tolist() == np.stack([VALUES[n] for n in "xyz"], axis=1).tolist()
    for read in (keypoints, landmarks):
        if "id" in mark:
            assert read.ids is not None
            assert read.ids.tolist() == VALUES["id"].tolist()
        else:
            assert read.ids is None
        if mark[-1] == "id":
            assert read.descriptors is None
        else:
            expected = BINARY if mark[-1] == "bits" else FLOATS
            assert read.descriptors is not None
            assert read.descriptors.dtype == expected.dtype
            assert read.descriptors.tolist() == expected.tolist()


@pytest.mark.parametrize("name", ["u", "descriptor", "score"])
def test_rows_that_are_not_finite_are_dropped_and_counted(name):
    message = cloud(*UV, NUMBERS, ("score", "f4"))
    kinds = {field.name: field for field in message.fields}
    data = message.data.copy()
    start = 2 * message.point_step + kinds[name].offset
    data[start : start + 4] = np.array([np.nan], "<f4").view(np.uint8)
    message.data = data
    read = read_keypoints(message)
    assert read.dropped == 1
    assert read.descriptors is not None
    assert read.descriptors.tolist() == np.delete(FLOATS, 2, axis=0).tolist()
    assert len(read) == COUNT - 1


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ((*UV,), "neither a field id nor descriptor; found u, v"),
        (
            (*UV, ("descriptor", "i2", (4,))),
            "'descriptor' must be one of UINT8, FLOAT32; found INT16",
        ),
        ((*UV, ("id", "u4", (2,))), "'id' must hold one value, found 2"),
        ((("u", "f4", (2,)), ("v", "f4"), ("id", "u4")), "'u' must hold one value, found 2"),
    ],
)
def test_bad_keypoints(fields, text):
    rows = np.zeros(2, list(fields))
    with pytest.raises(MessageError, match=text):
        read_keypoints(make_cloud(make_message, 0, "camera", rows))
