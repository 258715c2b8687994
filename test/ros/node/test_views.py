# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What viewers show: the map, and the camera's view where the camera is."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core.camera import Camera
from rs_localizer.ros.node.views import camera_marker


def numbers(points: Any) -> Any:
    return np.array([[p.x, p.y, p.z] for p in points])


@pytest.mark.parametrize(
    ("doubt", "color"),
    [(0.0, (0, 1, 0)), (0.5, (1, 1, 0)), (1.0, (1, 0, 0)), (np.nan, (0.2, 0.5, 1.0))],
)
def test_the_camera_stands_where_it_is_and_its_colour_is_the_doubt(doubt, color):
    turn = Rotation.from_euler("xyz", [20, -40, 70], degrees=True)
    estimate = SimpleNamespace(
        rotation=turn.inv().as_matrix(), position=np.array([1.0, 2.0, 3.0]), integrity=doubt
    )
    frame: Any = SimpleNamespace(map_frame="hall", stamp_ns=5 * 10**9, estimate=estimate)
    camera = Camera(5, 5, K=np.array([[4.0, 0.0, 2.0], [0.0, 4.0, 2.0], [0.0, 0.0, 1.0]]))
    marker = camera_marker(frame, camera)  # which sees half a metre to each side, in one
    assert (marker.header.stamp.sec, marker.header.frame_id, marker.ns) == (5, "hall", "camera")
    q, p = marker.pose.orientation, marker.pose.position
    pose = Rotation.from_quat([q.x, q.y, q.z, q.w])
    assert pose.as_matrix() == pytest.approx(turn.as_matrix())
    assert [p.x, p.y, p.z] == [1.0, 2.0, 3.0]
    assert (marker.color.r, marker.color.g, marker.color.b) == pytest.approx(color)
    assert len(marker.points) == 16  # four sides, four rays
    assert numbers(marker.points)[:, 2].max() == pytest.approx(0.3 * 2 / np.sqrt(6.0))
