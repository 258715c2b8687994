# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Keypoints on a spline: errors of reprojection and their derivatives, compiled.

A keypoint is compared with the projection of its landmark at the time of its own row. Noise moves
the keypoint to another row, too, so that the error has the covariance ``s^2 A A^T`` with
``A = I - flow g^T``: ``flow`` is the pixel's motion in one readout, ``g`` the row time's gradient.
Errors and derivatives are multiplied by the inverse of ``A`` and weighted by Tukey's biweight.
"""

from collections.abc import Mapping

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.tools.adjust.intrinsics import project
from rs_localizer.tools.adjust.row_kernels import (
    Curve,
    Projections,
    Terms,
    fill_rows,
    look,
    squared_errors,
)
from rs_localizer.tools.adjust.spline_kernels import CONTROL, LOCAL
from rs_localizer.tools.adjust.system import Rows
from rs_localizer.tools.adjust.variables import CameraView, Pieces, Unknowns

LIMIT = 6.0
"""Tukey's limit in standard deviations: 97 % efficient on Gaussian noise in two dimensions."""


class Reprojection:
    """The keypoints of one camera: a factor.

    Args:
        view: what the camera saw, and what of it is free.
        pieces: what of the map is free.
    """

    def __init__(self, view: CameraView, pieces: Pieces) -> None:
        self.camera, self.observations, self.pieces = view.camera, view.observations, pieces
        self.free = view.freedom
        self._last: tuple[Unknowns, Projections] | None = None

    def projections(self, curve: Curve, own: Unknowns) -> Projections:
        """Return all keypoints on the spline."""
        if self._last and self._last[0] is own:
            return self._last[1]
        seen = self.observations
        times = seen.times + own.delays[seen.frames] + own.readout_time * seen.row_times
        times = times + own.extrinsics.offset
        first, u = own.spline.layout.locate(times)
        local, velocity = np.empty((len(first), 3)), np.empty((len(first), 3))
        axes, centre = own.extrinsics.axes, own.extrinsics.centre
        look(curve, first, u, own.landmarks[seen.points], axes, centre, local, velocity)
        ahead = np.where(local[:, 2:] > 0.0, local, (0.0, 0.0, 1.0))
        seen_as = project(self.camera, own.lens, ahead, self.free.lens)
        arms = self.pieces.arms(own.landmarks)
        sights = Projections(
            first, u, seen.row_times, local, velocity, seen_as.pixels - seen.pixels,
            seen_as.by_ray, seen_as.by_lens, arms[seen.points], axes, centre,
        )  # fmt: skip
        self._last = own, sights
        return sights

    def terms(self, own: Unknowns, deviation: float) -> Terms:
        """Return the terms at a standard deviation of the noise (px)."""
        free, width = self.free, self.pieces.width if self.pieces.count else 0
        return Terms(
            float(own.readout_time), self.camera.row_time_gradient, free.readout_time, free.lens,
            free.mount, width, free.stamps > 0.0, deviation**2,
            (LIMIT * deviation) ** 2,
        )  # fmt: skip

    def squared_errors(self, curve: Curve, own: Unknowns) -> Array:
        """Return squared whitened errors (n,), px^2; infinite for keypoints without one."""
        sights = self.projections(curve, own)
        squared = np.empty(len(sights.first))
        squared_errors(sights, self.terms(own, 1.0), squared)
        return squared

    def rows(self, curve: Curve, own: Unknowns, at: Mapping[str, slice], deviation: float) -> Rows:
        """Return the whitened rows.

        Args:
            at: places of the camera's unknowns among all, by name.
            deviation: px, of the noise.
        """
        sights, seen = self.projections(curve, own), self.observations
        terms, count = self.terms(own, deviation), len(sights.first)
        shared = [at[name] for name in ("readout", "lens", "mount") if name in at]
        others = [np.tile(np.r_[(*shared, np.zeros(0, int))], (count, 1))]
        if terms.point_width:
            slots = self.pieces.slots[seen.points][:, None]
            places = at["points"].start + terms.point_width * slots + np.arange(terms.point_width)
            others.append(np.where(slots < 0, -1, places))
        if terms.delay_free:
            others.append(at["delays"].start + seen.frames[:, None])
        columns = np.ascontiguousarray(np.concatenate(others, axis=1), np.int64)
        values = np.empty((count, 2, LOCAL + columns.shape[1]))
        errors = np.empty((count, 2))
        cost = fill_rows(curve, sights, terms, values, errors)
        return Rows(values, CONTROL * sights.first, columns, errors, cost)
