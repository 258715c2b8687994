# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Acceptance of estimates and of their twists: nothing is published rather than a wrong pose."""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.reasons import Reason
from rs_localizer.core.rig import Exposure
from rs_localizer.core.state import (
    ANGULAR,
    LINEAR,
    MOTION_PARAMETERS,
    PARAMETERS,
    POSE,
    POSE_SIZE,
    STATE_ANGULAR,
    STATE_ANGULAR_ACCELERATION,
    STATE_LINEAR,
    STATE_LINEAR_ACCELERATION,
    STATE_TRANSLATION,
    TURN,
    VELOCITIES,
    rotation_of,
)
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.calibration import CalibrationEffect, longest_axis, promised
from rs_localizer.estimation.gaussian import along_arcs, is_motion
from rs_localizer.estimation.hypotheses import Posterior
from rs_localizer.estimation.known_rotation import with_turn
from rs_localizer.estimation.points import Observed, Usable

# Errors as large as the gate lets them be are those of points strewn over it.
# A global shutter leaves errors of the motion beside the noise. In inlier thresholds.
_MOST_NOISE, _MOST_NOISE_GLOBAL_SHUTTER = 0.75, 1.0
# Largest standard deviation of the orientation, rad: 4 degrees are 7 cm at a metre.
MOST_TURN = 0.07
# An orientation that is open because the camera may move is accepted up to so many times the limit:
# hand-held boards of 12 to 20 cm come to 1.5 times (benchmarks.real), and beyond three a covariance
# no longer says where a pose on an arc may be.
_OPEN = 3.0
# Points that lie closer together than this (px) show no perspective.
_LEAST_EXTENT = 5.0


def unfit(exposure: Exposure, pixels: Array, usable: Usable, needed: int) -> Failure | None:
    """Return why points cannot carry a pose whatever the motion, or None.

    Args:
        pixels: (n,2) of all points.
        usable: which of them can be used.
        needed: fewest points of a pose.
    """
    indices = usable.indices
    if len(indices) < needed:
        outside = int(np.count_nonzero(~usable.shown))
        sizes = " or ".join(sorted({f"{w} x {h}" for w, h in (c.size for c in exposure.cameras)}))
        hint = f"; {outside} lie outside the image of {sizes} pixels" if outside else ""
        return Failure(
            Reason.TOO_FEW_POINTS,
            f"{len(indices)} usable points of {len(pixels)}, {needed} are needed{hint}",
        )
    if usable.extent < _LEAST_EXTENT:
        return Failure(
            Reason.DEGENERATE,
            f"all {len(indices)} points lie within {usable.extent:.2g} pixels; are these "
            "normalized coordinates? Pixels of the raw image are needed",
        )
    return None


def refusal(
    posterior: Posterior, samples: int, *, min_inliers: int, threshold: float, rolling: bool
) -> Failure | None:
    """Return the reason to refuse an estimate, or None.

    Args:
        samples: minimal samples drawn, for the message.
        min_inliers, threshold: of the configuration.
        rolling: whether velocities were estimated.
    """
    found = int(np.count_nonzero(posterior.inliers))
    if found < min_inliers:
        return too_few(posterior.inliers, posterior.squared_errors, samples, min_inliers)
    if not posterior.determined:
        return Failure(
            Reason.DEGENERATE,
            f"{found} inliers do not determine the motion: smallest eigenvalue of the scaled "
            f"information {posterior.smallest_eigenvalue:.1e}",
        )
    if not is_motion(posterior.state, posterior.covariance):
        return Failure(
            Reason.DEGENERATE,
            f"{found} inliers leave the motion so open that it cannot be computed",
        )
    if noise_fills(posterior, posterior.gate, rolling):
        return Failure(
            Reason.RESIDUAL,
            f"{found} inliers with errors of {posterior.noise:.2g} px (one sigma) around an "
            f"inlier_threshold of {threshold:g} px: no motion fits them, or the threshold is "
            "too small for the noise; set map_deviation, if points of the map are that far off",
        )
    return None


def too_few(inliers: BoolArray, squared_errors: Array, samples: int, needed: int) -> Failure:
    """Return the failure of a motion with too few inliers."""
    behind, count = int(np.count_nonzero(np.isinf(squared_errors))), len(inliers)
    if 2 * behind > count:
        return Failure(Reason.BEHIND_CAMERA, f"{behind} of {count} points lie behind the camera")
    return Failure(
        Reason.TOO_FEW_INLIERS,
        f"{np.count_nonzero(inliers)} inliers of {count} points after {samples} samples, "
        f"{needed} are needed",
    )


def noise_fills(posterior: Posterior, gate: float, rolling: bool) -> bool:
    """Return whether errors are as large as a gate (px) allows, so that the noise is unknown."""
    most = _MOST_NOISE if rolling else _MOST_NOISE_GLOBAL_SHUTTER
    return posterior.noise > most * gate


def speeding(observed: Observed, state: Array) -> float:
    """Return the squared velocities, in standard deviations that the configuration expects."""
    # Of the others a rotation prior knows.
    part = VELOCITIES if observed.rotation is None else LINEAR
    velocities = state[POSE_SIZE - POSE.stop :][part]
    return float(velocities @ observed.terms.informations[0][part, part] @ velocities)


def uncertain(estimate: Estimate) -> Failure | None:
    """Return why an estimate is too uncertain to be published, or None.

    What points do not tell because the camera may move, its covariance says: a global-shutter
    estimator, which takes the camera for one at rest, would publish that pose. A pose is not
    refused, either, because a few points deny it, which may have been moved.
    """
    still, most = estimate.still_deviation, MOST_TURN
    turn = (estimate.covariance - estimate.moved_covariance)[TURN, TURN]
    if turn.trace() <= most**2:  # less than that about any axis
        return None
    deviation = math.sqrt(np.linalg.eigvalsh(turn)[-1])
    if deviation <= most or (still <= most and deviation <= _OPEN * most):
        return None
    return Failure(
        Reason.UNCERTAIN,
        f"the points determine the orientation to {math.degrees(deviation):.1f} deg (one "
        f"standard deviation), {math.degrees(most):.1f} deg are accepted",
    )


# Of a velocity so large a part may be its deviation: it is 0.5 to 1.5 of the true one then.
_TOLD = 0.5
# Probability of rest (in a covariance), beyond which the velocities are none.
_CERTAIN = 0.95


def estimate_of(
    observed: Observed, posterior: Posterior, samples: int, effect: CalibrationEffect,
    predicted: bool,
) -> Estimate:  # fmt: skip
    """Return the estimate of an accepted posterior, in the map frame, for all given points.

    Args:
        samples: minimal samples drawn.
        effect: of what map and calibration are off.
        predicted: frames before tell how the camera moves.
    """
    state, known = posterior.state, observed.rotation
    rotation = rotation_of(state)
    indices, originals, count = *observed.usable[:2], len(observed.points)
    residuals, inliers = np.full(count, np.nan), np.zeros(count, dtype=np.bool_)
    residuals[indices], inliers[indices] = np.sqrt(posterior.squared_errors), posterior.inliers
    rate, change = state[STATE_ANGULAR], state[STATE_ANGULAR_ACCELERATION]
    covariance = posterior.covariance
    # The noise of this frame is an estimate, and what is on an arc leaves its tangent.
    motion = covariance[:PARAMETERS, :PARAMETERS].copy()
    beside = posterior.inflation * along_arcs(motion, state[STATE_TRANSLATION]) - motion
    shake = posterior.shake
    if known is not None:
        rate, change, shake = known.joined(rate, change, shake)
        if len(covariance) == PARAMETERS:
            covariance = with_turn(covariance, known)
    return Estimate(
        rotation=rotation,
        translation=state[STATE_TRANSLATION] - rotation @ observed.centre,
        angular_velocity=rate,
        linear_velocity=state[STATE_LINEAR],
        angular_acceleration=change,
        linear_acceleration=state[STATE_LINEAR_ACCELERATION],
        inliers=inliers[originals],
        residuals=residuals[originals],
        joint_covariance=covariance,
        undetected_covariance=posterior.undetected + beside[:MOTION_PARAMETERS, :MOTION_PARAMETERS],
        shake=shake,
        vibrations=posterior.vibrations,
        model_error=posterior.model_error,
        declared_error=promised(posterior),
        iterations=samples,
        aided=known is not None,
        span=observed.exposure.span,
        calibration_covariance=effect.covariance,
        still_deviation=effect.still_deviation,
        twist_known=predicted or _knows_velocities(posterior),
    )


def _knows_velocities(posterior: Posterior) -> bool:
    """Return whether the points determine the velocities, or certainly rest.

    What they do not tell is a mean about zero, of rest and of all typical speeds: its deviation is
    that of the speeds that are left out of the mean.
    """
    if len(posterior.speeds) and posterior.speeds[0] > _CERTAIN:
        return True
    velocities = posterior.state[POSE_SIZE:]
    return all(
        longest_axis(posterior.covariance[part, part].copy())
        < _TOLD * math.hypot(*velocities[part.start - POSE.stop :][:3].tolist())
        for part in (ANGULAR, LINEAR)
    )
