"""The final estimate: inliers by the noise that they show, motion or rest, and its covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.prior import PriorTerms, held_terms
from rs_localizer.core.ransac import Observations
from rs_localizer.core.refine import invert_information, refine, step_between
from rs_localizer.core.residuals import set_weights
from rs_localizer.core.so3 import Array
from rs_localizer.core.types import BoolArray

# Inliers lie within this many standard deviations of the measured noise (99.8 % of Rayleigh
# distributed errors); the threshold is widened for them at most twofold.
_GATE = 3.5
_WIDEST = 2.0
_ROUNDS = 3
_ITERATIONS = 10
# Positions of image points are never better than this, in pixels; it also keeps noise-free data
# from claiming an infinite information.
_LEAST_NOISE = 1e-4
# A truncation that truncates nothing, px.
_NO_SCALE = 1e6
_NOISE_ROUNDS = 20
_VELOCITIES = slice(6, 12)


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """The refined motion of one frame and what the points say of it."""

    state: Array  # (18,)
    covariance: Array  # (12,12)
    noise: float  # px, measured standard deviation
    smallest_eigenvalue: float  # of the information scaled to a unit diagonal
    inliers: BoolArray  # (n,)
    squared_errors: Array  # (n,) px^2
    at_rest: bool = False  # a global shutter explains the points as well


def noise_deviation(squared_errors: Array, gate: float, freedom: float) -> float:
    """Standard deviation of the pixel noise from the errors within a gate.

    Args:
        squared_errors: (n,) of all points.
        gate: px.
        freedom: degrees of freedom that the fit has used up.

    The errors of true inliers are Rayleigh distributed; cutting them off at the gate lowers their
    mean square by a factor that depends on the deviation itself, hence the fixed point.
    """
    within = squared_errors[squared_errors < gate * gate]
    left = 2 * len(within) - freedom
    if left <= 0.0:
        return gate / _GATE
    mean = float(within.sum()) / left
    variance = mean
    for _ in range(_NOISE_ROUNDS):
        u = gate * gate / (2.0 * max(variance, 1e-12 * gate * gate))
        kept = 1.0 - u * math.exp(-u) / -math.expm1(-u)
        variance = min(mean / max(kept, 1e-3), gate * gate)
    return max(math.sqrt(variance), _LEAST_NOISE)


def maximum_a_posteriori(
    observations: Observations, start: Array, prior: PriorTerms, threshold: float
) -> Posterior:
    """Refine a motion on its inliers, which the noise decides that it leaves.

    Args:
        start: state (18,).
        threshold: px, least gate for inliers.
    """
    # From the wide side: a start that fits few points well would see little noise and keep few.
    state, gate, noise = start, _WIDEST * threshold, 0.5 * threshold
    errors = observations.squared_errors(state)
    for _ in range(_ROUNDS):
        inliers = errors < gate * gate
        state, information, _, _ = _fit(observations, state, inliers, prior, noise)
        errors = observations.squared_errors(state)
        inverse, smallest = invert_information(information)
        freedom = _freedom(inverse, prior, noise)
        noise = noise_deviation(errors, gate, freedom)
        gate = min(max(threshold, _GATE * noise), _WIDEST * threshold)
    inliers = errors < gate * gate
    left = max(2 * np.count_nonzero(inliers) - freedom, 3.0)
    # The noise itself is estimated: errors follow a t distribution, whose variance is larger.
    covariance = noise**2 * left / (left - 2.0) * inverse
    return Posterior(state, covariance, noise, smallest, inliers, errors)


def prefer_rest(observations: Observations, posterior: Posterior) -> Posterior:
    """The global-shutter posterior where the points give no evidence of a motion.

    Compares both by the Bayesian information criterion (Schwarz, 1978): six velocities have to
    lower the squared errors by ``6 ln(2 n)`` noise variances. The covariance is that of both
    models together, weighted by their evidence, and that of the velocities stays what the moving
    model found: zero velocity is as uncertain as any other.
    """
    velocities = posterior.state[12:]
    precision = np.linalg.inv(posterior.covariance[_VELOCITIES, _VELOCITIES])
    count = int(np.count_nonzero(posterior.inliers))
    penalty = 6.0 * math.log(2.0 * count)
    # To second order this is what holding the velocities at zero costs; no need to try at speed.
    if velocities @ precision @ velocities > 2.0 * penalty:
        return posterior
    noise = posterior.noise
    start = np.concatenate([posterior.state[:12], np.zeros(6)])
    state, information, cost, _ = _fit(observations, start, posterior.inliers, held_terms(), noise)
    moving_cost = float(posterior.squared_errors[posterior.inliers].sum())
    evidence = (cost - moving_cost) / noise**2 - penalty
    if evidence > 0.0:
        return posterior
    inverse, _ = invert_information(information[:6, :6])
    moving = 1.0 / (1.0 + math.exp(-0.5 * evidence))
    between = step_between(posterior.state, state)
    covariance = moving * (posterior.covariance + np.outer(between, between))
    covariance[:6, :6] += (1.0 - moving) * noise**2 * inverse
    covariance[_VELOCITIES, _VELOCITIES] += (1.0 - moving) * posterior.covariance[
        _VELOCITIES, _VELOCITIES
    ]
    return replace(
        posterior,
        state=state,
        covariance=covariance,
        squared_errors=observations.squared_errors(state),
        at_rest=True,
    )


def _fit(
    observations: Observations, start: Array, inliers: BoolArray, prior: PriorTerms, noise: float
) -> tuple[Array, Array, float, bool]:
    set_weights(observations.packed, inliers.astype(np.float64))
    fitted: tuple[Array, Array, float, bool] = refine(
        observations.packed,
        start,
        observations.row_time_gradient,
        _NO_SCALE,
        0.0,
        prior,
        noise,
        _ITERATIONS,
    )
    set_weights(observations.packed, np.ones(len(observations)))
    return fitted


def _freedom(inverse: Array, prior: PriorTerms, noise: float) -> float:
    """Degrees of freedom that the points decide; the prior takes its part of the twelve."""
    taken = noise**2 * float(np.sum(inverse * prior.informations.sum(axis=0)))
    return 12.0 - taken
