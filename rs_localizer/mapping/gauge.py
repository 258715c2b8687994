"""Where a map is when nothing outside of it says so: position, orientation and size.

While map and motion are adjusted the camera's positions and orientations hold them, on average,
where they were. The result is then laid over the map as it was given, by the similarity that fits
best; and the covariances are those of a map that is held so (free network, Baarda's S-transform:
Teunissen, *Zero order design*, in Optimization and design of geodetic networks, 1985).
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.mapping.similarity import Similarity, through
from rs_localizer.trajectory.spline import Spline

# The whole may float so far while it is adjusted, by its size: loose enough to cost nothing.
_FLOAT = 1e-3
_ROUNDS, _OUTLIERS = 5, 4.0


def laid_over(points: Array, onto: Array, usable: BoolArray) -> tuple[Similarity, BoolArray]:
    """The similarity of the landmarks that hardly changed, and which (n,) these are."""
    kept = usable
    found = through(points[kept], onto[kept])
    for _ in range(_ROUNDS):
        off = np.linalg.norm(found(points) - onto, axis=1)
        kept = usable & (off <= _OUTLIERS * max(float(np.median(off[usable])), 1e-12))
        found = through(points[kept], onto[kept])
    return found, kept


class Floating:
    """Seven directions in which map and motion move as a whole, held by the controls' start."""

    def __init__(self, start: Spline, shared: int) -> None:
        self._start, self._shared = start, shared
        self._arms = start.positions - start.positions.mean(axis=0)
        self._squared = max(float(np.sum(self._arms**2)), 1e-12)
        size = np.sqrt(self._squared / len(self._arms))
        self._weights = 1.0 / (_FLOAT * np.array([size, size, size, 1.0, 1.0, 1.0, 1.0]))

    def terms(self, spline: Spline) -> tuple[Array, Array]:
        """Whitened derivatives (N,7) and errors (7,): mean shift, mean turn, relative size."""
        count = len(spline.positions)
        shift = spline.positions - self._start.positions
        turned = spline.rotations @ np.swapaxes(self._start.rotations, 1, 2)
        turns = Rotation.from_matrix(turned).as_rotvec()
        size = np.sum(self._arms * shift) / self._squared
        errors = np.concatenate([shift.mean(axis=0), turns.mean(axis=0), [size]])
        by = np.zeros((count, 6, 7))
        by[:, 3:, :3] = np.eye(3) / count
        by[:, :3, 3:6] = np.swapaxes(spline.rotations, 1, 2) / count
        by[:, 3:, 6] = self._arms / self._squared
        held = np.concatenate([by.reshape(-1, 7), np.zeros((self._shared, 7))])
        return held * self._weights, errors * self._weights


def generators(points: Array, middle: Array) -> Array:
    """How points (n,3) move with shift, turn and size of the whole about a middle: (n,3,7)."""
    arms = points - middle
    motions = np.zeros((len(points), 3, 7))
    motions[:, :, :3] = np.eye(3)
    motions[:, :, 3:6] = -so3.hat(arms)
    motions[:, :, 6] = arms
    return motions


def as_held(covariances: Array, spread: Array, every: Array, of_kept: Array) -> Array:
    """Covariances (n,3,3) of points when the kept ones hold the whole.

    Args:
        covariances: in another gauge.
        spread: (n,3,7) the covariance of all points times ``of_kept``.
        every: (n,3,7) the generators.
        of_kept: (n,3,7) likewise, zeros for points that do not hold the whole.
    """
    # The whole's shift, turn and size in terms of the points: inverse sum of_kept^T x.
    inverse = np.linalg.inv(np.einsum("nij,nik->jk", of_kept, of_kept))
    crossed = every @ inverse @ np.swapaxes(spread, 1, 2)
    of_whole = inverse @ np.einsum("nij,nik->jk", of_kept, spread) @ inverse
    out: Array = (
        covariances - crossed - np.swapaxes(crossed, 1, 2)
        + every @ of_whole @ np.swapaxes(every, 1, 2)
    )  # fmt: skip
    return out
