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
from rs_localizer.core.lanes.jit import kernel
from rs_localizer.core.shake import FIRST_DEGREE, legendre, shake_basis
from rs_localizer.core.state import PARAMETERS
from rs_localizer.estimation.prior import PriorTerms, add_prior
from rs_localizer.estimation.residuals import linearized

# Coefficients of the field: polynomials of the image up to the third degree, in two directions.
_FIELD_DEGREE = 3
_FIELD_TERMS = (_FIELD_DEGREE + 1) * (_FIELD_DEGREE + 2) // 2
# Size of each degree: fields of lenses and maps are smooth, and no lens and no paper shears an
# image.
_FIELD_DEGREE_SIZES = (1.0, 0.2, 0.5, 0.25)
# Probability of no field above which none is looked for among neighbours.
_NO_FIELD = 0.5
# Points nearer than this part of the image that the points fill are neighbours in it.
_FAR_APART = 0.15
# Correlations below so many standard deviations are chance.
_CHANCE = 1.5
_MOST_SHARED = 0.9
# Of the noise, px^2: noise-free data leave rounding errors.
_LEAST_VARIANCE = 1e-8
# Where neither shaking nor field explains more than this (logarithm of the likelihood), there is
# nothing that both could explain.
_NOTHING_TO_SHARE = 1.0


class Columns(NamedTuple):
    """Products of all columns of a linearized frame, over its inliers.

    The columns are the derivatives by the motion (18), by the coefficients of the shaking (3 per
    polynomial) and by those of the field; products with the errors are those of the negative ones,
    for a least-squares step.
    """

    products: Array  # (m,m)
    with_errors: Array  # (m,)
    squared_errors: float
    shake: int  # coefficients


@kernel
def columns_of(
    errors: Array, by_motion: Array, by_turn: Array, tau: Array, rays: Array, inliers: BoolArray,
    degrees: int, field: bool,
) -> Columns:  # fmt: skip
    """Multiply the columns of a frame (see :func:`rs_localizer.estimation.residuals.linearized`).

    Args:
        errors, by_motion, by_turn, tau: of the points, at the motion.
        rays: (n,2) of the points, to say where in the image they are.
        inliers: (n,) the points that count.
        degrees: of the polynomials of the shaking; 0: none.
        field: whether to add the columns of the field.
    """
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for i in range(len(rays)):
        if inliers[i]:
            for k in range(2):
                low[k], high[k] = min(low[k], rays[i, k]), max(high[k], rays[i, k])
    polynomials = max(degrees - FIRST_DEGREE + 1, 0)
    shake = 3 * polynomials
    size = PARAMETERS + shake + (2 * _FIELD_TERMS if field else 0)
    products, with_errors, squared = np.zeros((size, size)), np.zeros(size), 0.0
    row = np.empty(size)
    values, rates = np.empty(polynomials), np.empty(polynomials)
    terms, x, y = np.empty(_FIELD_TERMS), np.empty(_FIELD_DEGREE + 1), np.empty(_FIELD_DEGREE + 1)
    for i in range(len(errors)):
        if not inliers[i]:
            continue
        if polynomials > 0:
            shake_basis(tau[i], degrees, values, rates)
        if field:
            legendre((2.0 * rays[i, 0] - low[0] - high[0]) / max(high[0] - low[0], 1e-12), x)
            legendre((2.0 * rays[i, 1] - low[1] - high[1]) / max(high[1] - low[1], 1e-12), y)
            _field_terms(x, y, terms)
        for line in range(2):
            for k in range(PARAMETERS):
                row[k] = by_motion[i, line, k]
            for k in range(polynomials):
                for axis in range(3):
                    row[PARAMETERS + 3 * k + axis] = values[k] * by_turn[i, line, axis]
            if field:
                for k in range(_FIELD_TERMS):
                    row[PARAMETERS + shake + k] = terms[k] if line == 0 else 0.0
                    row[PARAMETERS + shake + _FIELD_TERMS + k] = terms[k] if line == 1 else 0.0
            error = errors[i, line]
            squared += error * error
            for k in range(size):
                if row[k] != 0.0:
                    with_errors[k] -= row[k] * error
                    for m in range(k + 1):
                        products[k, m] += row[k] * row[m]
    for k in range(size):
        for m in range(k):
            products[m, k] = products[k, m]
    return Columns(products, with_errors, squared, shake)


@kernel
def with_prior(columns: Columns, prior: PriorTerms, state: Array, noise: float) -> Columns:
    """The columns and the prior of the motion at a state (24,), weighed against the noise (px)."""
    information, slope = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    cost = add_prior(
        prior.informations, prior.references, prior.gravity, state, noise * noise,
        information, slope,
    )  # fmt: skip
    products, with_errors = columns.products.copy(), columns.with_errors.copy()
    for i in range(PARAMETERS):
        with_errors[i] -= slope[i]
        for j in range(PARAMETERS):
            products[i, j] += information[i, j]
    return Columns(products, with_errors, columns.squared_errors + cost, columns.shake)


@kernel
def _field_terms(x: Array, y: Array, terms: Array) -> None:
    """Fill in the terms of a field whose expected mean square over the image is 1."""
    total = 0.0
    for degree in range(_FIELD_DEGREE + 1):
        total += (degree + 1) * _FIELD_DEGREE_SIZES[degree] ** 2
    place = 0
    for degree in range(_FIELD_DEGREE + 1):
        size = _FIELD_DEGREE_SIZES[degree] / np.sqrt(total)
        for i in range(degree + 1):
            j = degree - i
            terms[place] = size * np.sqrt((2.0 * i + 1.0) * (2.0 * j + 1.0)) * x[i] * y[j]
            place += 1


class Projected(NamedTuple):
    """A group of columns after the best motion was taken out of them."""

    products: Array  # (q,q) remaining
    with_errors: Array  # (q,) remaining
    squared_errors: float  # remaining, px^2


@kernel
def project_out(products: Array, with_errors: Array, squared_errors: float, kept: int) -> Projected:
    """Take the columns before the last ``kept`` ones, with their prior, out of these."""
    size = len(products)
    base = size - kept
    # L^-1 times the columns to keep and the errors, for the Cholesky factor L of the others; scaled
    # to a unit diagonal, so that radians, metres and held parameters are comparable.
    scale, factor = np.empty(base), np.empty((base, base))
    half = np.empty((base, kept + 1))
    for i in range(base):
        scale[i] = 1.0 / np.sqrt(products[i, i])
        for j in range(kept):
            half[i, j] = products[i, base + j] * scale[i]
        half[i, kept] = with_errors[i] * scale[i]
        for j in range(i + 1):
            total = products[i, j] * scale[i] * scale[j]
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            # A direction that nothing determines is left out.
            factor[i, j] = np.sqrt(max(total, 1e-15)) if i == j else total / factor[j, j]
        for k in range(i):
            for side in range(kept + 1):
                half[i, side] -= factor[i, k] * half[k, side]
        for side in range(kept + 1):
            half[i, side] /= factor[i, i]
    left, along, left_over = np.empty((kept, kept)), np.empty(kept), squared_errors
    for i in range(kept):
        for j in range(kept):
            left[i, j] = products[base + i, base + j]
        along[i] = with_errors[base + i]
    for k in range(base):
        left_over -= half[k, kept] * half[k, kept]
        for i in range(kept):
            along[i] -= half[k, i] * half[k, kept]
            for j in range(i + 1):
                left[i, j] -= half[k, i] * half[k, j]
    return Projected(left, along, left_over)


@kernel
def evidence_of_sizes(
    projected: Projected, sizes: Array, freedom: float, noise: float
) -> tuple[Array, Array]:
    """Logarithm of the marginal likelihood of sizes (k,), and the noise (k,) that goes with each.

    Args:
        projected: the group of columns.
        sizes: standard deviation of its coefficients.
        freedom: degrees of freedom of the errors.
        noise: a first estimate, px.
    """
    evidence, noises = np.empty(len(sizes)), np.empty(len(sizes))
    count = len(projected.with_errors)
    factor, half = np.empty((count, count)), np.empty(count)
    for index in range(len(sizes)):
        variance = noise * noise
        left, volume = projected.squared_errors, 0.0
        for _ in range(3):
            ratio = sizes[index] ** 2 / variance
            left, volume = projected.squared_errors, 0.0
            # Cholesky factor of I + ratio * products.
            for i in range(count):
                solved = ratio * projected.with_errors[i]
                for j in range(i + 1):
                    total = ratio * projected.products[i, j]
                    for k in range(j):
                        total -= factor[i, k] * factor[j, k]
                    if i == j:
                        factor[i, i] = np.sqrt(1.0 + max(total, 0.0))
                        volume += 2.0 * np.log(factor[i, i])
                    else:
                        factor[i, j] = total / factor[j, j]
                        solved -= factor[i, j] * half[j]
                half[i] = solved / factor[i, i]
                left -= half[i] * half[i] / ratio
            left = max(left, _LEAST_VARIANCE * freedom)
            variance = left / freedom
        evidence[index] = -0.5 * (freedom * np.log(variance) + volume)
        noises[index] = np.sqrt(variance)
    return evidence, noises


class Sizes(NamedTuple):
    """How large the shaking and the field of a frame are, root mean square of what is possible."""

    shake: float  # rad, of each coefficient
    field: float  # px
    noise: float  # px, beside them
    # Probability that there is none of it beyond what always may be.
    no_shake: float
    no_field: float
    # Logarithm of the marginal likelihood, but for the part of the motion.
    evidence: float
    # The same for each size that was tried, less that of the first.
    of_shake_sizes: Array
    of_field_sizes: Array


@kernel
def possible(evidence: Array, prior: Array, sizes: Array, noises: Array) -> Array:
    """Mean square size, mean noise, probability of the first size, and evidence of all (4,)."""
    weights = np.empty(len(evidence))
    highest = np.max(evidence)
    total = 0.0
    for k in range(len(evidence)):
        weights[k] = prior[k] * np.exp(evidence[k] - highest)
        total += weights[k]
    found = np.zeros(4)
    for k in range(len(evidence)):
        found[0] += weights[k] / total * sizes[k] ** 2
        found[1] += weights[k] / total * noises[k]
    found[2] = weights[0] / total
    found[3] = highest + np.log(total)
    return found


@kernel
def sizes_of(
    columns: Columns, freedom: float, noise: float,
    shake_sizes: Array, shake_prior: Array, field_sizes: Array, field_prior: Array,
) -> Sizes:  # fmt: skip
    """Estimate both sizes of a frame at its best motion.

    Args:
        columns: of the frame, with shaking, field and prior.
        freedom: degrees of freedom of the errors beside the motion.
        noise: a first estimate, px.
        shake_sizes, field_sizes: those to try (rad, px); the first is what there always may be.
        shake_prior, field_prior: their probabilities.
    """
    shake = columns.shake
    size = len(columns.with_errors)
    order = np.empty(size, dtype=np.int64)
    both, right, cost = columns.products.copy(), columns.with_errors, columns.squared_errors
    first = PARAMETERS + shake

    if shake == 0:
        fields = project_out(both, right, cost, size - first)
        evidence, noises = evidence_of_sizes(fields, field_sizes, freedom, noise)
        of_field = possible(evidence, field_prior, field_sizes, noises)
        return Sizes(
            0.0, np.sqrt(of_field[0]), of_field[1], 1.0, of_field[2], of_field[3],
            np.zeros(len(shake_sizes)), evidence - evidence[0],
        )  # fmt: skip

    # Each on its own; then the one that explains more, and the other beside it.
    shaking = project_out(both[:first, :first], right[:first], cost, shake)
    shake_evidence, noises = evidence_of_sizes(shaking, shake_sizes, freedom, noise)
    of_shake = possible(shake_evidence, shake_prior, shake_sizes, noises)
    shake_gain = of_shake[3] - shake_evidence[0]
    for k in range(PARAMETERS):
        order[k] = k
    for k in range(size - first):
        order[PARAMETERS + k] = first + k
    for k in range(shake):
        order[PARAMETERS + size - first + k] = PARAMETERS + k
    turned, turned_right = both[order][:, order], right[order]
    last = size - shake
    fields = project_out(turned[:last, :last], turned_right[:last], cost, last - PARAMETERS)
    field_evidence, noises = evidence_of_sizes(fields, field_sizes, freedom, noise)
    of_field = possible(field_evidence, field_prior, field_sizes, noises)
    field_gain = of_field[3] - field_evidence[0]
    found = of_field if field_gain > shake_gain else of_shake
    total = found[3]
    if max(shake_gain, field_gain) < _NOTHING_TO_SHARE:
        pass
    elif field_gain < shake_gain:
        variance = of_shake[1] ** 2 / of_shake[0]
        for k in range(PARAMETERS, first):
            both[k, k] += variance
        fields = project_out(both, right, cost, size - first)
        field_evidence, noises = evidence_of_sizes(fields, field_sizes, freedom, of_shake[1])
        of_field = possible(field_evidence, field_prior, field_sizes, noises)
        found = of_field
        total += of_field[3] - field_evidence[0]
    else:
        variance = of_field[1] ** 2 / of_field[0]
        for k in range(PARAMETERS, last):
            turned[k, k] += variance
        shaking = project_out(turned, turned_right, cost, shake)
        shake_evidence, noises = evidence_of_sizes(shaking, shake_sizes, freedom, of_field[1])
        of_shake = possible(shake_evidence, shake_prior, shake_sizes, noises)
        found = of_shake
        total += of_shake[3] - shake_evidence[0]
    return Sizes(
        np.sqrt(of_shake[0]), np.sqrt(of_field[0]), found[1], of_shake[2], of_field[2], total,
        shake_evidence - shake_evidence[0], field_evidence - field_evidence[0],
    )  # fmt: skip


@kernel
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
    scale = np.empty(kept)
    for i in range(kept):
        scale[i] = 1.0 / np.sqrt(matrix[i, i])
    for i in range(kept):
        for j in range(kept):
            matrix[i, j] *= scale[i] * scale[j]
        matrix[i, i] += 1e-14
    inverse = np.linalg.inv(matrix)
    for i in range(kept):
        for j in range(kept):
            inverse[i, j] *= scale[i] * scale[j]
    step = np.zeros(kept)
    covariance = np.empty((kept, kept))
    for i in range(kept):
        for k in range(kept):
            step[i] += inverse[i, k] * columns.with_errors[k]
        for j in range(kept):
            covariance[i, j] = noise * noise * inverse[i, j]
    for column in range(kept, size):
        pulled = np.zeros(kept)
        for i in range(kept):
            for k in range(kept):
                pulled[i] += inverse[i, k] * columns.products[k, column]
            pulled[i] *= field_size
        for i in range(kept):
            for j in range(kept):
                covariance[i, j] += pulled[i] * pulled[j]
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
    normalized: float = agreement / (0.5 * squared / count * np.sqrt(2.0 * max(pairs, 1)))
    return normalized


@kernel
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
    determined: float  # logarithm of the determinant of the information of the motion, px^2


@kernel
def examine(
    data: Array, state: Array, gradient: Array, rays: Array, measured_tau: Array,
    inliers: BoolArray,
    prior: PriorTerms, degrees: int, freedom: float, noise: float,
    shake_sizes: Array, shake_prior: Array, field_sizes: Array, field_prior: Array,
) -> Examined:  # fmt: skip
    """What a motion, the best without shaking, leaves of an image, and what that makes of it.

    Args:
        data, state, gradient: see :func:`rs_localizer.estimation.residuals.linearized`.
        rays, measured_tau: (n,2) and (n,) of the points.
        inliers: (n,) those that count.
        prior: of the motion.
        degrees: of the shaking; 0: the camera does not.
        freedom, noise, shake_sizes, ...: see :func:`sizes_of`.
    """
    count = len(rays)
    still = np.zeros((count, 6))
    errors, by_motion, by_turn, tau = linearized(data, count, state, gradient, still)
    columns = columns_of(errors, by_motion, by_turn, tau, rays, inliers, degrees, True)
    columns = with_prior(columns, prior, state, noise)
    sizes = sizes_of(
        columns, freedom, noise, shake_sizes, shake_prior, field_sizes, field_prior
    )  # fmt: skip
    step, covariance = with_model_error(columns, sizes.noise, sizes.shake, sizes.field)
    agreement = neighbours_agree(errors, measured_tau, rays, inliers)
    # Where no field is seen, nor is what neighbours share; and most frames have none.
    shared = shared_errors(errors, rays, inliers) if sizes.no_field < _NO_FIELD else 0.0
    determined = np.linalg.slogdet(columns.products[:PARAMETERS, :PARAMETERS])[1]
    return Examined(step, covariance, sizes, agreement, shared, determined)
