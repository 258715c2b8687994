# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses that no camera can have: a map in another unit, and two cameras in one tracker."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from benchmarks.independent.cameras import Camera
from rs_localizer.config import LocalizerConfig
from rs_localizer.pace_watch import PaceWatch

from .moving import Moving, camera_of

SECOND = 10**9


@pytest.mark.parametrize(
    ("unit", "depth", "speed", "noise", "to_and_fro", "told"),
    [
        (1000.0, 2.0, 0.2, 0.01, True, "millimetres"),
        (1000.0, 2.0, 0.2, 0.01, False, "millimetres"),
        (100.0, 4.0, 0.4, 0.01, True, "centimetres"),
        (1000.0, 2.0, 0.0, 0.01, False, ""),
        (1.0, 100.0, 40.0, 0.1, False, ""),  # a car
        (1.0, 50.0, 4.0, 0.1, True, ""),  # a drone, 40 m/s^2
        (1.0, 100.0, 0.0, 30.0, False, ""),
    ],
)
def test_the_unit_of_a_map_is_named(unit, depth, speed, noise, to_and_fro, told):
    rng = np.random.default_rng(0)
    watch, told_of = PaceWatch(LocalizerConfig()), set()
    for i in range(90):
        # A hand at 1 Hz is after a second where it was: its mean speed is the same.
        way = speed * np.sin(2.0 * np.pi * i / 30.0) / 4.0 if to_and_fro else speed * i / 30.0
        place = np.array([way, 0.0, 2.0]) + rng.normal(0.0, noise, 3)
        covariance = np.diag(np.full(12, (unit * noise) ** 2))
        estimate: Any = SimpleNamespace(
            position=unit * place, rotation=np.eye(3), covariance=covariance, inliers=[0, 1, 2]
        )
        points = estimate.position + unit * depth * np.eye(3)[[2, 2, 2]]
        watch.add(i * SECOND // 30, estimate, points, lambda of=estimate: of)
        told_of |= {watch.fault} - {""}
    assert (watch.is_odd, watch.notice == "map_scale") == (bool(told), bool(told))
    for text in told_of:
        assert f"{unit * depth:.0f} m from the points: is the map in {told}?" in text
        assert f"by a factor of {1.0 / unit:g} (map align --scale)" in text
    if told:
        speeds = [float(text.split(" m/s")[0].split()[-1]) for text in told_of]
        assert np.median(speeds) == pytest.approx(unit * speed, rel=0.25)


def test_what_happened_while_nothing_was_seen_is_no_speed():
    """A robot that was carried elsewhere, or a map that was exchanged."""
    watch, covariance = PaceWatch(LocalizerConfig()), np.diag(np.full(12, 1e-4))
    for i in range(6):
        estimate: Any = SimpleNamespace(
            position=np.full(3, 1e3 * i),
            rotation=np.eye(3),
            covariance=covariance,
            inliers=[0, 1, 2],
        )
        points = estimate.position + 100.0 * np.eye(3)[[2, 2, 2]]
        watch.add(round(0.6 * i * SECOND), estimate, points, lambda of=estimate: of)
        assert watch.fault == ""


@pytest.mark.parametrize(
    ("unit", "apart", "said"),
    [
        (1.0, None, ""),
        (1000.0, None, "is the map in millimetres"),
        (1.0, 1.0, "alternate between two places, 1 m and"),
    ],
)
def test_a_tracker_names_the_unit_of_a_map_and_a_second_camera(unit, apart, said):
    true = Camera(1280, 720, focal=900.0, distortion=(0.0,) * 5, readout_time=0.02)
    rng, tracker = np.random.default_rng(1), rsl.Tracker(rsl.Localizer(camera_of(true)))
    room = rng.uniform([-1.5, -1.0, 2.0], [1.5, 1.0, 4.0], (60, 3))
    ways = [
        Moving(lambda t, x=x: (Rotation.from_rotvec([[0.0, 0.1, 0.0]] * t),
                               [x, 0.0, 0.0] + [0.2, 0.0, 0.0] * np.sin(2.0 * t)), true)
        for x in ((0.0,) if apart is None else (0.0, apart))
    ]  # fmt: skip
    for k in range(30):
        pixels = ways[k % len(ways)].pixels(k / 30.0, room)
        pixels += rng.normal(0.0, 0.3, pixels.shape)
        tracker.localize(10**12 + k * SECOND // 30, unit * room, pixels)
    assert (said in tracker.pace.fault) if said else not tracker.pace.fault
    assert tracker.lens.fault == ""
