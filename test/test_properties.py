# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Laws that hold for any input: what is written is read, what is refused is said."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from benchmarks.fuzzing import seeds
from benchmarks.fuzzing.seeds import map_rows
from rs_localizer.config import NodeConfig
from rs_localizer.io.bags import make_message
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import make_cloud, read_keypoints, read_map
from rs_localizer.io.maps.files import read_map_file, write_npz
from rs_localizer.io.maps.landmarks import Map, MapError
from rs_localizer.io.messages import MessageError
from rs_localizer.settings import build
from rs_localizer.settings import settings as all_settings

quick = settings(max_examples=40, deadline=None)
# Of a PointField: 32 bits, unsigned or signed.
IDS = [
    st.integers(0, 2**32 - 1) | st.integers(0, 5) | st.just(2**32 - 1),
    st.integers(-(2**31), 2**31 - 1) | st.just(-(2**31)),
]


@st.composite
def maps(draw: Any) -> Map:
    count = draw(st.integers(1, 6))
    points = draw(arrays.arrays(np.float64, (count, 3), elements=st.floats(-1e8, 1e8)))
    numbers = st.lists(draw(st.sampled_from(IDS)), min_size=count, max_size=count, unique=True)
    ids = draw(st.none() | numbers)
    width = draw(st.integers(1, 70))
    kind = draw(st.sampled_from([None, np.uint8, np.float32]))
    descriptors = None
    if kind is not None:
        # Single values that are anything, in random ones.
        rng = np.random.default_rng(draw(st.integers(0, 99)))
        descriptors = (200 * rng.random((count, width))).astype(kind)
        special = (
            st.integers(0, 255)
            if kind is np.uint8
            else st.floats(width=32, allow_nan=False, allow_infinity=False)
        )
        descriptors[draw(st.integers(0, count - 1)), draw(st.integers(0, width - 1))] = draw(
            special
        )
    return Map(points, None if ids is None else np.array(ids, np.int64), descriptors, "map")


@quick
@given(landmarks=maps())
def test_a_map_is_what_it_was_before_it_was_written(landmarks):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.npz"
        write_npz(path, landmarks)
        assert read_map_file(path, "map").equals(landmarks)


@quick
@given(landmarks=maps())
def test_a_map_is_what_it_was_before_it_was_sent(landmarks):
    message = make_cloud(make_message, 0, "map", map_rows(landmarks))
    if landmarks.ids is None and landmarks.descriptors is None:
        with pytest.raises(MessageError, match="neither a field id nor descriptor"):
            read_map(message)
    else:
        assert read_map(message).equals(landmarks)


@quick
@given(data=st.binary(max_size=400))
def test_any_bytes_are_a_map_or_refused(data):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.npz"
        path.write_bytes(data)
        try:
            found = read_map_file(path, "map")
        except MapError:
            return
        assert np.isfinite(found.points).all()


MARKS = [
    ("id", "<u2"),
    ("descriptor", "u1", (3,)),
    ("descriptor", "<f4", (2,)),
    ("descriptor", "<f4", (0,)),
]


@quick
@given(
    data=st.binary(max_size=120),
    mark=st.sampled_from(MARKS),
    width=st.integers(0, 2**32 - 1) | st.integers(0, 6),
    count=st.integers(0, 2**32 - 1) | st.integers(0, 4),
    map_points=st.booleans(),
    big_endian=st.booleans(),
)
def test_any_data_are_keypoints_or_refused(data, mark, width, count, map_points, big_endian):
    """NaN and repeated ids among them, and sizes that no memory has."""
    names = "xyz" if map_points else "uv"
    message = seeds.cloud(*((name, "<f4") for name in names), mark)
    message.data, message.width, message.is_bigendian = data, width, big_endian
    if mark[0] == "descriptor":
        message.fields[-1].count = count
    try:
        read: Any = read_map(message) if map_points else read_keypoints(message)
    except MessageError:
        return
    assert len(read) + read.dropped == width
    for values in (read.ids, read.descriptors):
        assert values is None or len(values) == len(read)
    if read.descriptors is not None:
        assert read.descriptors.ndim == 2
        assert np.isfinite(read.descriptors).all()


NUMBERS = st.floats(width=64) | st.sampled_from([0.0, 500.0, 320.0])


@quick
@given(
    k=st.lists(NUMBERS, min_size=9, max_size=9),
    d=st.lists(NUMBERS, max_size=15),
    sizes=st.lists(st.integers(0, 2**32 - 1) | st.integers(1, 3000), min_size=8, max_size=8),
    model=st.sampled_from(["plumb_bob", "rational_polynomial", "equidistant", "", "other"]),
)
def test_any_camera_info_is_a_camera_or_refused(k, d, sizes, model):
    message = seeds.camera_info()
    message.k, message.d, message.distortion_model = k, d, model
    message.width, message.height, message.binning_x, message.binning_y = sizes[:4]
    roi = message.roi
    roi.x_offset, roi.y_offset, roi.width, roi.height = sizes[4:]
    try:
        camera = read_camera_info(message).camera(0.03, "top_to_bottom")
    except MessageError:
        return
    assert camera.K[0, 0] > 0.0
    assert np.isfinite(camera.first_row_time)


VALUES = (
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=12)
    | st.lists(st.integers(), max_size=2) | st.sampled_from(["r6p", "id", "map", ""])
)  # fmt: skip


@quick
@given(values=st.dictionaries(st.sampled_from(sorted(all_settings())), VALUES, max_size=3))
def test_any_parameters_are_settings_or_refused(values):
    said = ""
    try:
        assert isinstance(build(values), NodeConfig)
    except ValueError as error:
        said = str(error)
    assert not said or any(name.split(".")[-1] in said for name in values)
