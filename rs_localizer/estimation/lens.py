# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A calibration whose lens is off: its radial distortion, found with the motion.

A smooth field of errors (:mod:`.frame_fit`) makes covariances larger and leaves the estimate as
it is. Where it is large, a few coefficients of the lens explain the points to the noise, which
neither shaking does, by which the points of a row move alike, nor a map that is bent, unless it is
a plane.
A lens stays what it is, so that frames are joined, as in the information filter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.lens import (
    LensError,
    by_lens,
    coefficients_of,
    corner_of,
    with_lens,
)
from rs_localizer.core.reasons import Reason
from rs_localizer.core.shake import shake_at
from rs_localizer.core.state import PARAMETERS
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.mirror import is_plane
from rs_localizer.estimation.observations import (
    MOST_POINTS,
    Observations,
    Observed,
    Sighted,
    rays_of_lens,
    relinearized,
)
from rs_localizer.estimation.posterior import WIDEST_GATE, Posterior, maximum_a_posteriori
from rs_localizer.estimation.prior import PriorTerms, add_prior
from rs_localizer.estimation.refine import apply_step, inverted
from rs_localizer.estimation.residuals import linearized

# Standard deviations of the coefficients beforehand: radial ones of 20 px at the corners of an
# image of 800 px across, as 30 % of the distortion of a plain lens; tangential ones, which hardly
# differ from a turn of the camera, of a few tenths; focal lengths of 1 %, the centre of 10 px.
_RADIAL, _TANGENTIAL, _MATRIX = [0.05, 0.05], [5e-4, 5e-4], [0.01, 0.01, 0.025, 0.025]
_DEVIATIONS = {
    len(each): np.array(each) for each in (_RADIAL + _MATRIX, _RADIAL + _TANGENTIAL + _MATRIX)
}
# Beyond this many of them, what is not radial is something else: a map that is bent, or more of the
# calibration.
_MOST_DEVIATIONS = 3.0
# Parts of them to try, of what many frames tell: with their whole alone, a tracker learns of 3 % of
# missing distortion after 16 frames, with these after 7 (test_lens).
_PARTS = (0.06, 0.2, 0.6)
# Gates of the rounds, in inlier thresholds: at first the rim of the image is far off.
_GATES = (4.0, 2.0, 1.0, 1.0, 1.0)
# What a lens that is off makes of a frame that is published: errors around the motion, in inlier
# thresholds, or a smooth one, or one that explains so much more than chance (standard normal;
# shaking alone leaves less).
_MUCH_NOISE, _MUCH_MODEL_ERROR, _SMOOTH_EXCESS = 0.6, 0.1, 5.0
# Logarithm of the odds for a lens that is off, or against one that others told of, to be believed:
# as they are read, one such belief in twenty thousand is wrong.
DECIDED = 10.0
# Swing of the points, in parts of the noise, beyond which a frame says nothing of a lens. With any
# in-frame turn, which a lens that is off looks like, 25 instead of 27 of 30 twists are inside
# (benchmarks.frames camera, lens 10%/rich/1px/tracked).
_SWING = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Mended:
    """The lens that fits an image, and the image as it shows it."""

    sighted: Sighted
    lens: LensError
    observations: Observations
    state: Array  # (24,)


def find_lens(observed: Observed, refused: Posterior, threshold: float) -> Mended | None:
    """Find motion and lens together, from the rim of the image inwards.

    Args:
        observed: the points, by the camera as it is calibrated.
        refused: the best motion by that.
        threshold: px, of inliers.

    None where the points do not determine them. Those of a plane do, but one that is bent about one
    axis, before a camera that comes nearer, looks like one that a lens bends about its middle.
    """
    sighted, terms = observed.sighted, observed.terms
    if is_plane(observed.observations.points, refused.inliers) or _too_few(sighted, refused):
        return None
    camera, state = sighted.camera, refused.state
    coefficients = np.zeros(coefficients_of(camera))
    for gate in _GATES:
        mended = with_lens(camera, coefficients)
        observations = sighted.by(mended)
        if observations is None:
            return None
        if observations.count > MOST_POINTS:
            observations = observations.thinned(MOST_POINTS)
        best = maximum_a_posteriori(observations, state, terms, gate * threshold)
        if not (best.determined and np.all(np.isfinite(best.state))):
            return None
        by_mended = replace(sighted, exposure=sighted.exposure.by(mended))
        step, lens, _ = _told(by_mended, observations, best, terms, coefficients)
        if not np.all(np.isfinite(step)):
            return None
        coefficients, state = lens.mean, apply_step(best.state, step)
    mended = with_lens(camera, coefficients)
    observations = sighted.by(mended)
    if observations is None:
        return None
    return Mended(replace(sighted, exposure=sighted.exposure.by(mended)), lens, observations, state)


def told_of_lens(observed: Observed, posterior: Posterior) -> tuple[Posterior, LensError | None]:
    """A posterior that knows how well its lens is known, and what its frame alone says of that.

    Frames of a camera that shakes say nothing, because what the shaking leaves of them looks like a
    lens; nor do planes, of which nobody knows that they are not bent, nor bent maps.
    """
    believed, count = observed.lens, coefficients_of(observed.sighted.camera)
    silent = (
        posterior.model_error > posterior.noise
        or is_plane(observed.observations.points, posterior.inliers)
        or _too_few(observed.sighted, posterior)
        or shakes(observed, posterior)
    )
    if silent and believed is None:
        return posterior, None
    _, lens, pull = _told(
        observed.sighted, observed.observations, posterior, observed.terms,
        np.zeros(count) if believed is None else believed.mean,
    )  # fmt: skip
    says = None if silent or not np.all(np.isfinite(lens.covariance)) else lens
    if believed is None:
        return posterior, says
    covariance = posterior.covariance.copy()
    spread = posterior.inflation * believed.covariance
    covariance[:PARAMETERS, :PARAMETERS] += pull @ spread @ pull.T
    return posterior._replace(covariance=covariance), says


def _too_few(sighted: Sighted, posterior: Posterior) -> bool:
    """Whether points give less than two equations for each number of motion and lens."""
    needed = PARAMETERS + coefficients_of(sighted.camera)
    return int(np.count_nonzero(posterior.inliers)) < needed


def shakes(observed: Observed, posterior: Posterior) -> bool:
    """Whether the points swing by more than a part of the noise."""
    turns = shake_at(observed.observations.tau, posterior.shake)[:, :3]
    swing = observed.sighted.camera.focal_length * math.sqrt(np.square(turns).sum(axis=1).mean())
    return swing > _SWING * posterior.noise


def may_be_lens(found: Estimate | Failure, posterior: Posterior, threshold: float) -> bool:
    """Whether a lens that is off may be why a frame was refused, or nearly so."""
    if not found:
        return found.reason in (Reason.MODEL_ERROR, Reason.RESIDUAL)
    return bool(
        posterior.noise > _MUCH_NOISE * threshold
        or posterior.model_error > _MUCH_MODEL_ERROR * threshold
        or posterior.scales.excess[-1] > _SMOOTH_EXCESS
    )


def decided(before: Posterior, after: Posterior, lens: LensError, threshold: float) -> bool:
    """Whether a lens explains the points decidedly better than what a frame was refused for.

    By the marginal likelihoods at unknown noise; of points that were no inliers the error counts
    as that of the widest gate. A frame whose errors are still smooth has something else.
    """
    chosen = after.inliers
    most = (WIDEST_GATE * threshold) ** 2
    left = np.minimum(before.squared_errors[chosen], most).sum()
    now = after.squared_errors[chosen].sum()
    freedom = 2.0 * np.count_nonzero(chosen) - PARAMETERS
    if (
        after.model_error > after.noise  # a bent map leaves more
        or not credible(lens)
        or not (freedom > 0.0 and left > 0.0 and 0.0 < now < math.inf)
    ):
        return False
    gain = freedom * math.log(left / now) - _known(lens, 1.0)
    return bool(0.5 * gain > DECIDED)


def refuted(by_lens: Array, by_calibration: Array, threshold: float) -> bool:
    """Whether a frame contradicts the lens that frames before it told of.

    Args:
        by_lens, by_calibration: residuals (n,), px, by that lens and by the calibration.
        threshold: px, beyond which all are the same.
    """
    both = np.isfinite(by_lens) & np.isfinite(by_calibration)
    squares = [
        float(np.sum(np.minimum(residuals[both], threshold) ** 2))
        for residuals in (by_lens, by_calibration)
    ]
    if not min(squares) > 0.0:
        return False
    gain = float(np.count_nonzero(both)) * math.log(squares[0] / squares[1])
    return gain > DECIDED


def credible(lens: LensError) -> bool:
    """Whether all that is not radial may be a calibration's."""
    others = lens.mean[2:]
    most = _MOST_DEVIATIONS * _DEVIATIONS[len(lens.mean)][2:]
    return bool(np.all(np.abs(others) < most))


def joined(before: LensError, newest: LensError, memory: float) -> LensError:
    """What two groups of frames say together; the first fades by a factor."""
    beforehand = _beforehand(before)
    old, new = (np.linalg.inv(one.covariance) for one in (before, newest))
    covariance = np.linalg.inv(memory * (old - beforehand) + new)
    mean = covariance @ (memory * old @ before.mean + new @ newest.mean)
    return replace(newest, mean=mean, covariance=covariance)


def odds_of(lens: LensError) -> float:
    """Logarithm of the odds for a lens that is off by some size, against the calibration's."""
    precision, beforehand = np.linalg.inv(lens.covariance), _beforehand(lens)
    pulled = precision @ lens.mean
    gains = []
    for part in _PARTS:
        within = precision + (part**-2 - 1.0) * beforehand
        gains.append(0.5 * (pulled @ np.linalg.solve(within, pulled) - _known(lens, part)))
    return float(np.logaddexp.reduce(gains)) - math.log(len(_PARTS))


def _beforehand(lens: LensError) -> Array:
    """Information (k,k) on as many coefficients before any frame."""
    information: Array = np.diag(_DEVIATIONS[len(lens.mean)] ** -2)
    return information


def _known(lens: LensError, part: float) -> float:
    """How much more is known than of a part of the deviations: logarithm of the determinants."""
    beforehand = _beforehand(lens)
    within = np.linalg.inv(lens.covariance) + (part**-2 - 1.0) * beforehand
    return float(np.linalg.slogdet(within)[1] - np.linalg.slogdet(part**-2 * beforehand)[1])


def _told(
    sighted: Sighted, observations: Observations, best: Posterior, terms: PriorTerms,
    coefficients: Array,
) -> tuple[Array, LensError, Array]:  # fmt: skip
    """Step (18,) to the best motion beside the lens, the lens, and how it pulls the motion (18,k).

    Args:
        sighted: by the camera with these coefficients (k,).
    """
    count, chosen = observations.count, best.inliers
    # The noise in derivatives looks like a lens, the same in all frames, and these are joined.
    observations = relinearized(sighted.exposure, observations, best.state, sighted.turn, fewest=0)
    lines = linearized(
        observations.packed,
        count,
        best.state,
        shake_at(observations.tau, best.shake),
    )
    camera, side_of = sighted.camera, observations.camera[chosen]
    seen = rays_of_lens(sighted.turn, observations.tau[chosen], lines.image[chosen])
    by_coefficients = np.empty((len(seen), 2, len(coefficients)))
    for place, side in enumerate(sighted.exposure.sides):
        here = side_of == place
        by_coefficients[here] = by_lens(camera, side.towards(seen[here]))
    columns = by_coefficients.reshape(-1, len(coefficients))
    dense, left = lines.by_motion[chosen].reshape(-1, PARAMETERS), lines.errors[chosen].ravel()
    variance = best.noise**2
    information, slope = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    add_prior(terms, best.state, variance, information, slope)
    information += dense.T @ dense
    inverse = inverted(information)
    if not np.all(np.isfinite(inverse)):  # only the frames before determine it
        inverse = best.covariance[:PARAMETERS, :PARAMETERS] / variance
    crossed = dense.T @ columns
    pull = -inverse @ crossed
    plain = inverse @ (-dense.T @ left - slope)
    beforehand = np.diag(variance / _DEVIATIONS[len(coefficients)] ** 2)
    precision = columns.T @ columns + crossed.T @ pull + beforehand
    beside = -columns.T @ left - crossed.T @ plain - beforehand @ coefficients
    covariance = inverted(precision)
    step = covariance @ beside
    corner = camera.focal_length * corner_of(camera)
    lens = LensError(coefficients + step, variance * covariance, corner)
    return plain + pull @ step, lens, pull
