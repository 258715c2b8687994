"""The final estimate: inliers by the noise, motion or rest by the evidence, covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.jit import kernel
from rs_localizer.core.prior import PriorTerms, gravity_cost, held_beside
from rs_localizer.core.ransac import Observations
from rs_localizer.core.refine import (
    apply_step,
    invert_information,
    refine,
    solve_positive,
    step_between,
)
from rs_localizer.core.residuals import set_weights, squared_errors
from rs_localizer.core.so3 import Array
from rs_localizer.core.types import BoolArray
from rs_localizer.core.view import PARAMETERS

# Inliers lie within this many standard deviations of the measured noise (99.8 % of Rayleigh
# distributed errors); the threshold is widened for them at most twofold.
_GATE = 3.5
WIDEST_GATE = 2.0
_ROUNDS = 3
_ITERATIONS = 50
_TOLERANCE = 1e-6  # noise variances
# Positions of image points are never better than this, in pixels; it also keeps noise-free data
# from claiming an infinite information.
_LEAST_NOISE = 1e-4
# A truncation that truncates nothing, px.
_NO_SCALE = 1e6
# Of the information matrix scaled to a unit diagonal.
_LEAST_EIGENVALUE = 1e-11
_NOISE_ROUNDS = 20
_VELOCITIES = slice(6, 12)
# Rest fits worse than this, in noise variances, once in a hundred frames: the 99 % quantile of the
# chi-squared distribution with six degrees of freedom.
_EVIDENCE_OF_MOTION = 16.8
_CLEARLY_MOVING = 4.0 * _EVIDENCE_OF_MOTION


@dataclass(frozen=True, slots=True, eq=False)
class Mirror:
    """The mirrored pose before a plane, if it cannot be ruled out."""

    step: Array  # (12,) from the estimate to it
    evidence: float  # noise variances by which it fits worse
    covered: bool  # the covariance speaks for it

    @property
    def turn(self) -> float:
        """rad."""
        return float(np.linalg.norm(self.step[:3]))


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """The refined motion of one frame and what the points say of it."""

    state: Array  # (18,)
    covariance: Array  # (12,12)
    noise: float  # px, measured standard deviation
    inflation: float  # of the variances, because the noise itself is an estimate
    smallest_eigenvalue: float  # of the information scaled to a unit diagonal
    inliers: BoolArray  # (n,)
    squared_errors: Array  # (n,) px^2
    mirror: Mirror | None = None

    @property
    def determined(self) -> bool:
        """Whether points and prior together determine all twelve parameters."""
        return self.smallest_eigenvalue > _LEAST_EIGENVALUE

    @property
    def variance(self) -> float:
        """Of the pixels, px^2, with the inflation."""
        return self.inflation * self.noise**2


@kernel
def noise_deviation(squared_errors: Array, gate: float, freedom: float) -> float:
    """Standard deviation of the pixel noise from the errors within a gate.

    Args:
        squared_errors: (n,) of all points.
        gate: px.
        freedom: degrees of freedom that the fit has used up.

    The errors of true inliers are Rayleigh distributed; cutting them off at the gate lowers their
    mean square by a factor that depends on the deviation itself, hence the fixed point.
    """
    total, left = 0.0, -freedom
    for squared in squared_errors:
        if squared < gate * gate:
            total += squared
            left += 2.0
    if left <= 0.0:
        return gate / _GATE
    mean = total / left
    variance = mean
    for _ in range(_NOISE_ROUNDS):
        u = gate * gate / (2.0 * max(variance, 1e-12 * gate * gate))
        kept = 1.0 - u * math.exp(-u) / -math.expm1(-u)
        variance = min(mean / max(kept, 1e-3), gate * gate)
    return max(math.sqrt(variance), _LEAST_NOISE)


@kernel
def _rounds(
    data: Array,
    count: int,
    start: Array,
    gradient: Array,
    prior: PriorTerms,
    threshold: float,
) -> tuple[Array, Array, Array, float, float, float]:
    """Refine, measure the noise, choose the inliers, and again.

    Returns:
        state, information times the noise variance, squared errors (count,), noise, gate, and the
        degrees of freedom that the points decide (the prior takes its part of the twelve).
    """
    # From the wide side: a start that fits few points well would see little noise and keep few.
    state, gate, noise, freedom = start, WIDEST_GATE * threshold, 0.5 * threshold, 12.0
    errors = squared_errors(data, count, state, gradient)
    weights = np.empty(count)
    information = np.empty((PARAMETERS, PARAMETERS))
    for _ in range(_ROUNDS):
        for i in range(count):
            weights[i] = 1.0 if errors[i] < gate * gate else 0.0
        set_weights(data, weights)
        state, information, _, _ = refine(
            data, state, gradient, _NO_SCALE, 0.0, prior, noise, 2, _ITERATIONS, _TOLERANCE
        )
        errors = squared_errors(data, count, state, gradient)
        freedom = 12.0
        for i in range(PARAMETERS):
            column = np.zeros(PARAMETERS)
            for term in range(len(prior.informations)):
                column += prior.informations[term, :, i]
            taken, solved = solve_positive(information, column)
            if solved:
                freedom -= noise * noise * taken[i]
        noise = noise_deviation(errors, gate, freedom)
        gate = min(max(threshold, _GATE * noise), WIDEST_GATE * threshold)
    weights[:] = 1.0
    set_weights(data, weights)
    return state, information, errors, noise, gate, freedom


def maximum_a_posteriori(
    observations: Observations, start: Array, prior: PriorTerms, threshold: float
) -> Posterior:
    """Refine a motion on its inliers, which the noise decides that it leaves.

    Args:
        start: state (18,).
        threshold: px, least gate for inliers.
    """
    state, information, errors, noise, gate, freedom = _rounds(
        observations.packed,
        len(observations),
        start,
        observations.row_time_gradient,
        prior,
        threshold,
    )
    inverse, smallest = invert_information(information)
    inliers = errors < gate * gate
    left = max(2 * np.count_nonzero(inliers) - freedom, 6.0)
    # The noise itself is estimated, so that squared distances follow an F distribution; this makes
    # its 95 % quantile that of the chi-squared one, to half a percent from 40 degrees of freedom.
    inflation = left / (left - 5.0)
    covariance = inflation * noise**2 * inverse
    return Posterior(state, covariance, noise, inflation, smallest, inliers, errors)


def evidence_of_motion(posterior: Posterior, terms: PriorTerms) -> float:
    """By how many noise variances motion has to fit better than rest to be as probable.

    What the points tell of the velocities beyond the prior (the Occam factor: MacKay, "Bayesian
    interpolation", 1992), and at most what chance explains in one frame of a hundred: where they
    tell nothing, motion and rest are equally probable.
    """
    prior = np.diag(terms.informations[0])[6:]
    if not np.all(prior > 0.0):
        return _EVIDENCE_OF_MOTION
    learnt = -np.log(prior).sum() - np.linalg.slogdet(posterior.covariance[6:, 6:])[1]
    return float(np.clip(learnt, 0.0, _EVIDENCE_OF_MOTION))


def weigh_against_rest(
    observations: Observations, posterior: Posterior, terms: PriorTerms, rest: Array | None
) -> Posterior:
    """The average of the moving and the resting camera, by what the points say for either.

    A camera at rest deserves the six-parameter estimate, which is several times better. The six
    velocities have to lower the squared errors by as many noise variances as chance does in one
    frame of a hundred to count more than rest; the mean is that of the mixture of both, so that
    nothing jumps between them. That a slow motion was not seen does not mean that there was none:
    the covariance is that of the mixture by their probabilities (:func:`evidence_of_motion`), and
    that of the velocities what the moving model found.

    Args:
        terms: velocity prior and, if known, the direction of gravity.
        rest: state (18,) of the pose at rest, if it is not the one next to the moving one.
    """
    velocities = posterior.state[12:]
    spread = posterior.covariance[_VELOCITIES, _VELOCITIES]
    # To second order this is what holding the velocities at zero costs; no need to try at speed.
    if velocities @ np.linalg.solve(spread, velocities) > _CLEARLY_MOVING:
        return posterior
    noise = posterior.noise
    start = np.concatenate([posterior.state[:12], np.zeros(6)]) if rest is None else rest
    state, information, cost, _ = fit(
        observations, start, posterior.inliers, held_beside(terms), noise
    )
    moving_cost = float(posterior.squared_errors[posterior.inliers].sum())
    gained = (cost - moving_cost) / noise**2 - gravity_cost(terms, posterior.state)
    resting = 1.0 - _logistic(gained - _EVIDENCE_OF_MOTION)
    possible = _logistic(gained - evidence_of_motion(posterior, terms))
    # As seen from the moving estimate: rest lies one step away, the average a part of it.
    step = step_between(posterior.state, state)
    average = apply_step(posterior.state, resting * step)
    offsets = possible * resting**2 + (1.0 - possible) * (1.0 - resting) ** 2
    covariance = possible * posterior.covariance + offsets * np.outer(step, step)
    at_rest = posterior.variance * invert_information(np.ascontiguousarray(information[:6, :6]))[0]
    covariance[:6, :6] += (1.0 - possible) * at_rest
    covariance[_VELOCITIES, _VELOCITIES] += (1.0 - possible) * spread
    return replace(
        posterior,
        state=average,
        covariance=covariance,
        squared_errors=observations.squared_errors(average),
    )


def _logistic(evidence: float) -> float:
    """Probability of a model for which this many noise variances speak."""
    return 1.0 / (1.0 + math.exp(min(-0.5 * evidence, 700.0)))


def fit(
    observations: Observations, start: Array, inliers: BoolArray, prior: PriorTerms, noise: float
) -> tuple[Array, Array, float, bool]:
    """Refine a state (18,) on some of the points (see :func:`rs_localizer.core.refine.refine`)."""
    set_weights(observations.packed, inliers.astype(np.float64))
    fitted: tuple[Array, Array, float, bool] = refine(
        observations.packed,
        start,
        observations.row_time_gradient,
        _NO_SCALE,
        0.0,
        prior,
        noise,
        2,
        _ITERATIONS,
        _TOLERANCE,
    )
    set_weights(observations.packed, np.ones(len(observations)))
    return fitted
