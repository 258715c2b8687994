# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The readout time from neighbouring frames: value, deviation, alarms; on an own projector."""

import numpy as np
import pytest

from rs_localizer.core import so3
from rs_localizer.pipeline.readout_estimate import (
    Equation,
    ImageMotion,
    MeasuredReadout,
    ReadoutEstimate,
    equation,
)

READOUT = 0.03
NOISE = 1e-3


def triples(true: float, speed: float, off: float = 0.01, shaking: float = 0.0) -> list[Equation]:
    """Triples whose velocities are off by the same everywhere, by ten times the noise."""
    rng, count = np.random.default_rng(1), 20
    x = speed * np.cumsum(rng.normal(size=(count, 6)), axis=0) / np.sqrt(count)
    images = rng.normal(0.0, NOISE, (count + 2, 6)) + rng.normal(0.0, shaking, (count + 2, 6))
    y = true * x + rng.normal(0.0, off, 6)
    y += (images[:-2] + 4.0 * images[1:-1] + images[2:]) / 6.0
    none, spread = np.zeros((6, 6)), 0.5 * NOISE**2 * np.eye(6)
    return [Equation(*pair, none, none, spread) for pair in zip(x, y, strict=True)]


def measured(of: list[Equation]) -> MeasuredReadout | None:
    estimate = ReadoutEstimate()
    for triple in of:
        estimate.take(triple, 1.0)
    return estimate.measured


@pytest.mark.parametrize("true", [READOUT, 0.0, -READOUT])
def test_few_frames_tell_which_it_is_behind_errors_of_the_map(true):
    found = measured(triples(true, speed=1.0))
    for other in {READOUT, 0.0, -READOUT} - {true}:
        assert found.odds(true, other) > 4.6
    assert found.misfit < 1.5


def test_at_rest_nothing_is_known():
    found = measured(triples(0.0, speed=1e-5))
    assert found is None or abs(found.odds(0.0, READOUT)) < 0.1


def covariance(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.normal(size=(size, 2 * size))
    scale = 10.0 ** rng.uniform(-2.0, 0.0, size)
    return root @ root.T * np.outer(scale, scale)


def test_the_equation_of_three_views_holds_for_a_steady_turn():
    """A camera that turns and travels steadily in its own axes: y = T x with T = 1 / rate."""
    rng = np.random.default_rng(1)
    turn, travel, readout = rng.normal(0.0, 0.3, 3), rng.normal(0.0, 0.3, 3), 0.02
    start, views, times = so3.exp(rng.normal(size=3)), [], (-0.03, 0.0, 0.05)
    for time in times:
        fine = np.linspace(0.0, time, 2001)
        path = np.array([so3.exp(turn * t) @ travel for t in fine])
        motion = readout * np.concatenate([turn, travel])
        way = np.mean(0.5 * (path[1:] + path[:-1]), axis=0) * time
        views.append(
            ImageMotion(start @ so3.exp(turn * time), start @ way, motion, covariance(rng, 12))
        )
    of = equation(*views, times[1] - times[0], times[2] - times[1])
    np.testing.assert_allclose(of.y, readout * of.x, atol=1e-6)
    spans = np.array([-1.0, 0.0, 1.0]) / (times[2] - times[0])
    ratio = (times[2] - times[1]) / (times[1] - times[0])
    simpson = np.array([2.0 - ratio, 2.0 + ratio + 1.0 / ratio, 2.0 - 1.0 / ratio]) / 6.0
    expected = np.zeros((12, 12))
    for each, span, share in zip(views, spans, simpson, strict=True):
        turned = np.kron(np.eye(4), views[1].rotation.T @ each.rotation)
        turned[:3, :3] = turned[6:9, 6:9] = np.eye(3)
        lift = np.kron(np.diag([span, share]), np.eye(6)) @ turned
        expected += lift @ each.covariance @ lift.T
    found = np.block([[of.xx, of.yx.T], [of.yx, of.yy]])
    np.testing.assert_allclose(found, expected, atol=1e-12 * np.abs(expected).max())
