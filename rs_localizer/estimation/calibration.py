"""What an ordinary calibration and a declared map have wrong, and what that does to a pose.

Centre, focal length and distortion have errors, a map that is bent has them, too, and these are the
same in all frames: no tracker averages them away. So they join what is published of a frame, and
not what goes on to the next. To
first order a calibration that moves the pixels by ``b`` moves the motion by
``-(J^T J + noise^2 P)^-1 J^T b``, with the prior ``P`` of the motion.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rs_localizer.config import CalibrationErrors
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.lens import by_lens, coefficients_of, corner_of
from rs_localizer.core.scales import SPEEDS
from rs_localizer.core.shake import shake_at
from rs_localizer.core.state import MOTION_PARAMETERS, PARAMETERS, POSE, TURN
from rs_localizer.estimation.frame_fit import SMOOTH_TERMS, smooth_terms
from rs_localizer.estimation.lens import rays_of_lens
from rs_localizer.estimation.observations import Observed
from rs_localizer.estimation.posterior import Posterior
from rs_localizer.estimation.prior import PriorTerms, add_prior, terms_at
from rs_localizer.estimation.refine import inverted
from rs_localizer.estimation.residuals import linearized

# Of a combination of typical speeds, the part of one that does not count.
_NO_PART = 0.02
_CONFIGURED = np.array([speed == 1.0 for speed in SPEEDS], float)


class CalibrationEffect(NamedTuple):
    """What the calibration's errors, one standard deviation of each, do to a frame."""

    covariance: Array  # (12,12) of pose and velocities
    residual: float  # px, root mean square of what no motion takes up
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
        observations.packed, len(observations), posterior.state, observations.row_time_gradient,
        shake_at(observations.tau, posterior.shake),
    )  # fmt: skip
    rays = rays_of_lens(observed.sighted, observations.tau[chosen], lines.image[chosen])
    columns = _columns(observed.sighted.camera, rays, deviation)
    if posterior.declared > 0.0:
        # Poses absorb most of what a bent map is off: what they leave does not tell how much.
        bent = posterior.declared * _smooth(lines.image[chosen])
        columns = np.concatenate([columns, bent], axis=2)
    pixels = columns.reshape(-1, columns.shape[2])
    by_motion = np.ascontiguousarray(lines.by_motion[chosen].reshape(-1, PARAMETERS))
    products, crossed = by_motion.T @ by_motion, by_motion.T @ pixels
    variance = posterior.noise**2
    of_pose = posterior.inflation * variance * inverted(np.ascontiguousarray(products[POSE, POSE]))
    determined = bool(np.all(np.isfinite(of_pose)))
    still = np.sqrt(np.linalg.eigvalsh(of_pose[TURN, TURN])[-1]) if determined else np.inf
    pull = np.zeros(crossed.shape)
    parts = posterior.speeds if len(posterior.speeds) else _CONFIGURED
    for speed, part in zip(SPEEDS, parts, strict=True):
        if part < _NO_PART:
            continue
        information, slope = products.copy(), np.zeros(PARAMETERS)
        of_speed = terms_at(terms, speed, observed.sighted.turn is not None)
        add_prior(*of_speed, posterior.state, variance, information, slope)
        inverse = inverted(information)
        if not np.all(np.isfinite(inverse)):
            return NO_EFFECT._replace(still_deviation=float(still))
        pull -= part * (inverse @ crossed)
    left = pixels + by_motion @ pull
    residual = float(np.sqrt(np.square(left).sum() / max(len(pixels), 1)))
    pulled = pull[:MOTION_PARAMETERS]
    return CalibrationEffect(pulled @ pulled.T, residual, float(still))


def _smooth(rays: Array) -> Array:
    """Errors (n,2,20) that are smooth over the image, together of a pixel's root mean square."""
    low, high = rays.min(axis=0), rays.max(axis=0)
    spread = np.maximum(high - low, 1e-12)
    terms, each = np.zeros((len(rays), 2, 2 * SMOOTH_TERMS)), np.zeros(SMOOTH_TERMS)
    for k, ray in enumerate(rays):
        smooth_terms(ray, low, low + spread, each)
        terms[k, 0, :SMOOTH_TERMS] = terms[k, 1, SMOOTH_TERMS:] = each
    return terms


def _columns(camera: Camera, rays: Array, deviation: CalibrationErrors) -> Array:
    """By how many pixels a standard deviation of each error moves rays (n,2): (n,2,4)."""
    by_all = by_lens(camera, rays)
    focal = coefficients_of(camera) - 4
    corner = corner_of(camera) * camera.focal_length / camera.binning[0]
    columns = np.zeros((len(rays), 2, 4))
    columns[:, 0, 0] = columns[:, 1, 1] = deviation.principal_point
    columns[:, :, 2] = deviation.focal_length * by_all[:, :, focal : focal + 2].sum(axis=2)
    columns[:, :, 3] = deviation.distortion / corner * by_all[:, :, 0]
    return columns
