# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The room with markers: they are read where its map says."""

import numpy as np
import pytest

from rs_localizer import data
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import project_rolling
from rs_localizer.io.trajectories import read_tum
from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.tools.simulation.frames import middle_stamp, true_poses_at
from rs_localizer.tools.simulation.renderer import Renderer
from rs_localizer.tools.simulation.true_motion import RecordedMotion, sampled_states
from rs_localizer.tools.simulation.walls import Scene, marked_room

K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(640, 480, K, readout_time=0.03)


@pytest.fixture(scope="module")
def motion() -> RecordedMotion:
    return RecordedMotion(read_tum(data.path(data.HAND_MOTION)))


@pytest.fixture(scope="module")
def scene(motion) -> Scene:
    return marked_room(sampled_states(motion))


# When the camera looks at the walls, one after the other (s).
@pytest.mark.parametrize("seconds", [28.5, 31.0, 35.0, 38.0])
def test_markers_are_read_where_they_are(motion, scene, seconds):
    """Unmirrored, and to within a few hundredths of a pixel."""
    assert scene.marker_map is not None
    stamp = motion.intervals_ns[0][0] + round(1e9 * seconds)
    image = Renderer(CAMERA, scene.planes).image(motion, stamp)
    found = MarkerDetector(scene.marker_map).detect(image)
    assert len(found.ids) >= 4
    poses_at = true_poses_at(CAMERA, motion, middle_stamp(CAMERA, stamp))
    true = project_rolling(CAMERA, poses_at, found.points)[0]
    assert np.median(np.linalg.norm(true - found.pixels, axis=1)) < 0.05
