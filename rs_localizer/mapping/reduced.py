"""The normal equations of a map and their solution: landmarks eliminated, the rest dense.

A landmark that is seen at distant times ties all controls of these times together, so that the
reduced system has no band. It is factored as a whole (LAPACK): 300 images on their own have 7200
unknowns, which is a few seconds and 0.4 GB.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_solve
from scipy.linalg.lapack import dpotrf, dpotri

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.mapping.elimination import Rows, covariances, eliminate, lift, lower, slopes
from rs_localizer.trajectory.banded import Undetermined
from rs_localizer.trajectory.normal_kernels import Normal

_WORKERS = 2


@dataclass(frozen=True, slots=True, eq=False)
class MapNormal:
    """Normal equations of motion, shared numbers and landmarks."""

    motion: Normal  # with the map as it is
    rows: Rows
    held: Array  # (N,7) whitened directions in which the whole would float
    held_error: Array  # (7,)


class Reduced:
    """A factored system.

    Args:
        normal: the normal equations.
        damping: the diagonal is multiplied by 1 + this (Levenberg and Marquardt).

    Raises:
        Undetermined: when the system is not positive definite.
    """

    def __init__(self, normal: MapNormal, damping: float = 0.0) -> None:
        self._rows = normal.rows._replace(damping=damping)
        self._controls = len(normal.motion.slope)
        self._slope = np.concatenate([normal.motion.slope, normal.motion.border_slope])
        self._slope += normal.held @ normal.held_error
        system, sequence = _dense(normal.motion, damping), _sequence(self._rows)
        with ThreadPoolExecutor(_WORKERS) as workers:
            for _ in workers.map(
                lambda part: eliminate(self._rows, sequence, part, _WORKERS, system),
                range(_WORKERS),
            ):
                pass
        system += normal.held @ normal.held.T
        # LAPACK counts along columns: the lower triangle is its upper one.
        self._factor, failed = dpotrf(system.T, lower=0, overwrite_a=1, clean=0)
        if failed:
            raise Undetermined("the images do not determine map and motion")

    @property
    def size(self) -> int:
        """Number N of controls' and shared numbers."""
        return len(self._slope)

    def solve(self, right: Array, landmarks: Array) -> tuple[Array, Array]:
        """Solutions (N,m) and (p,3,m) for right sides of these shapes."""
        reduced, own = np.zeros_like(right), landmarks.copy()
        lift(self._rows, landmarks, reduced)
        reduced = cho_solve((self._factor, False), right - reduced, check_finite=False)
        lower(self._rows, reduced, own)
        return reduced, own

    def step(self) -> tuple[Array, Array, Array]:
        """The step (6 n,) of the controls, (s,) of the shared numbers, (p,3) of the landmarks."""
        own = np.empty((len(self._rows.precisions), 3))
        slopes(self._rows, own)
        reduced, landmarks = self.solve(-self._slope[:, None], -own[:, :, None])
        return reduced[: self._controls, 0], reduced[self._controls :, 0], landmarks[:, :, 0]

    def covariances(self) -> tuple[Array, Array]:
        """Of each landmark (p,3,3) and of the shared numbers (s,s); the factors are used up."""
        inverse, failed = dpotri(self._factor, lower=0, overwrite_c=1)
        if failed:
            raise Undetermined("the images do not determine map and motion")
        inverse, parts = inverse.T, np.array_split(_sequence(self._rows), _WORKERS)
        out = np.empty((len(self._rows.precisions), 3, 3))
        with ThreadPoolExecutor(_WORKERS) as workers:
            for _ in workers.map(lambda part: covariances(self._rows, part, inverse, out), parts):
                pass
        shared = np.tril(inverse[self._controls :, self._controls :])
        return out, shared + np.tril(shared, -1).T


def _sequence(rows: Rows) -> IntArray:
    """The landmarks (p,) by the first images that see them."""
    last = len(rows.order)
    seen = np.minimum(rows.starts[:-1], max(last - 1, 0))
    firsts = rows.first[rows.order[seen]] if last else rows.starts[:-1]
    return np.asarray(np.argsort(firsts, kind="stable"), np.int64)


def _dense(motion: Normal, damping: float) -> Array:
    """Lower triangle (N,N) of controls and shared numbers."""
    count = motion.band.shape[1]
    system = np.zeros((count + len(motion.corner),) * 2)
    for d in range(min(len(motion.band), count)):
        columns = np.arange(count - d)
        system[columns + d, columns] = motion.band[d, : count - d]
    system[count:, :count] = motion.cross.T
    system[count:, count:] = np.tril(motion.corner)
    diagonal = np.arange(len(system))
    system[diagonal, diagonal] *= 1.0 + damping
    return system
