# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pixels without noise, as a simulator sends them: what the motion model misses refuses nothing."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from benchmarks.independent.cameras import Camera
from rs_localizer import data
from rs_localizer.io.trajectories import read_tum
from rs_localizer.tools.simulation.true_motion import RecordedMotion, sampled_states
from rs_localizer.tools.simulation.walls import three_walls
from rs_localizer.tracking import Tracker

from .moving import camera_of, shown

TRUE = Camera(focal=500.0, distortion=(0.0,) * 5)
SIZE = np.array([TRUE.width, TRUE.height])
LOCALIZER = rsl.Localizer(camera_of(TRUE))


@pytest.fixture(scope="module")
def frames():
    """(middle_ns, points, pixels, true rotation) along four seconds of a recorded hand."""
    hand = RecordedMotion(read_tum(data.path(data.HAND_MOTION)))
    corners = three_walls(sampled_states(hand)).marker_map.points
    first = hand.intervals_ns[0][0] + 500_000_000
    found = []
    for stamp_ns in first + np.arange(0, 4_000_000_000, 33_333_333):
        middle_ns = int(stamp_ns) + round(0.5e9 * TRUE.readout_time)

        def pose(after, middle_ns=middle_ns):
            state = hand.state(middle_ns, np.nan_to_num(after))
            return Rotation.from_matrix(state.rotations), state.positions

        pixels = shown(TRUE, pose, corners)
        quads = pixels.reshape(-1, 4, 2)
        sides = np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2).min(axis=1)
        inside = np.all((quads > 2.0) & (quads < SIZE - 3.0), axis=(1, 2)) & (sides > 16.0)
        whole = np.repeat(inside, 4)
        if np.count_nonzero(whole) >= 12:
            single = (array[whole].astype(np.float32) for array in (corners, pixels))
            turned = hand.state(middle_ns, np.zeros(1)).rotations[0]
            found.append((middle_ns, *single, turned))
    assert len(found) > 80
    return found


def angles(results, frames):
    """Errors (n,) in degrees."""
    turns = [r.rotation @ frame[3] for r, frame in zip(results, frames, strict=True)]
    return np.degrees([np.arccos(np.clip((np.trace(t) - 1.0) / 2.0, -1.0, 1.0)) for t in turns])


def test_single_images_are_localized(frames):
    chosen = frames[::4]
    results = [LOCALIZER.localize(points, pixels) for _, points, pixels, _ in chosen]
    assert [result.reason for result in results if not result] == []
    # As good as with 0.02 px of noise: 0.08, median, where one wall is all that is seen.
    assert np.median(angles(results, chosen)) < 0.12


def test_a_track_stays_close(frames):
    tracker = Tracker(LOCALIZER)
    results = [tracker.localize(*frame[:3]) for frame in frames[:60]]
    assert [result.reason for result in results if not result] == []
    assert np.median(angles(results, frames[:60])) < 0.01
