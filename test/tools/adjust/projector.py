# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of a hand for the tests of tools, by the camera of the independent simulator.

Motion: sums of sines in each of three rotation angles and three coordinates.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.independent.cameras import Camera as TrueCamera
from benchmarks.independent.cameras import Scan
from rs_localizer.core.camera import Camera

TRUE = TrueCamera(distortion=(-0.12, 0.04, 0.001, -0.0015, 0.0))
# Along columns (0) or rows (1) of the image, and the other way.
SCANS = {(1, False): Scan.DOWN, (1, True): Scan.UP, (0, False): Scan.RIGHT, (0, True): Scan.LEFT}


def make_camera(**changes: object) -> Camera:
    """The true camera as it is calibrated, whose shutter is not known."""
    return Camera(TRUE.width, TRUE.height, TRUE.matrix, np.array(TRUE.distortion), **changes)


@dataclass(frozen=True)
class Motion:
    """Sums of sines: amplitudes, frequencies (rad/s) and phases, each (6, k)."""

    amplitudes: np.ndarray
    frequencies: np.ndarray
    phases: np.ndarray

    @staticmethod
    def random(rng: np.random.Generator, turn: float = 0.14, way: float = 0.08) -> "Motion":
        """Hand motion: some 70 deg/s and 9 rad/s^2 at the default."""
        shape = (6, 4)
        frequencies = 2.0 * np.pi * rng.uniform(0.3, 2.0, shape)
        scale = np.repeat([turn, way], 3)[:, None]
        return Motion(
            scale * rng.uniform(0.5, 1.0, shape), frequencies, rng.uniform(0.0, 6.28, shape)
        )

    def poses(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """map_from_camera rotations (n,3,3) and camera centres (n,3) at times (n,)."""
        t = np.asarray(t, float)[:, None, None]
        x = np.sum(self.amplitudes * np.sin(self.frequencies * t + self.phases), axis=2)
        return Rotation.from_rotvec(x[:, :3]).as_matrix(), x[:, 3:]

    def twist(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Body rate (n,3) and velocity in the map (n,3), by differences."""
        h = 1e-5
        (r0, p0), (r1, p1) = self.poses(t - h), self.poses(t + h)
        turned = Rotation.from_matrix(np.swapaxes(r0, 1, 2) @ r1).as_rotvec()
        return turned / (2 * h), (p1 - p0) / (2 * h)


def expose(
    motion: Motion, stamp: float, readout: float, points: np.ndarray, axis: int = 1
) -> np.ndarray:
    """Pixels (n,2) of points on a rolling shutter whose first row (axis 1) or column (axis 0)
    is exposed at ``stamp``; a negative readout time runs the other way, still from ``stamp`` on.
    """
    camera = replace(TRUE, readout_time=abs(readout), scan=SCANS[axis, readout < 0.0])

    def local_at(delay: np.ndarray) -> np.ndarray:
        rotations, centres = motion.poses(stamp + np.nan_to_num(delay))
        return np.einsum("nji,nj->ni", rotations, points - centres)

    pixels = camera.project_rolling(local_at, (len(points),))
    shown = np.all((pixels > 0.0) & (pixels < (TRUE.width - 1.0, TRUE.height - 1.0)), axis=1)
    return np.where(shown[:, None], pixels, np.nan)


def room(rng: np.random.Generator, count: int = 600) -> np.ndarray:
    """Points all over the view, 1.5 to 5 m away."""
    z = rng.uniform(1.5, 5.0, count)
    return np.column_stack(
        [z * rng.uniform(-1.4, 1.4, count), z * rng.uniform(-1.1, 1.1, count), z]
    )


def board(columns: int = 8, rows: int = 6, square: float = 0.12, depth: float = 1.2) -> np.ndarray:
    """A plane that faces the resting camera."""
    x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    return np.column_stack([square * x.ravel(), square * y.ravel(), np.full(x.size, depth)])


@dataclass(frozen=True)
class Frame:
    stamp: float  # s, first row
    points: np.ndarray  # (n,3)
    pixels: np.ndarray  # (n,2)
    good: np.ndarray  # (n,) no outlier


def record(
    rng: np.random.Generator, motion: Motion, points: np.ndarray, *, readout: float = 0.03,
    seconds: float = 5.0, rate: float = 30.0, noise: float = 0.3, count: int = 80,
    outliers: float = 0.0, axis: int = 1,
) -> list[Frame]:  # fmt: skip
    """The frames of a recording with Gaussian noise and uniform outliers."""
    frames = []
    for stamp in np.arange(0.0, seconds, 1.0 / rate):
        pixels = expose(motion, float(stamp), readout, points, axis)
        seen = rng.permutation(np.flatnonzero(np.isfinite(pixels[:, 0])))[:count]
        found = pixels[seen] + rng.normal(0.0, noise, (len(seen), 2))
        bad = rng.random(len(seen)) < outliers
        found[bad] = rng.uniform(
            (0.0, 0.0), (TRUE.width - 1.0, TRUE.height - 1.0), (int(bad.sum()), 2)
        )
        frames.append(Frame(float(stamp), points[seen], found, ~bad))
    return frames
