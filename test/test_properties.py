# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Any map that is written is read; that nothing else is, benchmarks.fuzzing says."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from benchmarks.fuzzing import map_rows
from rs_localizer.io.bags import make_message
from rs_localizer.io.clouds import make_cloud, read_map
from rs_localizer.io.maps.files import read_map_file, write_npz
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.messages import MessageError

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
    width = draw(st.integers(1, 130))
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
