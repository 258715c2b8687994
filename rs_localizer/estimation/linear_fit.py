# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The one linear fit: blocks of unknowns with Gaussian priors beside errors that points share.

A frame, linearized at a motion with in-frame rotation, is

    e = M y + T k + S f + noise,      k ~ N(0, t^2 C),  f ~ N(0, s^2),  noise ~ N(0, n^2)

``M`` are the columns of the motion. ``T`` are those of the in-frame rotation that the rows of one
readout resolve: whole cosines and sines, so that ``y`` is the motion without its vibration. ``S``
are those of smooth errors (:mod:`.smooth_error`). With ``S = U diag(d)^(1/2) V^T`` the products of
``[M T]`` and ``U`` give all that a fit needs, for every size ``s`` and noise ``n``:

    M^T W M = (M^T M - (U^T M)^T diag(a) U^T M) / n^2,      a = s^2 d / (n^2 + s^2 d)

The motion is eliminated (Schur's complement), which leaves ``N = T^T W T`` and ``h = T^T W e``.
Each spectrum ``C`` of each size ``t`` then needs one Cholesky factor:

    log evidence = -log det(1 + t^2 C N) / 2 - freedom / 2 log(1 - h^T (N + C^-1/t^2)^-1 h / rest)

This is Student's form, because the noise comes from the same errors. Sizes and spectra are
integrated; at each size the noise is the one that the errors leave (restricted likelihood:
Patterson, Thompson 1971).

The prior of ``k`` is an argument (:class:`TurnPrior`): for a vibration that nothing else measures
it is :data:`VIBRATION`. Where readings tell the rotation, :mod:`.known_rotation` makes one of them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, Array3, BoolArray1
from rs_localizer.core.shake import (
    COMBINATIONS,
    CYCLES,
    FUNCTIONS,
    IN_COMBINATIONS,
    MIDDLE_RATES,
    MIDDLE_VALUES,
    RESOLVED,
    TYPICAL_SIZES,
    shake_basis,
)
from rs_localizer.core.state import ANGULAR, PARAMETERS, TURN
from rs_localizer.estimation.gaussian import moments
from rs_localizer.estimation.prior import PriorTerms, add_prior
from rs_localizer.estimation.projection import Lines
from rs_localizer.estimation.robust import LEAST_NOISE, TINY, half_inverse, squared
from rs_localizer.estimation.smooth_error import ORDINARY, Shared
from rs_localizer.native import entry, kernel

TURNS: int = 3 * RESOLVED
"""Unknowns of the in-frame turn."""
BLOCKS: dict[str, slice] = {
    "motion": slice(0, PARAMETERS),
    "turn": slice(PARAMETERS, PARAMETERS + TURNS),
}
"""Places of the unknowns, by name."""
SHARED = "shared"
"""The name of the errors that points share, which are noise and no unknowns."""
MIDDLE = np.zeros((PARAMETERS, TURNS))
"""How the coefficients of the in-frame turn turn the middle row, and how fast."""
_VALUES, _RATES = MIDDLE_VALUES @ COMBINATIONS, MIDDLE_RATES @ COMBINATIONS
MIDDLE[TURN], MIDDLE[ANGULAR] = np.kron(_VALUES, np.eye(3)), np.kron(_RATES, np.eye(3))
# Places of the unknowns among columns that are sorted by axis.
_BY_COMBINATION = np.r_[:PARAMETERS, PARAMETERS + np.arange(TURNS).reshape(3, RESOLVED).T.ravel()]

_CENTRES, _WIDTH, _FLOOR = (0.75, 1.5, 3.0, 5.0), 0.4, 0.03
_BANDS = np.exp(-0.5 * (np.log(CYCLES[None] / np.array(_CENTRES)[:, None]) / _WIDTH) ** 2) + _FLOOR
SPECTRA = np.concatenate([
    TYPICAL_SIZES[None],
    _BANDS * np.sqrt((TYPICAL_SIZES**2).sum() / (_BANDS**2).sum(axis=1))[:, None],
])  # fmt: skip
"""(s,14) rad, deviations of the frequencies of the in-frame turn: of an ordinary vibration, and of
bands about some cycles per readout, all of the same mean square."""
FACTORS = np.exp(1.15 * np.arange(-2.0, 5.0))
"""Vibration is so many times the ordinary one: three in a decade, up to a degree."""
# Deviation of the logarithm of the size of vibration: a decade.
_DECADE = math.log(10.0)
# Ridge of products, for the rounding of columns that the motion mimics.
_RIDGE = 1e-9
# Errors that are left at least: the linear model holds no farther.
_LEAST_LEFT = 1e-4
# Pivots below this part of what they are made of are rounding.
_ROUNDING = 1e-14
# Noise beside a smooth error is so many times that of the fit without one.
_LEAST_PART, _MOST_PART = 0.16, 1.3
# Least share of the equations that columns leave to measure the noise with.
_LEAST_FREEDOM = 0.1
# Logarithm of the odds below which larger sizes are not looked at, and a size has no part.
_HOPELESS, _NO_PART = 9.0, 1e-3
# Points whose columns are multiplied at a time.
_PART = 64


class TurnPrior(NamedTuple):
    """Prior of the in-frame rotation: Gaussians of some spectra, each of some sizes."""

    informations: Array3  # (s,54,54) of the coefficients, at a factor of one
    volumes: Array1  # (s,) half the logarithms of their determinants
    factors: Array1  # (f,) of the deviations
    odds: Array2  # (s,f) logarithms of the probabilities; minus infinity: not looked at

    def of_first(self) -> TurnPrior:
        """Return the first spectrum alone, with its odds among all."""
        return TurnPrior(self.informations[:1], self.volumes[:1], self.factors, self.odds[:1])


def _vibration() -> TurnPrior:
    informations = np.array([
        np.kron(
            np.linalg.inv(IN_COMBINATIONS * np.repeat(one, 2) ** 2 @ IN_COMBINATIONS.T), np.eye(3)
        )
        for one in SPECTRA
    ])  # fmt: skip
    odds = np.tile(-0.5 * (np.log(FACTORS) / _DECADE) ** 2, (len(SPECTRA), 1))
    return TurnPrior(
        informations, 0.5 * np.linalg.slogdet(informations)[1], FACTORS,
        odds - np.log(np.exp(odds).sum()),
    )  # fmt: skip


VIBRATION = _vibration()
"""Prior of the in-frame turn that nothing but the points measures."""
NO_TURN = TurnPrior(np.zeros((0, TURNS, TURNS)), np.zeros(0), FACTORS, np.zeros((0, len(FACTORS))))
"""Prior for products that have no columns of an in-frame turn."""


class Linear(NamedTuple):
    """Products of the columns of a frame's chosen points, and their errors."""

    own: Array2  # (p,p) of the unknowns
    along: Array1  # (p,) with the errors
    square: float  # px^2, of the errors
    beside: Array2  # (q,p) of what points share and the unknowns
    shown: Array1  # (q,) and the errors


class Noise(NamedTuple):
    """Noise by a fit without anything that points share."""

    deviation: float  # px
    correction: float  # of the mean square, because the gate cuts errors off
    decided: float  # parameters that the points decide


class KnownMotion(NamedTuple):
    """The prior of the motion, or of all unknowns, where a frame is linearized."""

    information: Array2  # (18,18), or (p,p)
    slope: Array1  # (18,), or (p,)
    cost: float
    volume: float  # half the logarithm of the determinant of what it knows


class LinearFit(NamedTuple):
    """A Gaussian of all unknowns, integrated over sizes and spectra."""

    step: Array  # (p,) from where the products are; the turn is whole
    covariance: Array  # (p,p)
    evidence: float  # logarithm; minus infinity: nothing was found
    cost: float  # that is left at the most probable size, noise variances
    gain: float  # the part of it that the in-frame turn explains
    noise: float  # px
    size: float  # px, root mean square of what points share
    freedom: float
    weights: Array  # (s,f) of spectra and factors of the in-frame turn


@entry
def linear_of(lines: Lines, chosen: BoolArray1, turns: bool, rows: Array2) -> Linear:
    """Return the products of the chosen points at a motion with in-frame rotation.

    Args:
        turns: with the block of the in-frame turn.
        rows: (2m,q) of what points share.
    """
    size, picked = PARAMETERS + (TURNS if turns else 0), np.flatnonzero(chosen)
    every, beside = np.zeros((size + 1, size + 1)), np.zeros((rows.shape[1], size + 1))
    columns = np.empty((2 * min(_PART, len(picked)), size + 1))
    values, rates = np.zeros((_PART, FUNCTIONS)), np.empty(FUNCTIONS)
    for first in range(0, len(picked), _PART):  # whose columns stay in the processor's cache
        some = picked[first : first + _PART]
        if turns:
            for i in range(len(some)):
                shake_basis(lines.tau[some[i]], values[i], rates)
        each, part = values @ COMBINATIONS, columns[: 2 * len(some)]
        for i in range(len(some)):
            for side in range(2):
                motion = lines.by_motion[some[i], side]
                row, by_turn = part[2 * i + side], lines.by_turn[some[i], side]
                row[:PARAMETERS], row[size] = motion, lines.errors[some[i], side]
                for axis in range(3 if turns else 0):  # behind each other, as vectors want it
                    value, rate, swing = motion[axis], motion[6 + axis], by_turn[axis]
                    place = row[PARAMETERS + RESOLVED * axis :]
                    for j in range(RESOLVED):
                        place[j] = each[i, j] * swing + _VALUES[j] * value + _RATES[j] * rate
        every += part.T @ part
        beside += rows[2 * first : 2 * (first + len(some))].T @ part
    own, along, shown = every[:size, :size], every[:size, size].copy(), beside[:, :size]
    if turns:
        order = _BY_COMBINATION
        own, along, shown = own[order][:, order], along[order], shown[:, order]
    return Linear(own.copy(), along, every[size, size], shown.copy(), beside[:, size].copy())


def without(linear: Linear, name: str) -> Linear:
    """Return the system without a block of unknowns, or without shared errors."""
    if name == SHARED:
        return linear._replace(
            beside=np.zeros_like(linear.beside[:1]), shown=np.zeros_like(linear.shown[:1])
        )
    (kept,) = (place for other, place in BLOCKS.items() if other != name)
    return linear._replace(
        own=linear.own[kept, kept].copy(), along=linear.along[kept],
        beside=linear.beside[:, kept].copy(),
    )  # fmt: skip


def moved(linear: Linear, step: Array) -> Linear:
    """Return the system at a point that lies so far (p,) along the tangent."""
    along = linear.own @ step
    return linear._replace(
        along=linear.along + along,
        square=float(linear.square + step @ (2.0 * linear.along + along)),
        shown=linear.shown + linear.beside @ step,
    )  # fmt: skip


def marginal(fit: LinearFit, name: str) -> tuple[Array, Array]:
    """Return mean and covariance of a block of unknowns."""
    place = BLOCKS[name]
    return fit.step[place], fit.covariance[place, place]


def under(fit: LinearFit, before: KnownMotion, after: KnownMotion) -> LinearFit:
    """Return the fit under another prior of the motion, both at the products' state (Kalman 1960).

    The noise is unknown, so this is Student's form, too.
    """
    place = BLOCKS["motion"]
    more, pull = after.information - before.information, after.slope - before.slope
    mean, across = fit.step[place], fit.covariance[:, place]
    whole = np.eye(PARAMETERS) + more @ across[place]
    gain, pulled = np.linalg.solve(whole.T, across.T).T, np.linalg.solve(whole, pull + more @ mean)
    step = fit.step - across @ pulled
    cost = after.cost - before.cost + float(pull @ step[place] + mean @ pulled)
    evidence = after.volume - before.volume - 0.5 * float(np.linalg.slogdet(whole)[1])
    evidence -= 0.5 * fit.freedom * math.log(max(1.0 + cost / fit.freedom, _LEAST_LEFT))
    covariance = fit.covariance - gain @ more @ across.T
    covariance[:, place], covariance[place] = gain, gain.T  # not as a difference of large ones
    return fit._replace(step=step, covariance=covariance, evidence=fit.evidence + evidence)


@entry
def known_at(terms: PriorTerms, state: Array1) -> KnownMotion:
    """Return the prior of a motion at a state (24,)."""
    information, slope = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    cost, volume = add_prior(terms, state, 1.0, information, slope), 0.0
    for k in range(PARAMETERS):
        if terms.informations[0, k, k] > 0.0:
            volume += 0.5 * math.log(terms.informations[0, k, k])
    return KnownMotion(information, slope, cost, volume)


@kernel
def taken_by(squares: Array1, size: float, noise: float) -> Array:
    """Return the share (q,) of each column that shared errors explain."""
    own = size * size * squares
    return own / (noise * noise + own)


@kernel
def _rest_of(linear: Linear, taken: Array1, step: Array1) -> float:
    """Sum of the squares (px^2) that are noise, after a step."""
    total = linear.square + 2.0 * np.sum(linear.along * step) + np.sum(step * (linear.own @ step))
    seen = linear.shown + linear.beside @ step
    total -= np.sum((1.0 - (1.0 - taken) ** 2) * seen * seen)
    rest: float = max(total, 0.0)
    return rest


@kernel
def cost_of(linear: Linear, taken: Array1, variance: float, known: KnownMotion) -> float:
    """Return the errors beside what points share, in noise variances, and the prior's cost."""
    cost: float = (linear.square - np.sum(taken * linear.shown * linear.shown)) / variance
    return cost + known.cost


@kernel
def _weighed(linear: Linear, taken: Array1, variance: float, known: KnownMotion) -> tuple[
    Array, Array
]:  # fmt: skip
    """Return the information (p,p) and slope (p,), the prior's included."""
    scaled = linear.beside.copy()
    for k in range(len(taken)):
        scaled[k] *= taken[k]
    information = (linear.own - scaled.T @ linear.beside) / variance
    slope = (linear.along - scaled.T @ linear.shown) / variance
    size = len(known.slope)
    slope[:size] += known.slope
    information[:size, :size] += known.information
    return information, slope


class _AtOneSize(NamedTuple):
    """A fit at one size and noise."""

    step: Array  # (p,)
    covariance: Array  # (p,p)
    cost: float  # that is left; of unknown noise, where there is an in-frame turn
    log_determinant: float  # of the motion's information
    gain: float
    ratio: float  # of the noise's variance to the one that was taken
    used: float  # parameters that the turn takes
    weights: Array  # (s,f)


@kernel
def _solved(
    information: Array2, slope: Array1, cost: float, freedom: float, prior: TurnPrior, finely: bool
) -> tuple[_AtOneSize, bool]:
    """Take out the motion, then the in-frame turn of each spectrum and size."""
    size = len(slope)
    half, scale, positive = half_inverse(information[:PARAMETERS, :PARAMETERS].copy())
    inverse, log_determinant = squared(half, scale), 0.0
    for k in range(PARAMETERS):
        log_determinant -= 2.0 * math.log(half[k, k] * scale[k]) if positive else 0.0
    first = slope[:PARAMETERS].copy()
    step = -inverse @ first
    rest = cost + float(np.sum(first * step))
    none = np.zeros(prior.odds.shape)
    if size == PARAMETERS or not positive:
        return _AtOneSize(step, inverse, rest, log_determinant, 0.0, 1.0, 0.0, none), positive
    crossed = information[:PARAMETERS, PARAMETERS:].copy()
    # The factor is used: the inverse would square its rounding, and own would no longer be
    # positive.
    white = (half * scale) @ crossed
    pulled = -((half * scale).T @ white)
    own = information[PARAMETERS:, PARAMETERS:] - white.T @ white
    for k in range(len(own)):  # columns that the motion mimics wholly explain nothing
        own[k, k] += _RIDGE * information[PARAMETERS + k, PARAMETERS + k]
    along = slope[PARAMETERS:] + crossed.T @ step
    rest = max(rest, TINY)
    turn, of_turn, gain, ratio, weights = _over_turns(own, along, rest, freedom, prior, finely)
    whole, covariance = np.empty(size), np.empty((size, size))
    whole[:PARAMETERS], whole[PARAMETERS:] = step + pulled @ turn, turn
    across = pulled @ of_turn
    covariance[:PARAMETERS, :PARAMETERS] = ratio * inverse + across @ pulled.T
    covariance[:PARAMETERS, PARAMETERS:] = across
    covariance[PARAMETERS:, :PARAMETERS] = across.T
    covariance[PARAMETERS:, PARAMETERS:] = of_turn
    cost = freedom * (1.0 + math.log(rest / freedom))
    used = np.sum(own * of_turn) / ratio
    found = _AtOneSize(whole, covariance, cost, log_determinant, gain, ratio, used, weights)
    return found, bool(np.isfinite(gain))


@kernel
def _factor(own: Array, along: Array, information: Array, factor: float, equations: Array) -> None:
    """Fill in ``[R z]`` (n,n+1) with ``R^T R = A``, what the points say and a prior, and
    ``R^T z = h``.

    ``A`` is positive but for rounding, which no pivot is smaller than. In a third of the time of
    ``np.linalg.cholesky``, which would raise.
    """
    size, weight = len(own), 1.0 / factor**2
    least = np.empty(size)
    for i in range(size):
        row, shown, known = equations[i], own[i], information[i]
        for j in range(size):
            row[j] = shown[j] + weight * known[j]
        row[size], least[i] = along[i], max(_ROUNDING * row[i], TINY)
    for k in range(0, size, 2):  # two at a time: each row is read and written half as often
        first = equations[k, k:]
        _scaled(first, least[k])
        if k + 1 == size:
            break
        second, beside, part = equations[k + 1, k + 1 :], first[1:], first[1]
        for j in range(len(second)):
            second[j] -= part * beside[j]
        _scaled(second, least[k + 1])
        for i in range(k + 2, size):
            # Loops over slices from zero are what the compiler makes vectors of.
            other, beside, beneath = equations[i, i:], first[i - k :], second[i - k - 1 :]
            part, more = beside[0], beneath[0]
            for j in range(len(other)):
                other[j] -= part * beside[j] + more * beneath[j]


@kernel
def _scaled(row: Array, least: float) -> None:
    scale = 1.0 / math.sqrt(max(row[0], least))
    for j in range(len(row)):
        row[j] *= scale


@kernel
def _half_of(factor: Array2) -> Array:
    """Return the inverse of a lower triangle, in a fifth of the time of ``np.linalg.inv``."""
    size = len(factor)
    half = np.zeros((size, size))
    for i in range(size):
        row, inverse = half[i], 1.0 / factor[i, i]
        for k in range(i):  # along the rows, for the sake of the caches
            above, part = half[k], factor[k, i] * inverse
            for j in range(k + 1):
                row[j] -= part * above[j]
        row[i] = inverse
    return half


@kernel
def _back(factor: Array2, solution: Array1) -> None:
    """Fill in the solution (n,) of ``A x = -h``, by a factor ``[R z]`` (n,n+1)."""
    size = len(factor)
    for i in range(size):
        solution[i] = -factor[i, size]
    for i in range(size - 1, -1, -1):
        part = solution[i] / factor[i, i]
        solution[i] = part
        for k in range(i):
            solution[k] -= part * factor[k, i]


@kernel
def _over_turns(
    own: Array2, along: Array1, rest: float, freedom: float, prior: TurnPrior, finely: bool
) -> tuple[Array, Array, float, float, Array]:
    """Integrate over spectra and sizes of the in-frame turn beside the motion.

    Returns:
        mean (54,) and covariance (54,54); logarithm of the evidence, against none; how much of the
        noise's variance is left; weights (s,f).
    """
    size, (spectra, factors) = len(along), prior.odds.shape
    # With the errors as one more column the factor holds all results.
    wholes, weights = (
        np.empty((spectra * factors, size, size + 1)),
        np.full((spectra, factors), -np.inf),
    )
    means, left, best = np.zeros((spectra, factors, size)), np.ones((spectra, factors)), -np.inf
    nothing = np.zeros(size), np.zeros((size, size)), -np.inf, 1.0, weights
    if not (np.all(np.isfinite(own)) and np.all(np.isfinite(along)) and np.isfinite(rest)):
        return nothing
    # What a turn of any size explains.
    _factor(own, along, prior.informations[0], np.inf, wholes[0])
    free = max(1.0 - np.sum(wholes[0, :, size] ** 2) / rest, _LEAST_LEFT)
    ceiling = -0.5 * freedom * math.log(free)
    for s in range(spectra):
        volume = 0.0
        for f in range(factors):
            if prior.odds[s, f] == -np.inf:
                continue
            is_less = f and prior.odds[s, f] < prior.odds[s, f - 1]
            if is_less and prior.odds[s, f] + volume + ceiling < best - _HOPELESS:
                break
            whole = wholes[s * factors + f]
            _factor(own, along, prior.informations[s], prior.factors[f], whole)
            _back(whole, means[s, f])
            explained, volume = 0.0, prior.volumes[s] - size * math.log(prior.factors[f])
            for k in range(size):
                explained += whole[k, size] ** 2
                volume -= math.log(whole[k, k])
            left[s, f] = max(1.0 - explained / rest, _LEAST_LEFT)
            weights[s, f] = prior.odds[s, f] + volume - 0.5 * freedom * math.log(left[s, f])
            best = max(best, weights[s, f])
            if is_less and weights[s, f] < best - _HOPELESS:
                break
    if not best > -np.inf:
        return nothing
    weights = np.exp(weights - best)
    total = np.sum(weights)
    weights /= total
    away, parts = means.reshape(-1, size), weights.ravel()
    mean = parts @ away
    for k in range(len(parts)):
        away[k] = math.sqrt(parts[k]) * (away[k] - mean)
    covariance, least = away.T @ away, _NO_PART if finely else np.max(weights)
    left *= rest / freedom
    share = 1.0 / np.sum(np.where(weights >= least, weights, 0.0))
    for s in range(spectra):
        for f in range(factors):
            if weights[s, f] >= least:
                half = _half_of(wholes[s * factors + f])
                covariance += (share * weights[s, f] * left[s, f]) * (half.T @ half)
    return mean, covariance, best + math.log(total), np.sum(weights * left), weights


@entry
def fit(
    linear: Linear, shared: Shared, known: KnownMotion, noise: Noise, prior: TurnPrior,
    finely: bool,
) -> LinearFit:  # fmt: skip
    """Fit all unknowns, integrated over the size of what points share and over in-frame turns.

    Args:
        prior: of the in-frame turn; ``NO_TURN`` where the products have no such block.
        finely: with the covariance of all in-frame turns, and not of the most probable spectrum and
            size alone, which takes a third of the time.
    """
    grid, size, equations = len(shared.sizes), len(linear.along), len(shared.rows)
    steps, covariances = np.zeros((grid, size)), np.zeros((grid, size, size))
    evidences, noises, gains = np.full(grid, -np.inf), np.zeros(grid), np.zeros(grid)
    freedoms, costs = np.ones(grid), np.zeros(grid)
    weights = np.zeros((grid, prior.odds.shape[0], prior.odds.shape[1]))
    deviation, usual = max(noise.deviation, LEAST_NOISE), max(noise.deviation, ORDINARY)
    best = -np.inf
    for g in range(grid):
        for _ in range(2 if g == 0 and grid > 1 else 1):
            variance = deviation * deviation
            taken = taken_by(shared.squares, shared.sizes[g], deviation)
            information, slope = _weighed(linear, taken, variance, known)
            cost = cost_of(linear, taken, variance, known)
            freedom = max(
                equations - noise.decided - np.sum(taken), _LEAST_FREEDOM * equations, 1.0
            )
            found, positive = _solved(information, slope, cost, freedom, prior, finely)
            if not positive:
                break
            steps[g], noises[g] = found.step, deviation * math.sqrt(found.ratio)
            freedoms[g] = max(freedom - found.used, 1.0)
            if grid > 1:
                rest = noise.correction * _rest_of(linear, taken, found.step) / freedoms[g]
                deviation = max(
                    min(max(math.sqrt(rest), _LEAST_PART * usual), _MOST_PART * usual), LEAST_NOISE
                )
        if not positive:
            break
        spread = equations * math.log(2.0 * math.pi * variance) - np.sum(np.log1p(-taken))
        evidences[g] = known.volume + shared.odds[g] + found.gain - 0.5 * (
            found.cost + spread + found.log_determinant
        )  # fmt: skip
        covariances[g], gains[g], costs[g] = found.covariance, found.gain, found.cost
        weights[g] = found.weights
        best = max(best, evidences[g])
        if g and evidences[g] < best - _HOPELESS and shared.odds[g] < shared.odds[g - 1]:
            break
    parts = np.exp(evidences - best)
    total = np.sum(parts)
    if not (best > -np.inf and np.isfinite(total)):
        return LinearFit(
            np.full(size, np.nan), np.full((size, size), np.nan), -np.inf, np.inf, -np.inf,
            deviation, 0.0, 1.0, np.zeros(prior.odds.shape),
        )  # fmt: skip
    parts /= total
    step, of_turns, place = np.zeros(size), np.zeros(prior.odds.shape), int(np.argmax(parts))
    for g in range(grid):
        step += parts[g] * steps[g]
        of_turns += parts[g] * weights[g]
    for g in range(grid):
        steps[g] -= step
    covariance = moments(steps, covariances, np.where(parts > _NO_PART, parts, 0.0))
    return LinearFit(
        step, covariance, best + math.log(total), costs[place], gains[place],
        np.sum(parts * noises),
        math.sqrt(np.sum(parts * shared.sizes**2)), max(np.sum(parts * freedoms), 6.0), of_turns,
    )  # fmt: skip
