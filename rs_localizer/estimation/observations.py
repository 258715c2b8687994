"""The points of one frame, packed once for all kernels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.estimation.packing import pack, thin
from rs_localizer.estimation.residuals import row_paces, squared_errors


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """The points of one frame, ready for the kernels."""

    points: Array  # (n,3) m, in a frame near them
    rays: Array  # (n,2)
    tau: Array  # (n,)
    row_range: float  # of tau
    row_time_gradient: Array  # (2,) per pixel
    packed: Array

    @classmethod
    def of(
        cls, points: Array, rays: Array, tau: Array, by_ray: Array, row_time_gradient: Array
    ) -> Observations:
        """Pack points (n,3), rays (n,2), row times (n,) and pixel derivatives (n,2,2)."""
        packed = pack(points, rays, tau, by_ray)
        return cls(points, rays, tau, float(np.ptp(tau)), row_time_gradient, packed)

    def thinned(self, count: int) -> Observations:
        """So many of the points, evenly taken."""
        chosen = np.linspace(0, len(self) - 1, count).astype(np.int64)
        packed = thin(self.packed, chosen)
        return Observations(
            self.points[chosen], self.rays[chosen], self.tau[chosen], self.row_range,
            self.row_time_gradient, packed,
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.points)

    def squared_errors(self, state: Array) -> Array:
        """Squared reprojection errors (n,) in raw pixels."""
        errors: Array = squared_errors(self.packed, len(self), state, self.row_time_gradient)
        return errors

    def row_paces(self, state: Array) -> Array:
        """How much faster than the image points the rows move (n,): 1 at rest, 0 in step."""
        paces: Array = row_paces(self.packed, len(self), state, self.row_time_gradient)
        return paces
