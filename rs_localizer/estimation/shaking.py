"""A camera that shakes while it is read out: vibration that no constant acceleration follows.

The turn beside the motion is a sum of polynomials of the row time
(:mod:`rs_localizer.estimation.model_error`), each with a size of its own that the frame tells: a
vibration has a frequency, and the polynomials near it are large (automatic relevance determination:
MacKay, "Bayesian nonlinear modeling for the prediction competition", 1994; here by expectation
maximization, with sizes that neighbouring degrees share).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.lanes.jit import kernel
from rs_localizer.core.shake import basis_sizes, shake_at
from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.columns import columns_of
from rs_localizer.estimation.model_error import RIDGE, neighbours_agree
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.posterior import GATE, WIDEST_GATE
from rs_localizer.estimation.prior_kernels import add_prior
from rs_localizer.estimation.prior_terms import PriorTerms
from rs_localizer.estimation.refine import apply_step, inverted
from rs_localizer.estimation.residuals import linearized

# Degrees to try, until neighbouring rows no longer agree: twelve follow a cycle and a half in one
# readout, twenty-two six.
_DEGREES = (12, 22)
# Errors whose neighbours agree more than this are not followed, in standard deviations.
AGREEMENT = 1.7
# Points within so many times the largest error of an inlier may belong to the scene.
_NEAR = 4.0
_FEWEST = 12  # points that shaking could be told from
_MOST_COEFFICIENTS = 1.0  # for each point, which gives two equations
_STEPS = 3
_INLIER_ROUNDS = 3
_SIZE_ROUNDS = 8
_DOUBT = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Shaken:
    """The motion and the shaking of a frame."""

    state: Array  # (24,)
    coefficients: Array  # (k,3) rad, of :func:`rs_localizer.core.shake.shake_basis`
    covariance: Array  # (18 + 3 k, 18 + 3 k)
    noise: float  # px
    agreement: float  # of what is left, see :func:`neighbours_agree`
    squared_errors: Array  # (n,) px^2
    inliers: BoolArray  # (n,)


def follow(
    observations: Observations,
    start: Array,
    inliers: BoolArray,
    terms: PriorTerms,
    noise: float,
    size: float,
    least_size: float,
    threshold: float,
) -> Shaken | None:
    """Fit motion and shaking together, and choose the inliers anew: those of a motion without
    shaking are the points that it happens to pass by.

    Args:
        start: state (24,), the best without shaking.
        threshold: px, least gate of inliers.

    None where the fit leaves what can be computed.
        noise: px, a first estimate.
        size, least_size: rad, of the coefficients: a first estimate, and what is always possible.
    """
    best = None
    for degrees in _DEGREES:
        if 3 * degrees > _MOST_COEFFICIENTS * np.count_nonzero(inliers):
            break
        found = _fit(observations, start, inliers, terms, noise, size, least_size, degrees)
        for _ in range(_INLIER_ROUNDS):
            if found is None:
                return best
            gate = min(max(threshold, GATE * found.noise), WIDEST_GATE * threshold)
            chosen = found.squared_errors < gate * gate
            if np.array_equal(chosen, found.inliers):
                break
            found = _fit(
                observations, found.state, chosen, terms, found.noise, size, least_size, degrees,
                found.coefficients,
            )  # fmt: skip
        if found is None:
            return best
        best = found
        if found.agreement < AGREEMENT:
            break
    return best


def _fit(
    observations: Observations,
    start: Array,
    inliers: BoolArray,
    terms: PriorTerms,
    noise: float,
    size: float,
    least_size: float,
    degrees: int,
    coefficients: Array | None = None,
) -> Shaken | None:
    state = start
    if coefficients is None:
        coefficients = np.zeros((degrees - 1, 3))
    # At first all are thought to be as large as each other, whatever the size of their polynomials.
    sizes = (size / basis_sizes(degrees)) ** 2
    count = len(observations)
    covariance = np.empty((0, 0))
    for _ in range(_STEPS):
        errors, by_motion, by_turn, tau = linearized(
            observations.packed,
            count,
            state,
            observations.row_time_gradient,
            shake_at(observations.tau, coefficients),
        )
        columns = columns_of(
            errors, by_motion, by_turn, tau, observations.rays, inliers, degrees, False
        )
        if not np.all(np.isfinite(columns.products)) or np.count_nonzero(inliers) < _FEWEST:
            return None
        information, slope = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
        add_prior(*terms, state, 1.0, information, slope)
        step, covariance, noise = _sizes_and_step(
            columns.products, columns.with_errors, columns.squared_errors,
            2.0 * np.count_nonzero(inliers), information, slope, coefficients, noise,
            least_size, sizes,
        )  # fmt: skip
        state = apply_step(state, step[:PARAMETERS])
        coefficients = coefficients + step[PARAMETERS:].reshape(-1, 3)
    errors, *_ = linearized(
        observations.packed,
        count,
        state,
        observations.row_time_gradient,
        shake_at(observations.tau, coefficients),
    )
    behind = np.isinf(observations.squared_errors(state))
    errors[behind] = 1e150
    squared = np.where(behind, np.inf, np.einsum("ni,ni->n", errors, errors))
    # Points beyond the gate count, too: where rows swing out of it, they do so together.
    gate = np.sqrt(squared[inliers & ~behind].max(initial=0.0))
    near = squared < (_NEAR * gate) ** 2
    lengths = np.sqrt(np.where(near, np.maximum(squared, 1e-300), 1.0))
    clipped = errors * np.minimum(1.0, gate / lengths)[:, None]
    agreement = neighbours_agree(clipped, observations.tau, observations.rays, near)
    return Shaken(state, coefficients, covariance, noise, agreement, squared, inliers)


@kernel
def _sizes_and_step(
    products: Array, with_errors: Array, squared_errors: float, equations: float,
    information: Array, slope: Array, coefficients: Array, noise: float, least_size: float,
    sizes: Array,
) -> tuple[Array, Array, float]:  # fmt: skip
    """Step (m,) of motion and coefficients, covariance, and noise; ``sizes`` (k,) are updated."""
    count = len(with_errors)
    held = coefficients.ravel()
    step, covariance = np.zeros(count), np.zeros((count, count))
    matrix, right = np.empty((count, count)), np.empty(count)
    found = np.empty(len(sizes))
    for round_ in range(_SIZE_ROUNDS):
        weight = 1.0 / (noise * noise)
        for i in range(count):
            for j in range(count):
                matrix[i, j] = weight * products[i, j]
            right[i] = weight * with_errors[i]
        for i in range(PARAMETERS):
            for j in range(PARAMETERS):
                matrix[i, j] += information[i, j]
            right[i] -= slope[i]
        # The sizes are estimates of few coefficients; the covariance allows for that.
        doubt = _DOUBT if round_ == _SIZE_ROUNDS - 1 else 1.0
        for k in range(PARAMETERS, count):
            precision = 1.0 / (doubt * sizes[(k - PARAMETERS) // 3])
            matrix[k, k] += precision
            right[k] -= precision * held[k - PARAMETERS]
        for i in range(count):
            matrix[i, i] *= RIDGE
        covariance = inverted(matrix)
        for i in range(count):
            along = 0.0
            for j in range(count):
                along += covariance[i, j] * right[j]
            step[i] = along
        if round_ == _SIZE_ROUNDS - 1:
            break
        # Expected squares of the coefficients, and of the errors.
        for k in range(len(sizes)):
            total = 0.0
            for axis in range(3):
                place = PARAMETERS + 3 * k + axis
                total += (held[3 * k + axis] + step[place]) ** 2 + covariance[place, place]
            found[k] = total / 3.0
        _share(found, least_size * least_size, sizes)
        left, freedom = squared_errors, equations
        for i in range(count):
            left -= 2.0 * step[i] * with_errors[i]
            for j in range(count):
                left += step[i] * step[j] * products[i, j]
                freedom -= weight * covariance[i, j] * products[i, j]
        noise = np.sqrt(max(left, 1e-8 * equations) / max(freedom, 1.0))
    return step, covariance, noise


@kernel
def _share(found: Array, least: float, sizes: Array) -> None:
    """Mean squares of the neighbouring degrees, even and odd alike."""
    count = len(found)
    for k in range(count):
        total, weights = 0.0, 0.0
        for shift in range(-2, 3):
            if 0 <= k + shift < count:
                weight = 3.0 - abs(shift)
                total += weight * found[k + shift]
                weights += weight
        sizes[k] = total / weights + least
