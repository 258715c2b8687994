"""A camera that shakes while it is read out: vibration that no constant acceleration follows.

The turn beside the motion is a sum of polynomials of the row time
(:mod:`rs_localizer.estimation.model_error`), each with a size of its own that the frame tells: a
vibration has a frequency, and the polynomials near it are large (automatic relevance determination:
MacKay, "Bayesian nonlinear modeling for the prediction competition", 1994; see
:mod:`rs_localizer.estimation.shake_sizes`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.shake import basis_sizes, shake_at
from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.columns import columns_of
from rs_localizer.estimation.model_error import neighbours_agree
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.posterior import GATE, WIDEST_GATE
from rs_localizer.estimation.prior_kernels import add_prior
from rs_localizer.estimation.prior_terms import PriorTerms
from rs_localizer.estimation.refine import apply_step
from rs_localizer.estimation.residuals import linearized
from rs_localizer.estimation.shake_sizes import sizes_and_step

DEGREES = (12, 22)
"""To try, until neighbouring rows no longer agree: twelve follow a cycle and a half in one readout,
twenty-two six."""
# Errors whose neighbours agree more than this are not followed, in standard deviations.
AGREEMENT = 1.7
# Points within so many times the largest error of an inlier may belong to the scene.
_NEAR = 4.0
_FEWEST = 12  # points that shaking could be told from
_MOST_COEFFICIENTS = 1.0  # for each point, which gives two equations
_STEPS = 3
_INLIER_ROUNDS = 3


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
    sizes: Array  # (k,) mean squares of the coefficients


class Scales(NamedTuple):
    """First estimates, and limits."""

    noise: float  # px
    size: float  # rad, of the coefficients
    least_size: float  # rad, that is always possible
    threshold: float  # px, least gate of inliers


def follow(
    observations: Observations,
    start: Array,
    inliers: BoolArray,
    terms: PriorTerms,
    scales: Scales,
) -> Shaken | None:
    """Fit motion and shaking together, and choose the inliers anew: those of a motion without
    shaking are the points that it happens to pass by.

    Args:
        start: state (24,), the best without shaking.

    None where the fit leaves what can be computed.
    """
    noise, size, least_size, threshold = scales
    best = None
    for degrees in DEGREES:
        if 3 * degrees > _MOST_COEFFICIENTS * np.count_nonzero(inliers):
            break
        # At first all are thought to be as large as each other, whatever the size of their
        # polynomials.
        first = Shaken(
            start, np.zeros((degrees - 1, 3)), np.empty((0, 0)), noise, 0.0, np.empty(0), inliers,
            (size / basis_sizes(degrees)) ** 2,
        )  # fmt: skip
        found = _fit(observations, first, inliers, terms, least_size, _STEPS)
        for _ in range(_INLIER_ROUNDS):
            if found is None:
                return best
            gate = min(max(threshold, GATE * found.noise), WIDEST_GATE * threshold)
            chosen = found.squared_errors < gate * gate
            if np.array_equal(chosen, found.inliers):
                break
            found = _fit(observations, found, chosen, terms, least_size, 1)
        if found is None:
            return best
        best = found
        if found.agreement < AGREEMENT:
            break
    return best


def _fit(
    observations: Observations,
    start: Shaken,
    inliers: BoolArray,
    terms: PriorTerms,
    least_size: float,
    steps: int,
) -> Shaken | None:
    """The fit near another one, of its degrees, with these inliers (n,); after so many steps."""
    state, coefficients, noise = start.state, start.coefficients, start.noise
    sizes = start.sizes.copy()
    degrees = len(coefficients) + 1
    count = len(observations)
    covariance = np.empty((0, 0))
    for _ in range(steps):
        lines = linearized(
            observations.packed,
            count,
            state,
            observations.row_time_gradient,
            shake_at(observations.tau, coefficients),
        )
        columns = columns_of(lines, inliers, degrees, False)
        if not np.all(np.isfinite(columns.products)) or np.count_nonzero(inliers) < _FEWEST:
            return None
        information, slope = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
        add_prior(*terms, state, 1.0, information, slope)
        step, covariance, noise = sizes_and_step(
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
    agreement = agreement_of(observations, errors, squared, inliers)
    return Shaken(state, coefficients, covariance, noise, agreement, squared, inliers, sizes)


def agreement_of(
    observations: Observations, errors: Array, squared_errors: Array, inliers: BoolArray
) -> float:
    """How much neighbouring rows agree (see :func:`neighbours_agree`) beside a shaking."""
    # Points beyond the gate count, too: where rows swing out of it, they do so together.
    seen = np.isfinite(squared_errors)
    gate = np.sqrt(squared_errors[inliers & seen].max(initial=0.0))
    near = squared_errors < (_NEAR * gate) ** 2
    lengths = np.sqrt(np.where(near, np.maximum(squared_errors, 1e-300), 1.0))
    clipped = errors * np.minimum(1.0, gate / lengths)[:, None]
    return neighbours_agree(clipped, observations.tau, observations.rays, near)
