# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Acceptance of estimates: nothing is published rather than a wrong pose."""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.reasons import Reason
from rs_localizer.core.state import LINEAR, POSE, POSE_SIZE, VELOCITIES
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.observations import Observed
from rs_localizer.estimation.posterior import Posterior

# Errors as large as the gate lets them be are those of points strewn over it.
# A global shutter leaves errors of the motion beside the noise. In inlier thresholds.
_MOST_NOISE, _MOST_NOISE_GLOBAL_SHUTTER = 0.75, 1.0
# Smooth errors may be so many times what is declared: of printed boards, nine (benchmarks.real).
_MOST_DECLARED = math.exp(3.5)
# An orientation that is open because the camera may move is accepted up to so many times the limit:
# hand-held boards of 12 to 20 cm come to 1.5 times (benchmarks.real), and beyond three a covariance
# no longer says where a pose on an arc may be.
_OPEN = 3.0
# Errors of map and lens (root mean square, inlier thresholds) beyond which no region is believed.
_MOST_MODEL_ERROR = 1.5
# A wrong lens before a wall is fitted by velocities that nobody expects, and leaves smooth errors:
# of this limit so many squared deviations of the velocities leave a part of 1 / e. Cameras that are
# fast leave none (a phone at 3.4 deviations: 0.04 px).
_SPEEDS_AND_ERRORS, _LEAST_OF_THE_LIMIT = 8.0, 0.25


def refusal(
    posterior: Posterior,
    samples: int,
    *,
    min_inliers: int,
    threshold: float,
    rolling: bool,
) -> Failure | None:
    """Return the reason to refuse an estimate, or None.

    Args:
        posterior: ``declared`` is all that map and calibration are known to be off.
        samples: minimal samples drawn, for the message.
        min_inliers, threshold: of the configuration.
        rolling: whether velocities were estimated.
    """
    state, count = posterior.state, len(posterior.inliers)
    found, needed = int(np.count_nonzero(posterior.inliers)), min_inliers
    if found < needed:
        behind = int(np.count_nonzero(np.isinf(posterior.squared_errors)))
        if 2 * behind > count:
            return Failure(
                Reason.BEHIND_CAMERA,
                f"{behind} of {count} points lie behind the camera",
            )
        return Failure(
            Reason.TOO_FEW_INLIERS,
            f"{found} inliers of {count} points after {samples} samples, {needed} are needed",
        )
    if not posterior.determined:
        return Failure(
            Reason.DEGENERATE,
            f"{found} inliers do not determine the motion: smallest eigenvalue of the scaled "
            f"information {posterior.smallest_eigenvalue:.1e}",
        )
    if not (np.all(np.isfinite(state)) and np.all(np.isfinite(posterior.covariance))):
        return Failure(
            Reason.DEGENERATE,
            f"{found} inliers leave the motion so open that it cannot be computed",
        )
    if noise_fills(posterior, rolling):
        return Failure(
            Reason.RESIDUAL,
            f"{found} inliers with errors of {posterior.noise:.2g} px (one sigma) around an "
            f"inlier_threshold of {threshold:g} px: no motion fits them, or the threshold is "
            "too small for the noise; set map_deviation, if points of the map are that far off",
        )
    if posterior.near_outliers:
        return Failure(
            Reason.MODEL_ERROR,
            f"{posterior.near_outliers} points lie just beyond the gate of {found} inliers: "
            "unmodelled vibration, or a second motion",
        )
    doubt = max(math.exp(-posterior.speeding / _SPEEDS_AND_ERRORS), _LEAST_OF_THE_LIMIT)
    if rolling and posterior.model_error > math.hypot(
        doubt * _MOST_MODEL_ERROR * threshold, _MOST_DECLARED * posterior.declared
    ):
        return Failure(
            Reason.MODEL_ERROR,
            f"errors of {posterior.model_error:.2g} px are smooth over the image: the calibration "
            "or the map is too far off for any pose",
        )
    return None


def noise_fills(posterior: Posterior, rolling: bool) -> bool:
    """Return whether errors are as large as the gate allows, so that the noise is unknown."""
    most = _MOST_NOISE if rolling else _MOST_NOISE_GLOBAL_SHUTTER
    return posterior.noise > most * posterior.gate


def speeding(observed: Observed, state: Array) -> float:
    """Return the squared velocities, in standard deviations that the configuration expects."""
    part = VELOCITIES if observed.sighted.turn is None else LINEAR  # of the rest a gyroscope knows
    velocities = state[POSE_SIZE - POSE.stop :][part]
    return float(velocities @ observed.terms.informations[0][part, part] @ velocities)


def uncertain(estimate: Estimate, most: float) -> Failure | None:
    """Return why an estimate is too uncertain to be published, or None.

    What points do not tell because the camera may move, its covariance says: a global-shutter
    estimator, which takes the camera for one at rest, would publish that pose.

    Args:
        most: largest standard deviation of the orientation, rad.
    """
    deviation, still = estimate.orientation_deviation, estimate.still_deviation
    if deviation <= most or (still <= most and deviation <= _OPEN * most):
        return None
    return Failure(
        Reason.UNCERTAIN,
        f"the points determine the orientation to {math.degrees(deviation):.1f} deg (one "
        f"standard deviation), {math.degrees(most):.1f} deg are accepted",
    )
