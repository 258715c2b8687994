# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Landmarks of maps, and their metres by an IMU: errors by the deviations that are told of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks.independent.cameras import Camera
from benchmarks.independent.rotations import exponential, logarithm
from benchmarks.mapping.rooms import Film, Walk, a_walk, estimators_camera, walls
from rs_localizer.core.arrays import Array
from rs_localizer.mapping.gauge import through
from rs_localizer.mapping.inertial_metres import inertial_metres
from rs_localizer.mapping.refine import refine
from rs_localizer.trajectory.imu import ImuRecording

_NOISE, _OFF, _READOUT = 0.3, 0.02, 0.03  # px, m, s
_SECONDS, _IMAGES, _SAMPLES = 12.0, 15.0, 200.0  # s, Hz
_GRAVITY = np.array([0.0, 9.80665, 0.0])  # y of these walks points down
_SIZE = 1.7  # m per unit of the map
# Noise of a sample and bias: rad/s, m/s^2.
_GYROSCOPE, _ACCELEROMETER = (2e-3, 0.02), (0.03, 0.2)
_STEP = 1e-3  # s, of differences


def weighing(seed: int, walks: int = 8) -> Iterator[str]:
    """Maps of walks, each with an IMU of its own."""
    yield "walk   scale (%)    +-     gravity (deg)   +-    offset (ms)   +-"
    scales, tilts, landmarks = [], [], []
    for k in range(walks):
        rng = np.random.default_rng([seed, k])
        errors, deviations, of_landmarks = _weighed(rng)
        landmarks.append(of_landmarks)
        scales.append(errors[0] / deviations[0])
        tilts.append(errors[1])
        yield (
            f"{k:4} {100 * errors[0]:+10.2f} {100 * deviations[0]:7.2f} {errors[1]:14.3f} "
            f"{deviations[1]:7.3f} {1e3 * errors[2]:+10.2f} {1e3 * deviations[2]:7.2f}"
        )
    rms = np.sqrt(np.mean(np.square(scales)))
    yield f"errors of the scale by deviations {rms:.2f} (rms), gravity {np.median(tilts):.3f} deg"
    inside = (100.0 * np.mean(np.concatenate(landmarks) < q) for q in (1.0, 1.96, 3.0))
    yield "coordinates of landmarks inside 68, 95, 99.7 %: {:.1f}, {:.1f}, {:.1f}".format(*inside)


def _weighed(rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Errors of scale (share), gravity (deg), offset (s), their deviations, and the landmarks'
    errors by their own (n,3).
    """
    camera, walk, points = Camera(), a_walk(rng, 0.5), walls(rng, 1500)
    film = Film(camera, walk, np.arange(0.0, _SECONDS, 1.0 / _IMAGES))
    start = film.near(points, _OFF, rng)
    small = replace(start, points=start.points / _SIZE, positions=start.positions / _SIZE)
    refined = refine(estimators_camera(camera, _READOUT), film.see(points, _NOISE, rng, 80), small)
    offset = float(rng.uniform(-0.02, 0.02))
    found = inertial_metres(refined, _imu(walk, offset, rng))
    own, true = refined.points[refined.refined], points[refined.refined]
    truth, variances = (
        through(own, true),
        np.einsum("nii->ni", refined.covariances[refined.refined]),
    )
    down = truth.rotation @ found.metric.gravity
    tilt = np.degrees(np.arctan2(np.hypot(down[0], down[2]), down[1]))
    return (
        np.array([found.metric.scale / truth.scale - 1.0, tilt, found.mount.mount.delay - offset]),
        np.array([
            found.share, np.degrees(found.metric.gravity_deviation), found.mount.delay_deviation,
        ]),
        np.abs(own - through(true, own)(true)) / np.sqrt(variances),
    )  # fmt: skip


def _imu(walk: Walk, offset: float, rng: np.random.Generator) -> ImuRecording:
    """An IMU anywhere on the camera, by differences of the walk."""
    stamps = np.arange(-0.6, _SECONDS + 0.6, 1.0 / _SAMPLES)
    times, lever = stamps + offset, rng.uniform(-0.06, 0.06, 3)
    turn = exponential(rng.normal(0.0, 1.0, (1, 3)))[0]
    (before, first), (now, middle), (after, last) = (
        _placed(walk, times + shift, lever) for shift in (-_STEP, 0.0, _STEP)
    )
    rates = logarithm(np.swapaxes(before, 1, 2) @ after) / (2.0 * _STEP)
    forces = (last - 2.0 * middle + first) / _STEP**2 - _GRAVITY
    own = [rates, np.einsum("nji,nj->ni", now, forces)]
    for k, (noise, bias) in enumerate((_GYROSCOPE, _ACCELEROMETER)):
        own[k] = own[k] @ turn + rng.normal(0.0, noise, own[k].shape) + rng.normal(0.0, bias, 3)
    return ImuRecording(
        10**12 + np.round(1e9 * stamps).astype(np.int64), own[0], specific_forces=own[1]
    )


def _placed(walk: Walk, times: Array, lever: Array) -> tuple[Array, Array]:
    turns, places = walk.poses(times)
    return turns, places + turns @ lever
