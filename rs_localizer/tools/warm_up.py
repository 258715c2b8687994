# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A small recording through calibration and smoothing, so that their kernels are there."""

from __future__ import annotations

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import project_rolling
from rs_localizer.core.types import Estimate
from rs_localizer.io.imu import ImuRecording
from rs_localizer.tools.adjust.observe import Observed, localize_each
from rs_localizer.tools.calibration import calibrate
from rs_localizer.tools.smoothing import smooth

_K = np.array([[300.0, 0.0, 159.5], [0.0, 300.0, 119.5], [0.0, 0.0, 1.0]])
# As few images and points as make a board whose shape is free, and an IMU that goes with them.
_IMAGES, _POINTS, _RATE, _READOUT_TIME = 42, 20, 30.0, 0.02
_SAMPLES, _SAMPLE_RATE = 560, 400.0
_START_NS = 1_000_000_000  # stamps of 0 mean "none"


def warm_up() -> None:
    """Compile every kernel of ``calibrate`` and ``smooth``, or load it from the cache."""
    camera = Camera(width=320, height=240, K=_K, readout_time=_READOUT_TIME)
    images = _seen_by(camera)
    calibrate(camera, images, imu=_gyroscope())
    localized = list(zip(images, localize_each(camera, images), strict=True))
    posed = [(image, one) for image, one in localized if isinstance(one, Estimate)]
    smoothed = smooth(camera, [image for image, _ in posed], [one for _, one in posed])
    smoothed.sample(np.array([image.stamp_ns for image, _ in posed]))


def _angles(times: Array) -> Array:
    """Rotation vectors (n,3) of the camera in the map, which turns about all axes."""
    rates, starts = np.array([5.0, 6.0, 7.0]), np.array([0.0, 1.0, 2.0])
    angles: Array = 0.1 * np.sin(times[:, None] * rates + starts)
    return angles


def _poses(times: Array) -> tuple[Array, Array]:
    """Rotations (n,3,3) and translations (n,3), camera_from_map; the camera swings to and fro."""
    rotations = so3.exp_many(-_angles(times))
    centres = 0.1 * np.cos(times[:, None] * np.array([4.0, 5.0, 3.0]))
    return rotations, -np.einsum("nij,nj->ni", rotations, centres)


def _seen_by(camera: Camera) -> list[Observed]:
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.9, -0.6, 3.0), (0.9, 0.6, 5.0), (_POINTS, 3))
    images = []
    for k in range(_IMAGES):
        middle = k / _RATE - camera.first_row_time * _READOUT_TIME

        def poses_at(tau: Array, middle: float = middle) -> tuple[Array, Array]:
            return _poses(middle + tau * _READOUT_TIME)

        pixels = project_rolling(camera, poses_at, points)[0] + rng.normal(0.0, 0.3, (_POINTS, 2))
        visible = np.isfinite(pixels).all(axis=1) & camera.inside(pixels)
        stamp_ns = _START_NS + round(k * 1e9 / _RATE)
        images.append(Observed(stamp_ns, points[visible], pixels[visible]))
    return images


def _gyroscope() -> ImuRecording:
    times, step = np.arange(_SAMPLES) / _SAMPLE_RATE, 1e-4
    turns = np.swapaxes(so3.exp_many(_angles(times - step)), 1, 2) @ so3.exp_many(
        _angles(times + step)
    )
    rates = np.array([so3.log(np.ascontiguousarray(turn)) for turn in turns]) / (2.0 * step)
    noise = np.random.default_rng(1).normal(0.0, 0.01, rates.shape)
    return ImuRecording(_START_NS + np.round(times * 1e9).astype(np.int64), rates + noise)
