# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Metres and gravity from an accelerometer: the equations, what is found, and how honest it is."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from felt import GRAVITY, Felt

from rs_localizer.trajectory.gyro import GyroSamples, NoMount
from rs_localizer.trajectory.imu_extrinsics import imu_extrinsics
from rs_localizer.trajectory.metric import (
    ForceSamples,
    Lever,
    Means,
    NoMetric,
    covariance,
    mean_accelerations,
    metric,
)
from rs_localizer.trajectory.spline import Layout, Spline

SECONDS = 12.0
UNKNOWN = Lever(np.zeros(3), 0.1)


def means_of(
    felt: Felt, noise: float = 0.0, kept: Any = slice(None), spline: Spline | None = None,
    knock: float = 0.0,
) -> list[Means]:  # fmt: skip
    """By the true rotation and offset; with a knock that no image shows for 20 ms."""
    stamps = felt.stamps(SECONDS)
    forces = felt.forces(stamps)
    forces += np.random.default_rng(0).normal(0.0, noise, forces.shape)
    forces[1200:1204] += knock * np.array([3.0, -1.0, 0.5])
    samples = ForceSamples(stamps[kept] + felt.delay, forces[kept])
    spline = spline or felt.spline(SECONDS)
    return mean_accelerations(spline, samples, felt.camera_from_imu.as_matrix(), 0.15)


def test_both_sides_are_the_same_number():
    """``s p'' + (R l)'' = R C (f - b) + g`` of all means, by the test's own truth."""
    felt = Felt.random(0)
    for part in means_of(felt):
        left = felt.scale * part.seen + part.arms @ felt.lever
        right = part.forces - part.axes @ felt.bias + np.outer(part.weights, GRAVITY * felt.down)
        np.testing.assert_allclose(left, right, atol=2e-3)
        np.testing.assert_allclose(part.weights, 1.0, atol=1e-6)
        assert np.std(felt.scale * part.seen) > 0.3


def test_all_is_found():
    felt = Felt.random(1)
    found = metric(means_of(felt), UNKNOWN)
    assert found.scale == pytest.approx(felt.scale, rel=2e-3)
    assert np.linalg.norm(found.gravity) == pytest.approx(GRAVITY, rel=2e-3)
    assert angle(found.gravity, felt.down) < 0.05
    np.testing.assert_allclose(found.bias, felt.bias, atol=0.01)


def angle(one: np.ndarray, other: np.ndarray) -> float:
    """deg."""
    sine = np.linalg.norm(np.cross(one, other))
    return float(np.degrees(np.arctan2(sine, one @ other)))


def test_an_accelerometer_that_shows_too_much_makes_nothing_larger():
    """2 %: gravity's known length says so."""
    felt = Felt.random(2)
    parts = [replace(part, forces=1.02 * part.forces) for part in means_of(felt)]
    found = metric(parts, Lever(np.array(felt.lever), 0.005))
    assert found.scale == pytest.approx(felt.scale, rel=0.008)
    assert abs(found.scale / felt.scale - 1.0) < 3.0 * found.share


def noisy_means(felt: Felt, seed: int, noise: float = 3e-3) -> list[Means]:
    """Positions known to 3 mm, and orientations to 0.1 deg, for 70 ms each."""
    rng, exact = np.random.default_rng(1000 + seed), felt.spline(SECONDS)
    layout = Layout.over(np.array([[0.0, SECONDS]]), 0.07)
    still, times = np.tile(np.eye(3), (layout.firsts[-1], 1, 1)), exact.layout.control_times()
    steps = [
        Spline(layout, still, rng.normal(0.0, size, (layout.firsts[-1], 3))).states(times).positions
        for size in (np.radians(0.1), noise / felt.scale)
    ]
    return means_of(felt, 0.03, spline=exact.moved(np.hstack(steps).ravel()))


@pytest.mark.bench
def test_deviations_are_honest():
    scales, tilts = [], []
    for seed in range(8):
        felt = Felt.random(seed)
        found = metric(noisy_means(felt, seed), UNKNOWN)
        scales.append((found.scale / felt.scale - 1.0) / found.share)
        tilts.append(np.radians(angle(found.gravity, felt.down)) / found.gravity_deviation)
        assert found.share < 0.02
    assert 0.3 < np.sqrt(np.mean(np.square(scales))) < 1.7
    assert np.max(np.abs(scales)) < 3.5
    assert np.median(tilts) < 2.0


def growing(parts: list[Means], more: float) -> list[Means]:
    """Parts of a map that grows on the way, by a share."""
    sizes = 1.0 + more * np.linspace(-0.5, 0.5, len(parts))
    return [replace(part, seen=s * part.seen) for part, s in zip(parts, sizes, strict=True)]


def test_parts_of_other_sizes_widen_the_deviation():
    """A map that is 4 % larger at its end; a rest of as long says nothing of sizes."""
    felt = Felt.random(30)
    parts = noisy_means(felt, 0)
    assert metric(parts, UNKNOWN).inflation == 1.0
    alone = metric(growing(parts, 0.04), UNKNOWN)
    assert 1.5 < alone.inflation < 6.0
    resting = noisy_means(replace(felt, way=0.0, turn=0.0), 0)
    found = metric([*growing(parts, 0.04), *resting], UNKNOWN)
    assert found.inflation == pytest.approx(alone.inflation, rel=0.5)
    assert abs(found.scale / felt.scale - 1.0) < 3.0 * found.inflation * found.share < 0.06


def test_the_covariance_is_that_of_white_noise():
    """Of positions: means of a motion that is noise alone, by their own sums."""
    rng, spacing = np.random.default_rng(0), 0.1
    layout = Layout.over(np.array([[0.0, 80.0]]), 0.004)
    still = np.tile(np.eye(3), (layout.firsts[-1], 1, 1))
    spline = Spline(layout, still, rng.normal(0.0, 1.0, (layout.firsts[-1], 3)))
    times = np.arange(0.0, 80.0, 0.01)
    samples = ForceSamples(times, np.zeros((len(times), 3)))
    parts = mean_accelerations(spline, samples, np.eye(3), spacing)
    seen = np.concatenate([part.seen for part in parts if len(part.times) == 20])
    expected = 0.004 * covariance(4, spacing, 0.0)[0]
    for lag in range(4):
        pairs = np.mean(seen[: len(seen) - lag] * seen[lag:])
        assert pairs == pytest.approx(expected[lag], abs=0.12 * expected[0])


def test_a_knock_does_not_count():
    felt = Felt.random(9)
    found = metric(means_of(felt, 0.05, knock=10.0), UNKNOWN)
    assert found.scale == pytest.approx(felt.scale, rel=3e-3)


def test_a_camera_at_rest_determines_nothing():
    """Nor does it divide by nothing."""
    with pytest.raises(NoMetric, match="the camera hardly moved"):
        metric(means_of(Felt.random(10, way=0.0, turn=0.0)), UNKNOWN)


@pytest.mark.parametrize("tone", [0.0, 0.5])
def test_the_mount_is_found(tone):
    """Also beside a motor's tone (deg), of four times the hand's rates, in step with the turns that
    are compared.
    """
    felt = Felt.random(3)
    stamps, pulse = felt.stamps(SECONDS), 2.0 * np.pi * 9.5 / 0.15
    rates = felt.rates(stamps)
    rates[500] = 40.0  # a message that went wrong
    rates += np.outer(np.radians(tone) * pulse * np.cos(pulse * stamps), [0.5, 0.7, 0.5])
    found = imu_extrinsics(GyroSamples(stamps, rates), felt.spline(SECONDS))
    assert found.mount.delay == pytest.approx(felt.delay, abs=3e-4)
    assert abs(found.mount.delay - felt.delay) < 3.0 * found.delay_deviation
    turned = felt.camera_from_imu.as_matrix().T @ found.mount.camera_from_imu
    assert np.linalg.norm(turned - np.eye(3)) < 4e-3
    np.testing.assert_allclose(found.mount.bias, felt.gyroscope_bias, atol=2e-3)
    assert found.delay_deviation < 1e-3
    assert found.turn_deviation < 5e-3


def test_another_ones_turns_are_no_mount():
    felt, other = Felt.random(4), Felt.random(5)
    stamps = felt.stamps(SECONDS)
    with pytest.raises(NoMount, match="are not the camera's"):
        imu_extrinsics(GyroSamples(stamps, other.rates(stamps)), felt.spline(SECONDS))
    with pytest.raises(NoMount, match="0 samples"):
        imu_extrinsics(GyroSamples(np.zeros(0), np.zeros((0, 3))), felt.spline(SECONDS))


def test_gaps_are_left_out():
    felt = Felt.random(6)
    stamps = felt.stamps(SECONDS)
    parts = means_of(felt, kept=(stamps < 4.0) | (stamps > 4.3))
    times = np.concatenate([part.times for part in parts])
    assert not np.any((times > 4.0 - 0.4) & (times < 4.3 + 0.4))
