# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Cameras, what they see while their rows are exposed, and errors: one builder for all tests.

Images are those of the independent projector, which shares no line with the package.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from benchmarks.aided import believed
from benchmarks.independent.cameras import Camera
from rs_localizer import data
from rs_localizer.io.trajectories import read_tum
from rs_localizer.tools.simulation.true_motion import RecordedMotion, TrueState, sampled_states

Pose = Callable[[np.ndarray], tuple[Rotation, np.ndarray]]
"""Rotations and places (n,3), map_from_camera, at times (n,) s from the middle row."""

PLAIN = Camera(focal=500.0, distortion=(0.0,) * 5)
AT_REST = rsl.Motion(np.eye(3), *np.zeros((3, 3)))


def camera_of(true: Camera, **changes: Any) -> rsl.Camera:
    """The camera as it is calibrated, or as these changes have it."""
    return replace(believed(true), **changes)


def pinhole(focal: float = 500.0, width: int = 640, height: int = 480, **more: Any) -> rsl.Camera:
    """A camera without distortion whose principal point is the middle of its image."""
    K = [[focal, 0.0, 0.5 * width - 0.5], [0.0, focal, 0.5 * height - 0.5], [0.0, 0.0, 1.0]]
    return rsl.Camera(width, height, K, **{"readout_time": 0.03} | more)


def board(columns: int, rows: int, width: float, height: float) -> np.ndarray:
    """Corners (n,3) of a flat board about its middle."""
    x, y = np.meshgrid(
        width * np.linspace(-0.5, 0.5, columns), height * np.linspace(-0.5, 0.5, rows)
    )
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def shown(true: Camera, pose: Pose, points: np.ndarray) -> np.ndarray:
    """Pixels (n,2) of points (n,3), each at the time of its own row; NaN where there is none."""

    def local_at(delay: np.ndarray) -> np.ndarray:
        rotation, place = pose(delay - 0.5 * true.readout_time)
        return rotation.inv().apply(points - place)

    return true.project_rolling(local_at, (len(points),))


def inside(true: Camera, pixels: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Which (n,) of pixels (n,2) lie in the image."""
    last = np.array([true.width, true.height]) - 1.0
    return ((pixels >= margin) & (pixels <= last - margin)).all(axis=1)


def resting(t: np.ndarray) -> tuple[Rotation, np.ndarray]:
    """The way of a camera that is the map all the time."""
    return Rotation.identity(len(t)), np.zeros((len(t), 3))


def before(way: Pose) -> Pose:
    """The way of a camera before which the map moves so: camera_from_map."""

    def inverse(t: np.ndarray) -> tuple[Rotation, np.ndarray]:
        rotation, place = way(t)
        return rotation.inv(), -rotation.inv().apply(place)

    return inverse


def recorded_hand() -> tuple[Pose, TrueState]:
    """The way of the bundled hand, in s after its start, and where it was all the time."""
    recorded = RecordedMotion(read_tum(data.path(data.HAND_MOTION)))

    def way(t: np.ndarray) -> tuple[Rotation, np.ndarray]:
        states = recorded.state(recorded.intervals_ns[0][0], np.nan_to_num(t[:, 0]))
        return Rotation.from_matrix(states.rotations), states.positions

    return way, sampled_states(recorded)


class Moving:
    """A camera on its way: rotations and places (n,3), map_from_camera, at times (n,1) in s."""

    def __init__(self, way: Pose, true: Camera = PLAIN) -> None:
        self.way, self.true = way, true

    def pose(self, t: Any) -> tuple[Rotation, np.ndarray]:
        return self.way(np.asarray(t, float)[..., None])

    def motion(self, t: float, step: float = 1e-5) -> rsl.Motion:
        """The truth at one moment, velocities per readout by differences."""
        turned, (place, before, later) = self.pose([t, t - step, t + step])
        rotation, per_readout = turned[0].inv().as_matrix(), 0.5 * self.true.readout_time / step
        turn = (turned[1].inv() * turned[2]).as_rotvec()
        way = rotation @ (later - before)
        return rsl.Motion(rotation, -rotation @ place, per_readout * turn, per_readout * way)

    def pixels(self, t: float, points: np.ndarray) -> np.ndarray:
        """Pixels (n,2) of points (n,3) in an image whose middle row is exposed at t."""
        return shown(self.true, lambda after: self.pose(t + after), points)

    def frame(
        self, t: float, points: np.ndarray, count: int, noise: float = 1.0, outliers: float = 0.0,
        seed: int | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
        """Some points that an image shows, and their pixels: of outliers, the first, anywhere."""
        rng = np.random.default_rng(round(t * 1e4) if seed is None else seed)
        (rotation,), (place,) = self.pose([t])
        at_once = self.true.project(rotation.inv().apply(points - place))
        points = points[inside(self.true, at_once, margin=-150.0)]  # others take only time
        pixels = self.pixels(t, points)
        seen = np.flatnonzero(inside(self.true, pixels))
        seen = rng.choice(seen, min(count, len(seen)), replace=False)
        pixels = pixels[seen] + noise * rng.normal(size=(len(seen), 2))
        wrong = np.arange(len(seen)) < outliers * len(seen)
        last = self.true.width - 1, self.true.height - 1
        pixels[wrong] = rng.uniform([0, 0], last, (wrong.sum(), 2))
        return points[seen], pixels

    def error(self, found: Any, t: float) -> np.ndarray:
        """Errors (12,) of pose and velocities per readout, in the camera's axes."""
        return error_of(found, self.motion(t))


def error_of(found: Any, truth: rsl.Motion) -> np.ndarray:
    """Errors (12,) of pose and velocities, in the camera's axes, as a covariance has them."""
    turn = Rotation.from_matrix(found.rotation @ truth.rotation.T).as_rotvec()
    place = -truth.rotation.T @ truth.translation
    return np.concatenate([
        turn, found.rotation @ (place - found.position),
        truth.angular_velocity - found.angular_velocity,
        truth.linear_velocity - found.linear_velocity,
    ])  # fmt: skip


def estimate_at(motion: rsl.Motion = AT_REST, count: int = 5, **more: Any) -> rsl.Estimate:
    """A frame's estimate of this motion, whose points are all inliers; or with other fields."""
    names = ("rotation", "translation", "angular_velocity", "linear_velocity",
             "angular_acceleration", "linear_acceleration")  # fmt: skip
    usual = {"inliers": np.ones(count, bool), "residuals": np.zeros(count),
             "joint_covariance": 1e-4 * np.eye(18), "iterations": 0}  # fmt: skip
    return rsl.Estimate(**{name: getattr(motion, name) for name in names} | usual | more)


def squared(error: np.ndarray, covariance: np.ndarray) -> float:
    """Squared length of an error (n,) in deviations, by the first n of a covariance."""
    known = covariance[: len(error), : len(error)]
    return float(error @ np.linalg.solve(known, error))
