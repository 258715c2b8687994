# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pixels without noise, as a simulator sends them: what the motion model misses refuses nothing."""

import numpy as np
import pytest

import rs_localizer as rsl
from rs_localizer.tools.simulation.walls import three_walls
from rs_localizer.tracking import Tracker

from .moving import PLAIN, Moving, camera_of, inside, recorded_hand

LOCALIZER = rsl.Localizer(camera_of(PLAIN))
WAY, STATES = recorded_hand()
HAND = Moving(WAY)


@pytest.fixture(scope="module")
def frames():
    """Time, points and pixels of markers that are seen whole, in four seconds of a hand's way."""
    corners, found = three_walls(STATES).marker_map.points, []
    for t in 0.5 + np.arange(120) / 30.0:
        pixels = HAND.pixels(t, corners)
        quads = pixels.reshape(-1, 4, 2)
        sides = np.linalg.norm(quads - np.roll(quads, 1, axis=1), axis=2).min(axis=1)
        whole = inside(PLAIN, pixels, margin=2.5).reshape(-1, 4).all(axis=1) & (sides > 16.0)
        seen = np.repeat(whole, 4)
        if np.count_nonzero(seen) >= 12:
            found.append((t, corners[seen].astype(np.float32), pixels[seen].astype(np.float32)))
    assert len(found) > 80
    return found


def turns(results, frames):
    """Errors (n,) of the orientation, deg; every frame has a pose."""
    assert [result.reason for result in results if not result] == []
    errors = [HAND.error(found, t)[:3] for found, (t, *_) in zip(results, frames, strict=True)]
    return np.degrees(np.linalg.norm(errors, axis=1))


def test_single_images_are_localized(frames):
    results = [LOCALIZER.localize(*seen) for _, *seen in frames[::4]]
    # As good as with 0.02 px of noise: 0.08, median, where one wall is all that is seen.
    assert np.median(turns(results, frames[::4])) < 0.12


def test_a_track_stays_close(frames):
    tracker = Tracker(LOCALIZER)
    results = [tracker.localize(10**9 + round(1e9 * t), *seen) for t, *seen in frames[:60]]
    assert np.median(turns(results, frames[:60])) < 0.01
