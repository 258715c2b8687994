"""What a motion under constant acceleration misses of an image, and how much of it there is.

Two things leave errors that are no noise, because neighbours share them. A camera that *shakes*
turns, beside its motion, by a sum of polynomials of the row time; a slightly wrong lens, a bent map
or a map that is a little off leaves a *field* of errors that is smooth over the image. Both are
Gaussian processes with few coefficients, and one unknown each: how large they are. The errors of
the frame itself tell (the marginal likelihood of the size: MacKay, "Bayesian interpolation", 1992;
Patterson, Thompson, "Recovery of inter-block information", 1971), and what remains uncertain of it
is averaged.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.shake import FIRST_DEGREE
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.assumptions import FIELD_PRIOR
from rs_localizer.estimation.columns import Columns, columns_of, with_prior
from rs_localizer.estimation.evidence import (
    Sizes,
    evidence_of_sizes,
    log_determinant,
    project_out,
    sizes_of,
)
from rs_localizer.estimation.prior_terms import PriorTerms
from rs_localizer.estimation.refine import LEAST_NOISE, inverted
from rs_localizer.estimation.residuals import linearized
from rs_localizer.estimation.spectrum import Powers, powers

# Probability of no field, the one assumed beforehand, above which none is looked for among
# neighbours.
_NO_FIELD = float(FIELD_PRIOR[0])
# Points nearer than this part of the image that the points fill are neighbours in it.
_FAR_APART = 0.15
# Correlations below so many standard deviations are chance.
_CHANCE = 1.5
_MOST_SHARED = 0.9
# Of the diagonal: what nothing determines has an inverse.
RIDGE = 1.0 + 1e-14
# Sizes of shaking to try, as parts of the deviation to which a frame tells its coefficients.
_TRIED = np.array([1e-3, 0.3, 0.6, 1.2, 2.5, 10.0])


@inlined
def with_model_error(
    columns: Columns, noise: float, shake_size: float, field_size: float
) -> tuple[Array, Array]:
    """Step to the best motion beside the shaking, and its covariance with both.

    What is known of the shaking makes the estimate better, so that it joins in; the field only
    makes the covariance larger, because an estimate that allows for it would have to believe in
    its shape.

    Args:
        columns: of the frame, with shaking, field and prior.
        noise, shake_size, field_size: as in :class:`Sizes`.

    Returns:
        step and covariance of motion and coefficients of the shaking, (m,) and (m,m).
    """
    size, shake = len(columns.with_errors), columns.shake
    kept = PARAMETERS + shake
    matrix = columns.products[:kept, :kept].copy()
    for k in range(PARAMETERS, kept):
        matrix[k, k] += noise * noise / (shake_size * shake_size)
    for k in range(kept):
        matrix[k, k] *= RIDGE
    inverse = inverted(matrix)
    step, covariance = np.zeros(kept), noise * noise * inverse
    # Along the rows, one below the other: so that the registers are full.
    for k in range(kept):
        for i in range(kept):
            step[i] += inverse[k, i] * columns.with_errors[k]
    pulled = np.empty(kept)
    for column in range(kept, size):
        pulled[:] = 0.0
        for k in range(kept):
            factor, row = field_size * columns.products[column, k], inverse[k]
            for i in range(kept):
                pulled[i] += factor * row[i]
        for i in range(kept):
            factor, into = pulled[i], covariance[i]
            for j in range(kept):
                into[j] += factor * pulled[j]
    return step, covariance


@kernel
def neighbours_agree(errors: Array, tau: Array, rays: Array, inliers: BoolArray) -> float:
    """How much the errors of points in neighbouring rows agree: standard normal if they do not.

    Neighbours in the image do not count: corners of one marker share errors whatever the camera
    does.
    """
    order = np.argsort(tau)
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    squared, count = 0.0, 0
    for i in order:
        if inliers[i]:
            squared += errors[i, 0] ** 2 + errors[i, 1] ** 2
            count += 1
            for k in range(2):
                low[k], high[k] = min(low[k], rays[i, k]), max(high[k], rays[i, k])
    if count < 2 or not squared > 0.0:
        return 0.0
    far = _FAR_APART * max(high[0] - low[0], high[1] - low[1])
    agreement, pairs = 0.0, 0
    previous = -1
    for i in order:
        if not inliers[i]:
            continue
        if previous >= 0:
            x, y = rays[i, 0] - rays[previous, 0], rays[i, 1] - rays[previous, 1]
            if x * x + y * y > far * far:
                pairs += 1
                agreement += errors[previous, 0] * errors[i, 0] + errors[previous, 1] * errors[i, 1]
        previous = i
    # Each of the two products of a pair has the square of the mean square as its variance.
    variance = max(0.5 * squared / count, LEAST_NOISE * LEAST_NOISE)
    normalized: float = agreement / (variance * np.sqrt(2.0 * max(pairs, 1)))
    return normalized


@inlined
def shared_errors(errors: Array, rays: Array, inliers: BoolArray) -> float:
    """Correlation of the errors of points with those of their nearest neighbours in the image.

    Beyond what chance makes of it; corners of one marker that is a little off share its error.
    """
    shared, squared, count = 0.0, 0.0, 0
    for i in range(len(rays)):
        if not inliers[i]:
            continue
        nearest, least = -1, np.inf
        for j in range(len(rays)):
            if inliers[j] and j != i:
                x, y = rays[i, 0] - rays[j, 0], rays[i, 1] - rays[j, 1]
                if x * x + y * y < least:
                    nearest, least = j, x * x + y * y
        if nearest >= 0:
            shared += errors[i, 0] * errors[nearest, 0] + errors[i, 1] * errors[nearest, 1]
        squared += errors[i, 0] ** 2 + errors[i, 1] ** 2
        count += 1
    if not squared > 0.0:
        return 0.0
    correlation = shared / squared - _CHANCE / np.sqrt(2.0 * count)
    within: float = min(max(correlation, 0.0), _MOST_SHARED)
    return within


class Examined(NamedTuple):
    """What :func:`examine` finds of a motion."""

    step: Array  # (m,) to the best motion beside the shaking
    covariance: Array  # (m,m) of motion and coefficients of the shaking
    sizes: Sizes
    agreement: float  # of neighbouring rows, see :func:`neighbours_agree`
    # Correlation of each point's error with that of its neighbour in the image.
    shared: float
    tones: Powers  # how loud they are among the errors
    determined: float  # logarithm of the determinant of the information of the motion, px^2
    cost: float  # of the points and the prior after the step, px^2
    # Whether the points are enough for what was asked of them: else covariances are none.
    finite: bool
    columns: Columns  # without the prior


@kernel
def examine(
    data: Array, state: Array, gradient: Array, rays: Array, measured_tau: Array,
    inliers: BoolArray,
    prior: PriorTerms, degrees: int, freedom: float, noise: float,
    shake_sizes: Array, shake_prior: Array, field_sizes: Array, field_prior: Array,
    neighbours: bool,
) -> Examined:  # fmt: skip
    """What a motion, the best without shaking, leaves of an image, and what that makes of it.

    Args:
        data, state, gradient: see :func:`rs_localizer.estimation.residuals.linearized`.
        rays, measured_tau: (n,2) and (n,) of the points.
        inliers: (n,) those that count.
        prior: of the motion.
        degrees: of the shaking; 0: the camera does not.
        freedom, noise, shake_sizes, ...: see :func:`sizes_of`.
        neighbours: whether to ask how much they agree, else 0.
    """
    count = len(rays)
    still = np.zeros((count, 6))
    lines = linearized(data, count, state, gradient, still)
    columns = columns_of(lines, inliers, degrees, True)
    found = judged(
        columns, prior, state, freedom, noise, shake_sizes, shake_prior, field_sizes, field_prior
    )
    if not neighbours:
        return found
    # Where no field is seen, nor is what neighbours share; and most frames have none.
    seen = found.sizes.no_field < _NO_FIELD
    return Examined(
        found.step, found.covariance, found.sizes,
        neighbours_agree(lines.errors, measured_tau, rays, inliers),
        shared_errors(lines.errors, rays, inliers) if seen else 0.0,
        powers(lines.errors, lines.by_turn, measured_tau, inliers),
        found.determined, found.cost, found.finite, columns,
    )  # fmt: skip


@kernel
def judged(
    columns: Columns, prior: PriorTerms, state: Array, freedom: float, noise: float,
    shake_sizes: Array, shake_prior: Array, field_sizes: Array, field_prior: Array,
) -> Examined:  # fmt: skip
    """What the columns of a motion make of it under a prior, but for what neighbours share."""
    known = with_prior(columns, prior, state, noise)
    sizes = sizes_of(
        known, freedom, noise, shake_sizes, shake_prior, field_sizes, field_prior
    )  # fmt: skip
    step, covariance = with_model_error(known, sizes.noise, sizes.shake, sizes.field)
    determined = log_determinant(known.products[:PARAMETERS, :PARAMETERS])
    cost, total = known.squared_errors, 0.0
    for k in range(len(step)):
        cost -= step[k] * known.with_errors[k]
        total += step[k] + covariance[k, k]
    return Examined(
        step, covariance, sizes, 0.0, 0.0, Powers(0.0, np.zeros((0, 0))), determined, cost,
        bool(np.isfinite(total)), columns,
    )  # fmt: skip


@kernel
def gain_of_shaking(
    data: Array, state: Array, gradient: Array, inliers: BoolArray, prior: PriorTerms,
    degrees: int, freedom: float, noise: float,
) -> float:  # fmt: skip
    """How much better shaking of some size, alike at all degrees, explains the errors than none.

    The logarithm of the ratio of their likelihoods, by one linear solve; errors of map and lens
    count as shaking, too.

    Args:
        data, state, ...: as of :func:`examine`; degrees of the shaking, 2 at least.
    """
    count = len(inliers)
    lines = linearized(data, count, state, gradient, np.zeros((count, 6)))
    columns = columns_of(lines, inliers, degrees, False)
    columns = with_prior(columns, prior, state, noise)
    found = project_out(
        columns.products, columns.with_errors, columns.squared_errors, columns.shake
    )
    known = 0.0
    for i in range(columns.shake):
        size = _size_of(i // 3)
        found.with_errors[i] /= size
        for j in range(i + 1):
            found.products[i, j] /= size * _size_of(j // 3)
        known += found.products[i, i]
    typical = noise * np.sqrt(columns.shake / known)
    evidence, _ = evidence_of_sizes(found, typical * _TRIED, freedom, noise)
    gain: float = np.max(evidence) - evidence[0]
    return gain


@kernel
def _size_of(polynomial: int) -> float:
    return (3.0 / (FIRST_DEGREE + polynomial)) ** 2
