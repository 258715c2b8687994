# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Lenses of more than 180 degrees, from points all around to poses, against pixels of their own.

The pixels are those of the papers' formulas along a motion of constant velocities, found row by
row: nothing of the package has a part in them.
"""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import rs_localizer as rsl
from rs_localizer.config import CalibrationErrors

from .core.test_lens_laws import PAPERS, WIDE
from .moving import error_of, squared

SIZE, FOCAL, READOUT = 800, 210.0, 0.03
K = np.array([[FOCAL, 0.0, 399.5], [0.0, FOCAL, 399.5], [0.0, 0.0, 1.0]])
WIDEST = math.radians(100.0)


def frame(rng, lens, count, noise, least=0.0):
    """Points (n,3) in the map, their pixels (n,2), and the true motion at the middle row."""
    D, _ = WIDE[lens]
    rotation, position = Rotation.random(random_state=rng), rng.uniform(-2.0, 2.0, 3)
    turn, speed = (of * rng.normal(size=3) / math.sqrt(3.0) for of in (1.2, 0.5))
    angle = np.arccos(rng.uniform(math.cos(WIDEST), math.cos(least), count))
    azimuth = rng.uniform(-math.pi, math.pi, count)
    across = np.sin(angle)
    unit = np.column_stack([across * np.cos(azimuth), across * np.sin(azimuth), np.cos(angle)])
    points = position + rotation.apply(rng.uniform(1.5, 5.0, (count, 1)) * unit)
    row = np.full(count, 0.5 * (SIZE - 1))
    for _ in range(20):
        time = READOUT * (row / (SIZE - 1) - 0.5)
        body = rotation.inv().apply(points - position) - time[:, None] * speed
        local = Rotation.from_rotvec(-time[:, None] * turn).apply(body)
        pixels = FOCAL * np.array([PAPERS[lens](*point, *D) for point in local]) + 399.5
        row = pixels[:, 1]
    pixels = pixels + noise * rng.normal(size=pixels.shape)
    shown = np.all((pixels > -0.5) & (pixels < SIZE - 0.5), axis=1)
    camera_from_map = rotation.inv().as_matrix()
    truth = rsl.Motion(
        camera_from_map, -camera_from_map @ position, READOUT * turn, READOUT * speed
    )
    return points[shown], pixels[shown], truth, angle[shown]


def camera(lens):
    return rsl.Camera(SIZE, SIZE, K, WIDE[lens][0], lens, readout_time=READOUT)


@pytest.mark.parametrize("lens", WIDE)
def test_points_beyond_90_degrees_are_as_good_as_others(lens):
    rng = np.random.default_rng(7)
    exact = rsl.LocalizerConfig(calibration=CalibrationErrors(0.0, 0.0, 0.0, 0.0))
    localizer, squares, used = rsl.Localizer(camera(lens), exact), [], []
    for _ in range(15):
        points, pixels, motion, angle = frame(rng, lens, 150, 0.5)
        wrong = rng.uniform(size=len(pixels)) < 0.2
        pixels[wrong] = rng.uniform(0.0, SIZE - 1.0, (wrong.sum(), 2))
        result = localizer.localize(points, pixels)
        assert result
        squares.append(squared(error_of(result, motion)[:6], result.covariance))
        behind = (angle > math.radians(92.0)) & ~wrong
        used.extend(result.inliers[behind])
    assert len(used) > 40
    assert np.mean(used) > 0.95
    assert np.mean(np.array(squares) < chi2.ppf(0.95, 6)) > 0.8
    assert np.mean(squares) < 9.0  # 6 is as claimed


def test_eight_points_all_around_have_a_pose():
    rng, localizer, squares = np.random.default_rng(3), rsl.Localizer(camera("equidistant")), []
    for _ in range(30):  # of some, no side of a cube about the camera shows three
        points, pixels, motion, _ = frame(rng, "equidistant", 100, 0.1)
        some = rng.choice(len(points), 8, replace=False)
        result = localizer.localize(points[some], pixels[some])
        assert result
        squares.append(squared(error_of(result, motion)[:6], result.covariance))
    assert max(squares) < 25.0
