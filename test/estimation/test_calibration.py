# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What errors of the calibration do to poses, and that their covariances say so."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import rs_localizer as rsl
from rs_localizer.config import CalibrationErrors
from rs_localizer.core.shutter import project_rolling
from rs_localizer.estimation.calibration import ErrorModes, _columns

from ..moving import AT_REST, board, error_of, pinhole, squared  # noqa: TID252 - package "test"
from .frames import differences

CAMERA = pinhole(450.0, readout_time=0.02)
EXACT = CalibrationErrors(0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize("coefficients", [0, 5, 8, 12])
def test_errors_of_a_lens_move_pixels_as_differences_of_opencv_say(coefficients):
    """By focal length and distortion, of which one deviation moves the image's corners."""
    rng = np.random.default_rng(coefficients)
    K = np.array([[430.0, 0.0, 310.0], [0.0, 470.0, 250.0], [0.0, 0.0, 1.0]])
    D = rng.uniform(-0.05, 0.05, coefficients)
    rays = rng.uniform([-0.7, -0.5], [0.7, 0.5], (20, 2))
    deviation = CalibrationErrors(0.7, 0.01, 1.3, 0.02)
    model = "rational_polynomial" if coefficients > 5 else "plumb_bob"
    found = _columns(rsl.Camera(640, 480, K, D=D, distortion_model=model), rays, deviation)

    def pixels(by):
        """Of a focal length and a k1 that are off by so much."""
        lens = np.append(D, np.zeros(max(5 - len(D), 0)))
        lens[0] += by[1]
        points = np.column_stack([rays, np.ones(len(rays))])
        scaled = K * [[1.0 + by[0], 1.0, 1.0], [1.0, 1.0 + by[0], 1.0], [1.0, 1.0, 1.0]]
        return cv2.projectPoints(points, np.zeros(3), np.zeros(3), scaled, lens)[0][:, 0]

    by_focal, by_k1 = np.moveaxis(differences(pixels, 2, 1e-5), -1, 0)
    focal = np.sqrt(K[0, 0] * K[1, 1])
    corner = 400.0 / focal  # focal lengths, of 640 x 480
    k1 = 1.3 / (focal * corner**3)
    for column, expected in enumerate((
        0.7 * np.tile([1.0, 0.0], (20, 1)), 0.7 * np.tile([0.0, 1.0], (20, 1)), 0.01 * by_focal,
        k1 * by_k1, 0.01 * by_focal * [-1.0, 1.0],
    )):  # fmt: skip
        np.testing.assert_allclose(found[:, :, column], expected, rtol=1e-6, atol=1e-6)


def off(principal_point: float = 0.0, focal_length: float = 0.0) -> rsl.Camera:
    """The camera as a calibration has it that is off by so much."""
    K = CAMERA.K * np.diag([1.0 + focal_length, 1.0 + focal_length, 1.0])
    K[:2, 2] = CAMERA.K[:2, 2] + principal_point
    return replace(CAMERA, K=K)


def frame(seed: int, depth: float, noise: float = 0.3) -> tuple[np.ndarray, np.ndarray, rsl.Motion]:
    """Points of a room 3 m away, so many metres deep, and their pixels."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-2.0, -1.5, 0.0], [2.0, 1.5, depth], (100, 3))
    rotation = Rotation.from_rotvec(rng.normal(scale=0.15, size=3)).as_matrix()
    motion = rsl.Motion(rotation, [0.0, 0.0, 3.0], *rng.normal(scale=0.01, size=(2, 3)))
    pixels, _ = project_rolling(CAMERA, motion.at_rows, points)
    seen = CAMERA.inside(pixels)
    return points[seen], pixels[seen] + rng.normal(scale=noise, size=(seen.sum(), 2)), motion


def bent(points: np.ndarray, seed: int) -> np.ndarray:
    """The points as a map has them that is bent by waves of 1 cm, four to six metres long."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(size=(3, 3))
    waves *= 2.0 * np.pi / rng.uniform(4.0, 6.0, (3, 1)) / np.linalg.norm(waves, axis=1)[:, None]
    off = np.sin(points @ waves.T + rng.uniform(0.0, 2.0 * np.pi, 3))
    return points + 0.01 * np.sqrt(2.0) * off


Mapped = tuple[np.ndarray, ErrorModes | None]


def inside(
    localizer: rsl.Localizer, depth: float, frames: int = 40,
    mapped: Callable[[np.ndarray, int], Mapped] = lambda points, _: (points, None),
    noise: float = 0.3, least: float = 1.0,
) -> float:  # fmt: skip
    """Share of poses within their 95 % regions; of the frames at least so many have one."""
    held = []
    for seed in range(frames):
        points, pixels, true = frame(seed, depth, noise)
        landmarks, modes = mapped(points, seed)
        found = localizer.accepted(
            localizer.find(localizer.sights(landmarks, pixels), error_modes=modes)
        )
        if not found:
            assert least < 1.0, str(found)
            continue
        error = error_of(found, true)[:6]
        held.append(squared(error, found.covariance) < chi2.ppf(0.95, 6))
    assert len(held) >= least * frames
    return float(np.mean(held))


def test_regions_hold_in_a_map_that_tells_which_errors_its_landmarks_share():
    """Eight waves of 2 mm, too long to show as smooth errors; untold, 0.28 are inside."""
    localizer = rsl.Localizer(CAMERA, calibration=EXACT)

    def told(points: np.ndarray, seed: int) -> Mapped:
        rng = np.random.default_rng(100 + seed)
        waves, phases = 0.5 * rng.normal(size=(3, 8)), rng.uniform(0.0, 2.0 * np.pi, 8)
        modes = 0.002 * np.sin(points @ waves + phases)[:, None] * rng.normal(size=(3, 8))
        landmarks = points + modes @ rng.normal(size=8)
        return landmarks, ErrorModes(landmarks, modes)

    def untold(points: np.ndarray, seed: int) -> Mapped:
        return told(points, seed)[0], None

    assert inside(localizer, 2.0, mapped=told) >= 0.9
    assert inside(localizer, 2.0, 15, untold, least=0.9) < 0.6


def test_errors_of_a_map_are_those_of_the_nearest_landmark_if_it_is_near():
    rng = np.random.default_rng(0)
    wall, row = rng.uniform(0.0, 3.0, (500, 3)), np.linspace([0.0, 0.0, 1.0], [0.0, 0.0, 9.0], 90)
    wall[:, 1] = 2.0
    landmarks = np.vstack([wall, wall[:100] + rng.normal(0.0, 4e-4, (100, 3)), row])
    modes = rng.normal(size=(len(landmarks), 3, 4)).astype(np.float32)
    points = np.vstack([landmarks, landmarks + rng.normal(0.0, 6e-4, landmarks.shape)])
    points = np.vstack([points, points.astype(np.float32), np.full((1, 3), 50.0)])
    distances, nearest = cKDTree(landmarks).query(points)
    expected = np.where((distances < 1e-3)[:, None, None], modes[nearest], 0.0)
    assert 300 < np.count_nonzero(distances > 1e-3) < len(points) / 2
    of_map = ErrorModes(landmarks, modes)
    np.testing.assert_array_equal(of_map.at(points), expected)
    assert of_map.at(points[:0]).shape == (0, 3, 4)


@pytest.mark.parametrize(
    ("depth", "errors"),
    [
        (2.0, {"principal_point": 1.0}),
        pytest.param(0.0, {"principal_point": 1.0}, marks=pytest.mark.bench),
        pytest.param(2.0, {"focal_length": 0.003}, marks=pytest.mark.bench),
        pytest.param(0.0, {"focal_length": 0.003}, marks=pytest.mark.bench),
    ],
)
def test_regions_hold_with_an_ordinary_calibration(depth, errors):
    camera = off(**errors)
    assert inside(rsl.Localizer(camera), depth) >= 0.9
    assert inside(rsl.Localizer(camera, calibration=EXACT), depth, 15) < 0.6


@pytest.mark.parametrize(("depth", "least"), [(2.0, 0.9), (0.0, 0.75)], ids=["room", "wall"])
def test_regions_hold_before_a_bent_map_that_is_declared(depth, least):
    """A map is off in metres, so by more pixels where it is near: the smooth error has a depth.

    In rooms 98 %, before walls 86 % of 200 are inside: waves are longer than expected of paper.
    """
    declared = rsl.Localizer(CAMERA, map_deviation=0.01, calibration=EXACT)
    assert inside(declared, depth, 30, lambda points, seed: (bent(points, seed), None)) >= least


def test_poses_before_a_curled_sheet_stay_in_their_regions():
    """A corner stands up by 1.5 cm, 50 times what is declared, and is left out in part."""
    camera = pinhole(2000.0, 1920, 1080, readout_time=0.02)
    localizer, flat = rsl.Localizer(camera, map_deviation=0.0003), board(13, 9, 0.3, 0.2)
    rise = np.clip(flat @ [1 / 0.15, 1 / 0.2, 0.0], 0.0, None) ** 2 / 2.25
    for seed in range(4):
        rng = np.random.default_rng(seed)
        turn = Rotation.from_rotvec(np.array([0.3, 0.2, 0.1]) * rng.uniform(-1.0, 1.0, 3))
        curled = flat - np.outer(rise, [0.0, 0.0, 0.015])
        pixels = camera.project(turn.apply(curled) + np.array([0.0, 0.0, 0.5]))
        found = localizer.localize(flat, pixels + rng.normal(0.0, 0.3, pixels.shape))
        assert found, found
        off = error_of(found, replace(AT_REST, rotation=turn.as_matrix()))[:3]
        assert squared(off, found.covariance) < 7.8  # 95 % of three degrees of freedom
        assert found.inliers.mean() > 0.9


def test_regions_before_a_wall_count_the_smooth_errors_of_all_modes():
    """Distortion that the lens has not, 1 to 2 px, for which half of the frames are refused."""
    distorted = rsl.Localizer(replace(CAMERA, D=np.array([0.03, 0.0, 0.0, 0.0, 0.0])))
    assert inside(distorted, 0.0, noise=1.0, least=0.4) >= 0.6
