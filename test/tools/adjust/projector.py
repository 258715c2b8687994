# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A rolling-shutter camera of the tests' own: nothing of it is the package's code.

Motion: sums of sines in each of three rotation angles and three coordinates. Lens: pinhole with
radial and tangential distortion. The row of each point is found by bisection.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT, FOCAL = 640, 480, 420.0
K = np.array([[FOCAL, 0.0, 321.3], [0.0, FOCAL + 3.0, 236.8], [0.0, 0.0, 1.0]])
D = np.array([-0.12, 0.04, 0.001, -0.0015, 0.0])


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

    def pose(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """map_from_camera rotations (n,3,3) and camera centres (n,3) at times (n,)."""
        t = np.asarray(t, float)[:, None, None]
        x = np.sum(self.amplitudes * np.sin(self.frequencies * t + self.phases), axis=2)
        return Rotation.from_rotvec(x[:, :3]).as_matrix(), x[:, 3:]

    def twist(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Body rate (n,3) and velocity in the map (n,3), by differences."""
        h = 1e-5
        (r0, p0), (r1, p1) = self.pose(t - h), self.pose(t + h)
        turned = Rotation.from_matrix(np.swapaxes(r0, 1, 2) @ r1).as_rotvec()
        return turned / (2 * h), (p1 - p0) / (2 * h)


def distort(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    r2 = x * x + y * y
    radial = 1.0 + D[0] * r2 + D[1] * r2 * r2
    u = x * radial + 2.0 * D[2] * x * y + D[3] * (r2 + 2.0 * x * x)
    v = y * radial + D[2] * (r2 + 2.0 * y * y) + 2.0 * D[3] * x * y
    return np.stack([K[0, 0] * u + K[0, 2], K[1, 1] * v + K[1, 2]], axis=-1)


def project(motion: Motion, t: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Pixels (n,2) of points (n,3), each at its own time (n,); NaN behind the camera."""
    rotations, centres = motion.pose(t)
    local = np.einsum("nji,nj->ni", rotations, points - centres)
    z = np.where(local[:, 2] > 0.1, local[:, 2], np.nan)
    x, y = local[:, 0] / z, local[:, 1] / z
    wide = np.hypot(x, y) > 1.1  # beyond this the polynomial folds
    return np.where(wide[:, None], np.nan, distort(x, y))


def expose(
    motion: Motion, stamp: float, readout: float, points: np.ndarray, axis: int = 1
) -> np.ndarray:
    """Pixels (n,2) of points on a rolling shutter whose first row (axis 1) or column (axis 0)
    is exposed at ``stamp``; a negative readout time runs the other way, still from ``stamp`` on.
    """
    size = (WIDTH, HEIGHT)[axis]
    low, high = np.zeros(len(points)), np.full(len(points), abs(readout))
    with np.errstate(invalid="ignore"):
        for _ in range(60):
            middle = 0.5 * (low + high)
            place = project(motion, stamp + middle, points)[:, axis] / (size - 1)
            late = (place if readout >= 0 else 1.0 - place) * abs(readout) > middle
            low, high = np.where(late, middle, low), np.where(late, high, middle)
        pixels = project(motion, stamp + 0.5 * (low + high), points)
        place = pixels[:, axis] / (size - 1)
        place = place if readout >= 0 else 1.0 - place
        missed = np.abs(place * abs(readout) - 0.5 * (low + high)) > 1e-7 + 1e-6 * abs(readout)
        inside = np.all((pixels > 0.0) & (pixels < (WIDTH - 1.0, HEIGHT - 1.0)), axis=1)
    return np.where((inside & ~missed)[:, None], pixels, np.nan)


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
        found[bad] = rng.uniform((0.0, 0.0), (WIDTH - 1.0, HEIGHT - 1.0), (int(bad.sum()), 2))
        frames.append(Frame(float(stamp), points[seen], found, ~bad))
    return frames
