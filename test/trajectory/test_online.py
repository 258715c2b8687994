# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The readout time from neighbouring frames: value, deviation, alarms; on an own projector."""

from dataclasses import replace
from functools import cache

import numpy as np
import projector
import pytest

from rs_localizer.core.camera import Camera
from rs_localizer.core.types import Estimate
from rs_localizer.localizer import Localizer
from rs_localizer.tracking import Tracker
from rs_localizer.trajectory.online_readout import ReadoutMonitor
from rs_localizer.trajectory.readout_equations import MeasuredReadout

READOUT = 0.03
CAMERA = Camera(width=projector.WIDTH, height=projector.HEIGHT, K=projector.K, D=projector.D)


@cache
def recording(
    points: str = "room", seconds: float = 2.0, turn: float = 0.14, noise: float = 1.0
) -> list[projector.Frame]:
    rng = np.random.default_rng(7)
    motion = projector.Motion.random(rng, turn, 0.6 * turn)
    landmarks = projector.room(rng) if points == "room" else projector.board()
    return projector.record(
        rng, motion, landmarks, readout=READOUT, seconds=seconds, noise=noise, outliers=0.1
    )


def watch(
    frames: list[projector.Frame], believed: float, camera: Camera = CAMERA, keep: float = 10.0
) -> tuple[ReadoutMonitor, list[MeasuredReadout | None]]:
    """What the monitor says after every fifth frame; tracked where a readout time is given."""
    localizer = Localizer(replace(camera, readout_time=believed))
    tracker = Tracker(localizer) if believed > 0.0 else None
    monitor = ReadoutMonitor(keep)
    said = []
    for k, frame in enumerate(frames):
        time_ns = round((frame.stamp + 0.5 * READOUT) * 1e9)
        seen = frame.points, frame.pixels
        result = tracker.localize(time_ns, *seen) if tracker else localizer.localize(*seen)
        if isinstance(result, Estimate):
            monitor.add(time_ns, camera, result, *seen)
        if k % 5 == 4:
            said.append(monitor.measure())
    return monitor, said


@pytest.mark.parametrize(
    ("points", "believed"),
    [
        ("room", READOUT),
        ("room", 1.2 * READOUT),
        pytest.param("room", 0.8 * READOUT, marks=pytest.mark.bench),
        pytest.param("room", 0.0, marks=pytest.mark.bench),
        pytest.param("board", 1.2 * READOUT, marks=pytest.mark.bench),
    ],
)
def test_the_readout_time_whatever_is_believed(points, believed):
    noise, turn = (1.0, 0.14) if points == "room" else (0.3, 0.06)
    _, said = watch(recording(points, turn=turn, noise=noise), believed)
    found = said[-1]
    assert abs(found.readout_time - READOUT) < 3.0 * found.deviation < 0.06 * READOUT
    alarms = [measured for measured in said if measured and measured.contradicts(believed)]
    if believed == READOUT:
        assert not alarms
    else:
        assert len(alarms) > len(said) / 2  # from within the first half on


def test_a_reversed_direction_is_a_negative_readout_time():
    camera = replace(CAMERA, scan_direction="bottom_to_top")
    _, said = watch(recording(), READOUT, camera)
    assert said[-1].readout_time == pytest.approx(-READOUT, rel=0.03)
    assert said[-1].contradicts(READOUT)


@pytest.mark.parametrize("turn", [0.0, 0.003])
def test_no_alarm_at_rest_nor_at_slow_motion(turn):
    _, said = watch(recording(turn=turn), READOUT)
    assert not any(measured and measured.contradicts(READOUT) for measured in said)


def test_the_window_forgets_and_time_that_goes_back_starts_afresh():
    frames = recording(seconds=2.0)
    short, _ = watch(frames, 0.0, keep=0.8)
    found = short.measure()
    assert found.triples <= 25
    result = Localizer(CAMERA).localize(frames[0].points, frames[0].pixels)
    short.add(0, CAMERA, result, frames[0].points, frames[0].pixels)
    assert short.measure() is None


def test_contradiction_needs_both_many_deviations_and_a_real_difference():
    assert not MeasuredReadout(0.030, 1e-3, 100, 100.0).contradicts(0.033)
    assert not MeasuredReadout(0.030, 1e-6, 100, 100.0).contradicts(0.031)
    assert MeasuredReadout(0.030, 5e-4, 100, 100.0).contradicts(0.033)
    assert MeasuredReadout(-0.030, 5e-4, 100, 100.0).contradicts(0.030)
