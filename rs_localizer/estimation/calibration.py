# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What errors of the calibration and of the map, the same in all frames, do to a pose.

Centre, focal length and distortion of an ordinary calibration have errors; so has a map that is
bent, or whatever else a smooth error was fitted for. No tracker averages them away: they join what
is published of a frame, and not what goes on to the next. To first order a calibration that moves
the pixels by ``b`` moves motion and smooth error by ``-H^-1 A^T b``, with the derivatives ``A`` of
the pixels by both and the information ``H = A^T A + noise^2 P`` of points and prior; and a smooth
error of ``f`` deviations moves them by ``-noise^2 H^-1 f``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rs_localizer.config import CalibrationErrors
from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.lens import by_lens, coefficients_of, corner_of
from rs_localizer.core.scales import SPEEDS
from rs_localizer.core.shake import shake_at
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.state import MOTION_PARAMETERS, MOVE, PARAMETERS, POSE
from rs_localizer.estimation.frame_fit import SMOOTH_TERMS, smooth_terms
from rs_localizer.estimation.lens import rays_of_lens
from rs_localizer.estimation.mirror import longest_axis
from rs_localizer.estimation.observations import Observed
from rs_localizer.estimation.posterior import Posterior
from rs_localizer.estimation.prior import PriorTerms, add_prior, terms_at
from rs_localizer.estimation.refine import inverted
from rs_localizer.estimation.residuals import Lines, linearized

# Of each camera: centre (2), focal length, distortion.
_ERRORS = 4
# Of a combination of typical speeds, the part of one that does not count.
_NO_PART = 0.02
_CONFIGURED = np.array([speed == 1.0 for speed in SPEEDS], float)


class CalibrationEffect(NamedTuple):
    """What the calibration's errors, one standard deviation of each, do to a frame."""

    covariance: Array  # (12,12) of pose and velocities
    residual: float  # px, root mean square of what no motion takes up; a smooth error may
    # rad, of the orientation about the axis known worst, if the camera's motion were known
    still_deviation: float


NO_EFFECT = CalibrationEffect(np.zeros((MOTION_PARAMETERS, MOTION_PARAMETERS)), 0.0, np.inf)


def calibration_effect(
    observed: Observed, posterior: Posterior, terms: PriorTerms, deviation: CalibrationErrors
) -> CalibrationEffect:
    """The effect on the motion of a frame.

    Args:
        terms: what is known of the motion but for poses of other frames, which are off by as much.
    """
    observations, chosen = observed.observations, posterior.inliers
    lines = linearized(
        observations.packed, observations.count, posterior.state,
        shake_at(observations.tau, posterior.shake),
    )  # fmt: skip
    rays = rays_of_lens(observed.sighted, observations.tau[chosen], lines.image[chosen])
    of_camera, exposure = observations.camera[chosen], observed.sighted.exposure
    columns = np.zeros((len(rays), 2, _ERRORS * len(exposure.cameras)))
    for place, side in enumerate(exposure.sides):
        here, first = of_camera == place, _ERRORS * side.place
        if np.any(here):
            towards = side.towards(rays[here])
            columns[here, :, first : first + _ERRORS] = _columns(side.camera, towards, deviation)
    smooth, variance = _smooth_columns(posterior, lines, chosen), posterior.noise**2
    rows = np.concatenate([lines.by_motion[chosen], smooth, columns], axis=2)
    size, rows = PARAMETERS + smooth.shape[2], rows.reshape(-1, rows.shape[2])
    every = rows.T @ rows
    of_pose = posterior.inflation * variance * inverted(np.ascontiguousarray(every[POSE, POSE]))
    still = longest_axis(of_pose) if np.all(np.isfinite(of_pose)) else np.inf
    products = np.ascontiguousarray(every[:size, :size])
    crossed = np.hstack([every[:size, size:], variance * np.eye(size)[:, PARAMETERS:]])
    parts = posterior.speeds if len(posterior.speeds) else _CONFIGURED
    pull, taken, finite = _effect(
        products, crossed, posterior.state, terms, parts, observed.sighted.turn is not None,
        variance,
    )  # fmt: skip
    if not finite:
        return NO_EFFECT._replace(still_deviation=still)
    taken = taken[:, : columns.shape[2]]
    beside = every[:PARAMETERS, :PARAMETERS] @ taken - 2.0 * every[:PARAMETERS, size:]
    left = np.trace(every[size:, size:]) + np.sum(taken * beside)
    residual = np.sqrt(max(left, 0.0) / max(len(rows), 1))
    return CalibrationEffect(pull @ pull.T, float(residual), still)


@kernel
def _effect(
    products: Array, crossed: Array, state: Array, terms: PriorTerms, parts: Array,
    turn_known: bool, variance: float,
) -> tuple[Array, Array, bool]:  # fmt: skip
    """How errors (k) move pose and velocities (12,k), and the motion alone (18,k); whether they do.

    Args:
        products: (m,m) of the columns of motion and smooth error.
        crossed: (m,k) and of these with what the errors move.
        parts: (5,) of the typical speeds.
        variance: of the noise, px^2.
    """
    pull, alone = np.zeros((MOTION_PARAMETERS, crossed.shape[1])), crossed[:PARAMETERS] * 0.0
    for k in range(len(parts)):
        if parts[k] < _NO_PART:
            continue
        of_motion, slope = products[:PARAMETERS, :PARAMETERS].copy(), np.zeros(PARAMETERS)
        add_prior(terms_at(terms, SPEEDS[k], turn_known), state, variance, of_motion, slope)
        information = products.copy()
        for i in range(PARAMETERS):
            for j in range(PARAMETERS):
                information[i, j] = of_motion[i, j]
        for i in range(PARAMETERS, len(products)):
            information[i, i] += variance
        inverse = inverted(information)
        if not np.all(np.isfinite(inverse)):
            return pull, alone, False
        pull -= parts[k] * (inverse[:MOTION_PARAMETERS] @ crossed)
        alone += parts[k] * (inverted(of_motion) @ crossed[:PARAMETERS])
    return pull, alone, True


def _smooth_columns(posterior: Posterior, lines: Lines, chosen: BoolArray) -> Array:
    """By how many pixels a deviation of each coefficient of the smooth error moves (n,2,q)."""
    scale, rays = posterior.shared, lines.image[chosen]
    if not scale > 0.0:
        return np.zeros((len(rays), 2, 0))
    if posterior.bend.shape[1]:
        moved = -scale * lines.by_motion[chosen][:, :, MOVE]
        bent: Array = np.einsum("nka,nb->nkba", moved, posterior.bend[chosen])
        return bent.reshape(len(rays), 2, -1)
    low, high = rays.min(axis=0), rays.max(axis=0)
    columns, each = np.zeros((len(rays), 2, 2 * SMOOTH_TERMS)), np.zeros(SMOOTH_TERMS)
    for k, ray in enumerate(rays):
        smooth_terms(ray, low, high, each)
        columns[k, 0, :SMOOTH_TERMS] = columns[k, 1, SMOOTH_TERMS:] = scale * each
    return columns


def _columns(camera: Camera, towards: Array, deviation: CalibrationErrors) -> Array:
    """By how many pixels a standard deviation of each error moves rays or bearings: (n,2,4)."""
    by_all = by_lens(camera, towards)
    focal = coefficients_of(camera) - 4
    corner = corner_of(camera) * camera.focal_length / camera.binning[0]
    columns = np.zeros((len(towards), 2, _ERRORS))
    columns[:, 0, 0] = columns[:, 1, 1] = deviation.principal_point
    columns[:, :, 2] = deviation.focal_length * by_all[:, :, focal : focal + 2].sum(axis=2)
    columns[:, :, 3] = deviation.distortion / corner * by_all[:, :, 0]
    return columns
