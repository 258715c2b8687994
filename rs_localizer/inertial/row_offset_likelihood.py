# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Likelihood of turns of a frame's rows, whichever time offset is supposed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.rig import Rig
from rs_localizer.core.shutter import Motion
from rs_localizer.core.state import ACCELERATIONS, PARAMETERS, TURN, VELOCITIES
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.observations import lines_about
from rs_localizer.estimation.refine import LEAST_NOISE

# More points take longer than they are worth, fewer say nothing.
_MOST_POINTS, _LEAST_POINTS = 48, 12
# What velocities and accelerations may be beside an estimate, rad and m per readout, and per
# readout squared: as good as nothing, but planes leave some of them to chance.
_LOOSE_VELOCITY, _LOOSE_ACCELERATION = 0.1, 0.05
_TINY = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class RowOffsetLikelihood:
    """The errors of n points of a frame about its motion, and what they depend on."""

    middle_ns: int
    rotation: Array  # (3,3) camera_from_map at the middle row
    deviation: float  # rad, of its axes
    errors: Array  # (n,2) noise deviations
    by_turn: Array  # (n,2,3) of the errors, by a turn of the camera at this row alone
    # (n,2,18) orthonormal columns: what the motion explains; and from them to its rotation (3,18)
    base: Array
    to_rotation: Array
    rows: Array  # (n,) s since the middle row
    turned: Array  # (n,3,3) turns from the middle row to each, that the motion supposes


def row_offset_likelihood(
    camera: Camera, points: ArrayLike, pixels: ArrayLike, found: Estimate, middle_ns: int
) -> RowOffsetLikelihood | None:
    """Likelihood by the inliers of a frame; None where they are too few.

    Args:
        points, pixels: as they were localized, (n,3) and (n,2).
    """
    chosen = np.flatnonzero(found.inliers)
    chosen = chosen[:: 1 + (len(chosen) - 1) // _MOST_POINTS]
    if len(chosen) < _LEAST_POINTS:
        return None
    given = np.asarray(points, float)[chosen], np.asarray(pixels, float)[chosen]
    motion = found.without_gyro()
    errors, by_motion, by_turn, tau, _ = lines_about(
        Rig.of(camera).exposure(), *given, motion, found.turn
    )
    noise = max(float(np.sqrt(np.mean(errors**2))), LEAST_NOISE)
    free = by_motion.reshape(-1, PARAMETERS) / noise
    held = np.zeros(PARAMETERS)
    held[VELOCITIES], held[ACCELERATIONS] = 1.0 / _LOOSE_VELOCITY, 1.0 / _LOOSE_ACCELERATION
    stacked = np.concatenate([free, np.diag(held)])
    scale = np.sqrt(np.einsum("ni,ni->i", stacked, stacked)) + _TINY
    base, triangle = np.linalg.qr(stacked / scale)
    if not np.abs(np.diag(triangle)).min() > _TINY:
        return None
    back = (np.linalg.inv(triangle) / scale[:, None])[TURN]
    own = Motion(np.eye(3), np.zeros(3), motion.angular_velocity, np.zeros(3),
                 angular_acceleration=motion.angular_acceleration)  # fmt: skip
    turned = own.at_rows(tau)[0]
    if found.turn is not None:
        turned = found.turn.at_rows(tau)[0] @ turned
    return RowOffsetLikelihood(
        middle_ns,
        found.rotation,
        float(np.sqrt(np.sum(back**2) / 3.0)),
        errors / noise,
        by_turn / noise,
        np.ascontiguousarray(base[: 2 * len(tau)]).reshape(-1, 2, PARAMETERS),
        np.ascontiguousarray(back),
        camera.readout_time * tau,
        np.ascontiguousarray(turned),
    )
