# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Any map that is written is read; that nothing else is, benchmarks.fuzzing says."""

from typing import Any

import numpy as np
import pytest

from benchmarks.fuzzing import map_rows
from rs_localizer.io.bags import make_message
from rs_localizer.io.clouds import make_cloud, read_map
from rs_localizer.io.maps.files import read_map_file, write_npz
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.messages import MessageError

COUNT = 4
# Of a PointField: 32 bits, unsigned or signed.
IDS = [None, [0, 2**32 - 1, 5, 2**31], [-(2**31), -1, 0, 2**31 - 1]]
LARGEST = np.finfo(np.float32).max


def descriptors(kind: str, width: int) -> Any:
    """Random ones with values that are anything."""
    if kind == "none":
        return None
    values = (200 * np.random.default_rng(width).random((COUNT, width))).astype(kind)
    values[:, 0] = [0, 255, 1, 128] if kind == "uint8" else [LARGEST, -LARGEST, -0.0, 1e-45]
    return values


@pytest.mark.parametrize("ids", IDS)
@pytest.mark.parametrize("kind", ["none", "uint8", "float32"])
@pytest.mark.parametrize("width", [1, 3, 128, 130])
def test_a_map_is_what_it_was_before_it_was_written_or_sent(ids, kind, width, tmp_path):
    points = [[1e8, -1e8, 0.1], [-0.0, 1e-300, 5e-324], [1.0, 2.0, 3.0], [1e8 / 3, 7.0, -1e-8]]
    numbers = None if ids is None else np.array(ids, np.int64)
    landmarks = Map(np.array(points), numbers, descriptors(kind, width), "map")
    write_npz(tmp_path / "a.npz", landmarks)
    assert read_map_file(tmp_path / "a.npz", "map").equals(landmarks)
    message = make_cloud(make_message, 0, "map", map_rows(landmarks))
    if ids is None and kind == "none":
        with pytest.raises(MessageError, match="neither a field id nor descriptor"):
            read_map(message)
    else:
        assert read_map(message).equals(landmarks)
