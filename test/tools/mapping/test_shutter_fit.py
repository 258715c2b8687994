# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Which shutter images show where nobody knows it."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import READOUT, camera, walk

from rs_localizer.core.scanning import ScanDirection
from rs_localizer.tools.mapping.map_keypoints import MapFreedom
from rs_localizer.tools.mapping.refinement import RefinedMap, fit_shutter
from rs_localizer.tools.readout_belief import ShutterFit

VIDEO = np.arange(0.0, 1.2, 1.0 / 30.0)


def fit(readout: float) -> tuple[RefinedMap, ShutterFit | None]:
    scene = walk(np.random.default_rng(1), VIDEO, points=100, count=40, readout=readout)
    return fit_shutter(camera(0.0), scene.seen, scene.start, MapFreedom(), lambda text: None)


def test_a_rolling_shutter_is_found():
    refined, shutter = fit(READOUT)
    assert shutter.visible
    assert shutter.direction == ScanDirection.TOP_TO_BOTTOM
    assert refined.readout_time == pytest.approx(READOUT, abs=4.0 * shutter.deviation)
    assert shutter.deviation < 1e-3


def test_a_global_shutter_is_left_alone():
    refined, shutter = fit(0.0)
    assert not shutter.visible
    assert refined.readout_time == 0.0


def test_images_that_no_smooth_motion_joins_have_poses_of_their_own():
    """As those of a time lapse, whose stamps are nearer than its images were, some by much."""
    scene = walk(np.random.default_rng(1), np.arange(0.0, 12.0, 1.0), readout=0.0)
    stamps = scene.seen.stamps_ns[0] + np.cumsum(np.tile([5, 50, 50], 4)) * 10**6
    seen = replace(scene.seen, stamps_ns=stamps)
    refined, shutter = fit_shutter(camera(0.0), seen, scene.start, MapFreedom(), lambda text: None)
    assert shutter is None
    assert refined.apart
    assert refined.fit_share > 0.95
    assert refined.deviation == pytest.approx(0.3, rel=0.15)
