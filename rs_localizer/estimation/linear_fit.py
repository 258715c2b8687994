# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The one linear fit: blocks of unknowns with Gaussian priors beside errors that points share.

A frame, linearized at a motion with in-frame rotation, is

    e = M y + T k + S f + noise,      k ~ N(0, t^2 C),  f ~ N(0, s^2),  noise ~ N(0, n^2)

``M`` are the columns of the motion. ``T`` are those of the in-frame rotation that the rows of one
readout resolve: whole cosines and sines, so that ``y`` is the motion without its vibration. ``S``
are those of smooth errors, which a map, a board or a lens is off by: cubics of image and depth or,
of a map that is declared to be off, polynomials of its places, projected. With
``S = U diag(d)^(1/2) V^T`` the products of ``[M T e]`` and ``U`` give all that a fit needs, for
every size ``s`` and noise ``n``:

    M^T W M = (M^T M - (U^T M)^T diag(a) U^T M) / n^2,      a = s^2 d / (n^2 + s^2 d)

The motion is eliminated (Schur's complement), which leaves ``N = T^T W T`` and ``h = T^T W e``.
Each size ``t`` then needs one Cholesky factor:

    log evidence = -log det(1 + t^2 C N) / 2 - freedom / 2 log(1 - h^T (N + C^-1/t^2)^-1 h / rest)

This is Student's form, because the noise comes from the same errors. Sizes are integrated; at each
of smooth errors the noise is the one that the errors leave (restricted likelihood:
Patterson, Thompson 1971).

The prior of ``k`` is an argument (:class:`TurnPrior`): for a vibration that nothing else measures
it is :data:`VIBRATION`. Where readings tell the rotation, :mod:`.known_rotation` makes one of them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.polynomial.legendre import legvander

from rs_localizer.core.arrays import Array, Array1, Array2, Array3, BoolArray, BoolArray1, IntArray
from rs_localizer.core.blocks import write
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
from rs_localizer.core.state import ANGULAR, MOTION_PARAMETERS, MOVE, PARAMETERS, POSE, TURN
from rs_localizer.estimation.prior import RIDGE, PriorTerms, add_prior
from rs_localizer.estimation.projection import Lines
from rs_localizer.estimation.robust import LEAST_NOISE, TINY, back, eliminate, half_of
from rs_localizer.native import entry, inlined, kernel

TURNS: int = 3 * RESOLVED
"""Unknowns of the in-frame turn."""
BLOCKS: dict[str, slice] = {
    "motion": slice(0, PARAMETERS),
    "turn": slice(PARAMETERS, PARAMETERS + TURNS),
}
"""Places of the unknowns, by name."""
MIDDLE = np.zeros((PARAMETERS, TURNS))
"""How the coefficients of the in-frame turn turn the middle row, and how fast."""
_VALUES, _RATES = MIDDLE_VALUES @ COMBINATIONS, MIDDLE_RATES @ COMBINATIONS
MIDDLE[TURN], MIDDLE[ANGULAR] = np.kron(_VALUES, np.eye(3)), np.kron(_RATES, np.eye(3))
# Places of the unknowns and the errors among columns of which the turn's are sorted by axis.
_BY_COMBINATION = np.append(np.arange(PARAMETERS), PARAMETERS + TURNS)
_BY_COMBINATION = np.insert(
    _BY_COMBINATION, PARAMETERS, PARAMETERS + np.arange(TURNS).reshape(3, RESOLVED).T.ravel()
)
IN_FUNCTIONS = np.zeros((PARAMETERS + 3 * FUNCTIONS, PARAMETERS + TURNS))
"""(102,72) motion and coefficients of all functions of the in-frame turn by its combinations."""
IN_FUNCTIONS[:PARAMETERS, :PARAMETERS] = np.eye(PARAMETERS)
IN_FUNCTIONS[PARAMETERS:, PARAMETERS:] = np.kron(COMBINATIONS, np.eye(3))

FACTORS = np.exp(1.15 * np.arange(-1.0, 4.0))
"""Vibration is so many times the ordinary one: two in a decade, up to 0.6 deg. With smaller ones
twists are no better, nor more often inside."""
# Cycles per readout about which a vibration is, its width (logarithm), and the part of others.
_BANDS, _WIDTH, _FLOOR = (1.0, 2.0, 3.0, 5.0), 0.35, 0.1
# Cycles of a vibration about the optical axis, which moves points so little that its size may be
# one that no other axis allows; its part about the others, and the logarithm of the odds against
# it. Without it, 29 instead of 77 % of the twists of a drone that rolls by 0.14 deg at 84 Hz are
# inside.
_ROLLS, _ACROSS, _RARE = (1.3, 3.3), 0.1, 4.0
DEGREE = 3
# Expected size of each degree: printers stretch paper, lenses bend at the rim; the mean square
# over the image of a field of size 1 that has no depth is 1.
_DEGREE_SIZES = (1.0, 1.0, 0.5, 0.25)
# Factor for each power of the depth: a map has larger errors nearby, a lens does not. With 1 a
# phone's lens is taken for its map; with 0.5 fewer regions hold in a room that is bent.
_DEPTH = 0.7
_POWERS = np.array([
    (i, j, degree - i - j)
    for degree in range(DEGREE + 1)
    for i in range(degree + 1)
    for j in range(degree + 1 - i)
])  # fmt: skip
TERMS = len(_POWERS)
_TERM_SIZES = np.array([
    _DEGREE_SIZES[i + j + k] * _DEPTH**k * math.sqrt((2 * i + 1) * (2 * j + 1) * (2 * k + 1))
    for i, j, k in _POWERS.tolist()
]) / math.sqrt(sum((d + 1) * size**2 for d, size in enumerate(_DEGREE_SIZES)))  # fmt: skip
# Paper bends in finer waves than lenses: to a cubic a curled edge looks like fast motion.
_BENT_SIZES = (*_DEGREE_SIZES, 0.125)
# Combinations of functions that move no point by this part of the size are left out.
_LEAST_BEND = 0.003
_LEAST_EXTENT = 1e-6  # m; points nearer together than this are one place, and nothing bends
# Combinations of columns with less than this part of the largest square are left out.
_LEAST_SQUARE = 1e-4
ORDINARY = 0.03
"""Size (px) of the smooth error of an ordinary map and lens: no calibration is better."""
# Errors of mount and focal length, over others: 0.5 mm at 2.5 m, 0.01 deg, for 450 px.
_GROSS = 3.0
# Sizes about the known one, in deviations of its logarithm: surveyed tags before a calibrated lens
# have 0.2 px (two of them), and thirteen printed boards bend 0.3 to 9 times as much as declared.
# A lens that misses a third of its distortion is off by six deviations.
_SIZES = np.linspace(-2.5, 5.5, 11)
_ODDS = -0.5 * _SIZES**2 - math.log(np.exp(-0.5 * _SIZES**2).sum())
# Deviation of the logarithm of the size of vibration: a decade.
_DECADE = math.log(10.0)
# Errors that are left at least: the linear model holds no farther.
_LEAST_LEFT = 1e-4
# Noise beside a smooth error is so many times that of the fit without one.
_LEAST_PART, _MOST_PART = 0.16, 1.3
# Least share of the equations that columns leave to measure the noise with.
_LEAST_FREEDOM = 0.1
# Smooth errors with less than this part of the noise's variance in any column are one size.
_UNSEEN = 0.05
# Logarithm of the odds below which larger sizes are not looked at, and a size has no part.
_HOPELESS, _NO_PART = 7.0, 1e-3
# One frame tells no more of a vibration than this logarithm of odds: none is as Gaussian as that.
_MOST_TOLD = 5.0
# Points whose columns are multiplied at a time.
_PART = 64
_ONE = np.ones(1)


class TurnPrior(NamedTuple):
    """Prior of the in-frame rotation: some Gaussians about zero, by spectrum and rising size."""

    informations: Array3  # (k,54,54) of the coefficients, of each spectrum
    scales: Array1  # (s,) factors of them, of each size
    volumes: Array1  # (ks,) half the logarithms of the determinants of the products
    odds: Array1  # (ks,) logarithms of the probabilities; minus infinity: not looked at

    @classmethod
    def of(cls, informations: Array, odds: Array, scales: Array = _ONE) -> TurnPrior:
        """Return the prior with these logarithms of the odds, up to a constant."""
        volumes = 0.5 * np.add.outer(np.linalg.slogdet(informations)[1], TURNS * np.log(scales))
        return cls(informations, scales, volumes.ravel(), odds - np.logaddexp.reduce(odds))


def _vibration() -> TurnPrior:
    """Return each size of an ordinary vibration, then of one about each of some frequencies."""
    alike, roll = np.ones(3), np.array([_ACROSS, _ACROSS, 1.0])
    shapes = []
    for cycles, axes in (*((each, alike) for each in _BANDS), *((each, roll) for each in _ROLLS)):
        sizes = np.exp(-0.5 * (np.log(CYCLES / cycles) / _WIDTH) ** 2) + _FLOOR
        sizes *= math.sqrt(float((TYPICAL_SIZES**2).sum() / (sizes**2).sum()))
        inverse = np.linalg.inv(IN_COMBINATIONS * np.repeat(sizes, 2) ** 2 @ IN_COMBINATIONS.T)
        shapes.append(np.kron(inverse, np.diag(axes**-2.0)))
    shapes.insert(0, np.eye(TURNS))  # the likeliest first, so that others are soon out of question
    odds = np.tile(-0.5 * (np.log(FACTORS) / _DECADE) ** 2, (len(shapes), 1))
    odds[-len(_ROLLS) :] -= _RARE
    return TurnPrior.of(np.array(shapes), odds.ravel(), FACTORS**-2.0)


VIBRATION = _vibration()
"""Prior of the in-frame turn that nothing but the points measures: combinations of an ordinary
vibration are independent, and of size 1; vibration of the same mean square about one frequency is
beside it. A motor is seen below the noise only by its frequency: over a track, the spectrum about
that gains 0.15 of evidence a frame, where the ordinary one loses 0.01 (0.017 deg at 140 Hz, 0.7
px). If frames show the vibration, these spectra halve the errors of twists."""
NO_TURN = TurnPrior(np.zeros((0, TURNS, TURNS)), _ONE, np.zeros(0), np.zeros(0))
"""Prior for products that have no columns of an in-frame turn."""


class Shared(NamedTuple):
    """Columns of errors that the chosen points share, and what is known of their size."""

    # (2,m,q) orthonormal combinations of the columns, of u and of v; (2,m,q/2): first those of u
    # alone, then those of v alone
    rows: Array3
    squares: Array1  # (q,) of the columns' lengths, for a size of 1 px
    sizes: Array1  # (s,) px, root mean squares that are weighed
    odds: Array1  # (s,) logarithms of their probabilities

    def at(self, size: float) -> Shared:
        """Return the shared errors with one size (px), which is known."""
        return self._replace(sizes=np.array([size]), odds=np.zeros(1))


@entry
def smooth_columns(by_motion: Array3, rays: Array2, bend: Array2) -> Array:
    """Return shifts (n,2,q) px of points by each coefficient of a smooth error of 1 px.

    Args:
        by_motion: (n,2,18) derivatives; a point that moves is a camera that moves back.
        rays: (n,2).
        bend: (n,b) functions of the places in the map (:func:`bend_of`); (n,0): of image and depth.
    """
    count = len(rays)
    if bend.shape[1] > 0:
        bent = np.empty((count, 2, 3 * bend.shape[1]))
        for i in range(count):
            for k in range(bend.shape[1]):
                bent[i, :, 3 * k : 3 * k + 3] = -bend[i, k] * by_motion[i, :, MOVE]
        return bent
    columns, terms = np.zeros((count, 2, 2 * TERMS)), _terms_of(by_motion, rays)
    for i in range(count):
        write(columns[i, 0, :TERMS], terms[i])
        write(columns[i, 1, TERMS:], terms[i])
    return columns


@kernel
def _terms_of(by_motion: Array, rays: Array) -> Array:
    """Return functions (n,t) of places in image and depth, along one side of the image."""
    places, powers = _places_of(by_motion, rays), np.ones((3, DEGREE + 1))
    terms = np.empty((len(rays), TERMS))
    for i in range(len(rays)):
        for axis in range(3):
            power, x = powers[axis], places[i, axis]
            power[1] = x
            for k in range(2, DEGREE + 1):  # Legendre
                power[k] = ((2 * k - 1) * x * power[k - 1] - (k - 1) * power[k - 2]) / k
        for place in range(TERMS):
            value = _TERM_SIZES[place]
            for axis in range(3):
                value *= powers[axis, _POWERS[place, axis]]
            terms[i, place] = value
    return terms


@kernel
def _places_of(by_motion: Array, rays: Array) -> Array:
    """Return places (n,3) in image and depth, at most 1; depths relative to the scene."""
    places, low, high = np.empty((len(rays), 3)), np.full(5, np.inf), np.full(5, -np.inf)
    each = np.empty(5)
    for i in range(len(rays)):
        x, y = rays[i]
        turn = move = 0.0
        for side in range(2):
            for axis in range(3):
                turn += by_motion[i, side, TURN.start + axis] ** 2
                move += by_motion[i, side, MOVE.start + axis] ** 2
        # The displacement by a rotation does not depend on the depth.
        flat = 2.0 * (x * y) ** 2 + (1.0 + x * x) ** 2 + (1.0 + y * y) ** 2 + x * x + y * y
        depth = math.sqrt(turn / flat * (2.0 + x * x + y * y) / max(move, 1e-300))
        places[i, 0], places[i, 1], places[i, 2] = x, y, depth
        each[0], each[1], each[2], each[3], each[4] = x, y, depth, x * depth, y * depth
        low, high = np.minimum(low, each), np.maximum(high, each)
    extents = 0.5 * (high - low)
    extents[2] = max(extents[2], extents[3], extents[4])
    for i in range(len(rays)):
        for axis in range(3):
            middle = 0.5 * (low[axis] + high[axis])
            places[i, axis] = (places[i, axis] - middle) / max(extents[axis], 1e-12)
    return places


def bend_of(points: Array, inliers: BoolArray, size: float) -> Array:
    """Return functions (n,b) of the points' places with root mean square ``size`` (m)."""
    sizes = _BENT_SIZES
    chosen = points[inliers]
    low, high = chosen.min(axis=0), chosen.max(axis=0)
    places = (points - 0.5 * (low + high)) / max(0.5 * float(np.max(high - low)), _LEAST_EXTENT)
    x, y, z = (legvander(places[:, k], len(sizes) - 1) for k in range(3))
    bend = np.column_stack([
        of_degree * math.sqrt((2 * i + 1) * (2 * j + 1) * (2 * (degree - i - j) + 1))
        * x[:, i] * y[:, j] * z[:, degree - i - j]
        for degree, of_degree in enumerate(sizes)
        for i in range(degree + 1)
        for j in range(degree + 1 - i)
    ])  # fmt: skip
    # On a plane they repeat each other.
    values, axes = np.linalg.eigh(bend[inliers].T @ bend[inliers])
    total = np.sum(values)
    size *= math.sqrt(np.count_nonzero(inliers) / total)
    combined: Array = size * bend @ axes[:, values > _LEAST_BEND**2 * total]
    return combined


@entry
def smooth_error(lines: Lines, chosen: BoolArray1, bend: Array2, size: float) -> Shared:
    """Return the smooth error at the chosen points (n,), as orthogonal columns.

    Args:
        bend: (n,b), or (n,0): see :func:`smooth_columns`.
        size: px; its logarithm is known with a deviation of 1.
    """
    by_motion, rays = lines.by_motion[chosen], lines.image[chosen]
    of_image = bend.shape[1] == 0  # u and v have the same functions
    if of_image:
        flat = _terms_of(by_motion, rays)
    else:
        flat = smooth_columns(by_motion, rays, bend[chosen]).reshape(2 * len(rays), -1)
    values, axes = np.linalg.eigh(flat.T @ flat)
    kept = np.flatnonzero(values > _LEAST_SQUARE * max(values[-1], 1e-300))
    squares = values[kept]
    combined = flat @ np.ascontiguousarray(axes[:, kept]) / np.sqrt(squares)
    rows = np.empty((2, len(rays), len(squares)))
    for side in range(2):
        rows[side] = combined if of_image else combined[side::2]
    if of_image:
        squares = np.append(squares, squares)
    return Shared(rows, squares, size * np.exp(_SIZES), _ODDS.copy())


def smooth_columns_of(by_motion: Array, rays: Array, bend: Array, lens: IntArray | None) -> Array:
    """Return shifts as :func:`smooth_columns`; each camera of a rig has its own coefficients.

    What is wrong of the mount, the lens or the clock of one camera moves its points smoothly, and
    no points of the others.

    Args:
        lens: (n,) camera of each point; None: one camera.
    """
    if lens is None or bend.shape[1]:  # of a map, for all cameras
        return smooth_columns(by_motion, rays, bend)
    parts = []
    for own in (lens == place for place in range(lens.max() + 1)):
        gross = np.concatenate([by_motion[:, :, POSE], rays[:, :, None]], axis=2)
        gross[~own] = 0.0
        gross *= _GROSS / np.sqrt(np.square(gross).sum(axis=(0, 1)) / max(own.sum(), 1) + TINY)
        parts += [np.zeros((len(lens), 2, 2 * TERMS)), gross]
        parts[-2][own] = smooth_columns(by_motion[own], rays[own], bend[own])
    return np.concatenate(parts, axis=2)


def smooth_errors(
    lines: Lines, chosen: BoolArray, bend: Array, size: float, lens: IntArray | None
) -> Shared:
    """Return the smooth error as :func:`smooth_error`, of each camera of a rig its own."""
    if lens is None or bend.shape[1]:
        return smooth_error(lines, chosen, bend, size)
    some, lens = lines.by_motion[chosen], lens[chosen]
    columns = smooth_columns_of(some, lines.image[chosen], bend[chosen], lens)
    if not np.isfinite(columns).all():  # of an absurd motion
        columns = columns[:, :, :0]
    rows, squares = [], []
    for flat in np.split(columns.reshape(2 * len(lens), -1), lens.max() + 1, axis=1):
        values, axes = np.linalg.eigh(flat.T @ flat)
        kept = values > _LEAST_SQUARE * max(values.max(initial=0.0), TINY)
        rows.append(flat @ axes[:, kept] / np.sqrt(values[kept]))
        squares.append(values[kept])
    by_side = np.concatenate(rows, axis=1).reshape(len(lens), 2, -1).swapaxes(0, 1).copy()
    return Shared(by_side, np.concatenate(squares), size * np.exp(_SIZES), _ODDS.copy())


def nothing_shared(count: int) -> Shared:
    """Return the shared errors of so many points if there are none."""
    return Shared(np.zeros((2, count, 1)), np.zeros(1), np.zeros(1), np.zeros(1))


class Linear(NamedTuple):
    """Products of the columns of a frame's chosen points; the last column are their errors."""

    every: Array2  # (p+1,p+1) of unknowns and errors
    beside: Array2  # (q,p+1) of what points share and these


class Noise(NamedTuple):
    """Noise by a fit without anything that points share."""

    deviation: float  # px
    correction: float  # of the mean square, because the gate cuts errors off
    decided: float  # parameters that the points decide
    expected: float = math.inf  # px, of its half-normal prior; infinite: it may be any


class KnownMotion(NamedTuple):
    """The prior of the motion, or of all unknowns, where a frame is linearized."""

    form: Array2  # (19,19), or (p+1,p+1): information, slope and cost, as of `Linear`
    volume: float  # half the logarithm of the determinant of what it knows


class LinearFit(NamedTuple):
    """A Gaussian of all unknowns, integrated over the sizes of both."""

    step: Array1  # (p,) from where the products are; the turn is whole
    covariance: Array2  # (p,p)
    evidence: float  # logarithm; minus infinity: nothing was found
    cost: float  # that is left at the most probable size, noise variances
    gain: float  # the part of it that the in-frame turn explains
    noise: float  # px
    size: float  # px, root mean square of what points share
    freedom: float
    weights: Array1  # (k,) of the Gaussians that are the in-frame turn's prior


@entry
def linear_of(lines: Lines, chosen: BoolArray1, turns: bool, shared: Shared) -> Linear:
    """Return the products of the chosen points at a motion with in-frame rotation.

    Args:
        turns: with the block of the in-frame turn.
        shared: what these points share.
    """
    size, picked = PARAMETERS + (TURNS if turns else 0), np.flatnonzero(chosen)
    every, beside = np.zeros((size + 1, size + 1)), np.zeros((len(shared.squares), size + 1))
    columns = np.empty((2 * min(_PART, len(picked)), size + 1))
    values, rates = np.zeros((_PART, FUNCTIONS)), np.empty(FUNCTIONS)
    for first in range(0, len(picked), _PART):  # whose columns stay in the processor's cache
        some = picked[first : first + _PART]
        if turns:
            for i in range(len(some)):
                shake_basis(lines.tau[some[i]], values[i], rates)
        each, part, last = values @ COMBINATIONS, columns[: 2 * len(some)], first + len(some)
        for i in range(len(some)):
            for side in range(2):  # all rows of u, then those of v
                motion = lines.by_motion[some[i], side]
                row, by_turn = part[len(some) * side + i], lines.by_turn[some[i], side]
                row[:PARAMETERS], row[size] = motion, lines.errors[some[i], side]
                for axis in range(3 if turns else 0):  # behind each other, as vectors want it
                    value, rate, swing = motion[axis], motion[6 + axis], by_turn[axis]
                    place = row[PARAMETERS + RESOLVED * axis :]
                    for j in range(RESOLVED):
                        place[j] = each[i, j] * swing + _VALUES[j] * value + _RATES[j] * rate
        every += part.T @ part
        for side in range(2):
            rows, own = shared.rows[side], part[len(some) * side : len(some) * (side + 1)]
            place = side * (len(beside) - rows.shape[1])
            beside[place : place + rows.shape[1]] += rows[first:last].T @ own
    if turns:
        order = _BY_COMBINATION
        every, beside = every[order][:, order], beside[:, order]
    return Linear(every.copy(), beside.copy())


def moved(linear: Linear, step: Array, by_motion: Array | None = None) -> Linear:
    """Return the system at a point that lies so far (p,) along the tangent.

    Args:
        by_motion: (54,18) turn that goes with the motion, beside which the unknown one is; None:
            there is none.
    """
    every, beside = linear.every.copy(), linear.beside.copy()
    for columns in (every, every.T, beside):
        columns[:, -1] += columns[:, :-1] @ step
        if by_motion is not None:
            columns[:, :PARAMETERS] += columns[:, PARAMETERS:-1] @ by_motion
    return Linear(every, beside)


def of_coupled(fit: LinearFit, by_motion: Array) -> LinearFit:
    """Return the fit of the whole turn, by one of the turn beside what goes with the motion."""
    step, covariance = fit.step.copy(), fit.covariance.copy()
    step[PARAMETERS:] += by_motion @ step[:PARAMETERS]
    covariance[PARAMETERS:] += by_motion @ covariance[:PARAMETERS]
    covariance[:, PARAMETERS:] += covariance[:, :PARAMETERS] @ by_motion.T
    return fit._replace(step=step, covariance=covariance)


@entry
def under(fit: LinearFit, before: KnownMotion, after: KnownMotion) -> LinearFit:
    """Return the fit under another prior of the motion, both at the products' state (Kalman 1960).

    The noise is unknown, so this is Student's form, too.
    """
    m, form = PARAMETERS, after.form - before.form
    more, pull = form[:m, :m].copy(), form[:m, -1].copy()
    mean, across = fit.step[:m], fit.covariance[:, :m].copy()
    whole = np.eye(m) + more @ across[:m]
    gain = np.linalg.solve(whole.T.copy(), across.T.copy()).T.copy()
    pulled = np.linalg.solve(whole, pull + more @ mean)
    step = fit.step - across @ pulled
    cost = form[-1, -1] + np.sum(pull * step[:m]) + np.sum(mean * pulled)
    evidence = after.volume - before.volume - 0.5 * np.linalg.slogdet(whole)[1]
    evidence -= 0.5 * fit.freedom * math.log(max(1.0 + cost / fit.freedom, _LEAST_LEFT))
    covariance = fit.covariance - gain @ more @ across.T.copy()
    covariance[:, :m], covariance[:m] = gain, gain.T  # not as a difference of large ones
    return LinearFit(
        step, covariance, fit.evidence + evidence, fit.cost, fit.gain, fit.noise, fit.size,
        fit.freedom, fit.weights,
    )  # fmt: skip


@entry
def known_at(terms: PriorTerms, state: Array1) -> KnownMotion:
    """Return the prior of a motion at a state (24,)."""
    form, slope, volume = np.zeros((PARAMETERS + 1, PARAMETERS + 1)), np.zeros(PARAMETERS), 0.0
    form[-1, -1] = add_prior(terms, state, 1.0, form, slope)
    form[:-1, -1], form[-1, :-1] = slope, slope
    for k in range(PARAMETERS):
        if terms.informations[0, k, k] > 0.0:
            volume += 0.5 * math.log(terms.informations[0, k, k])
    return KnownMotion(form, volume)


@kernel
def taken_by(squares: Array1, size: float, noise: float) -> Array:
    """Return the share (q,) of each column that shared errors explain."""
    own = size * size * squares
    return own / (noise * noise + own)


@kernel
def cost_of(linear: Linear, taken: Array1, variance: float, known: KnownMotion) -> float:
    """Return the errors beside what points share, in noise variances, and the prior's cost."""
    left = linear.every[-1, -1] - np.sum(taken * linear.beside[:, -1] ** 2)
    cost: float = left / variance + known.form[-1, -1]
    return cost


@kernel
def _without_motion(
    linear: Linear, taken: Array, variance: float, known: KnownMotion
) -> tuple[Array, Array, bool]:
    """Take the motion out of the equations (p+1,p+1) at one size of what points share.

    Returns:
        equations, half of the inverse of the motion's (18,18), whether they are positive definite.
    """
    scaled, size, held = linear.beside.copy(), len(linear.every) - 1, len(known.form) - 1
    for k in range(len(taken)):
        scaled[k] *= math.sqrt(taken[k])
    whole = (linear.every - scaled.T @ scaled) / variance  # half the work of two matrices
    whole[:held, :held] += known.form[:held, :held]
    whole[:held, size] += known.form[:held, held]
    whole[size, size] += known.form[held, held]
    diagonal = np.diag(whole).copy()
    positive = eliminate(whole, PARAMETERS)
    for k in range(PARAMETERS, size):  # columns that the motion mimics wholly explain nothing
        whole[k, k] += RIDGE * diagonal[k]
    if size > PARAMETERS:
        whole[size, size] = max(whole[size, size], TINY)
    return whole, half_of(whole[:PARAMETERS, :PARAMETERS]), positive


@kernel
def _at_size(
    linear: Linear, shared: Shared, place: int, deviation: float, known: KnownMotion, noise: Noise,
    prior: TurnPrior, finely: bool,
) -> tuple[LinearFit, float]:  # fmt: skip
    """Return the fit at one size of what points share and one noise (px), and the noise it leaves.

    The motion is taken out, then the in-frame turn of each size.
    """
    taken, variance = taken_by(shared.squares, shared.sizes[place], deviation), deviation**2
    size, equations, m = len(linear.every) - 1, 2 * shared.rows.shape[1], PARAMETERS
    whole, half, positive = _without_motion(linear, taken, variance, known)
    step, covariance = np.zeros(size), np.zeros((size, size))
    step[:m], covariance[:m, :m] = -(half.T @ whole[:m, size].copy()), half.T @ half
    spread = equations * math.log(2.0 * math.pi * variance) - np.sum(np.log1p(-taken))
    for k in range(m):
        spread += 2.0 * math.log(whole[k, k])
    freedom = max(equations - noise.decided - np.sum(taken), _LEAST_FREEDOM * equations, 1.0)
    cost, gain, ratio, used = whole[size, size], 0.0, 1.0, 0.0
    weights = np.zeros(prior.odds.shape)
    if size > m:
        scale = 0.5 * variance / noise.expected**2
        turn, own, gain, ratio, weights = _over_turns(whole[m:, m:], freedom, prior, scale, finely)
        pulled = -(half.T @ whole[:m, m:size].copy())
        step[:m] += pulled @ turn
        across = pulled @ own
        covariance[:m, :m] = ratio * covariance[:m, :m] + across @ pulled.T
        covariance[:m, m:], covariance[m:, :m] = across, across.T
        step[m:], covariance[m:, m:] = turn, own
        for i in range(m, size):
            for j in range(i, size):
                used += whole[i, j] * own[i - m, j - m] * (1.0 if i == j else 2.0) / ratio
        cost = freedom * (1.0 + math.log(whole[size, size] / freedom))
    left = max(freedom - used, 1.0)
    evidence = known.volume + shared.odds[place] + gain - 0.5 * (cost + spread)
    errors = np.append(step, 1.0)
    seen = linear.beside @ errors
    rest = np.sum(errors * (linear.every @ errors)) - np.sum(
        (1.0 - (1.0 - taken) ** 2) * seen * seen
    )
    return LinearFit(
        step, covariance, evidence if positive else -np.inf, cost, gain,
        deviation * math.sqrt(ratio), shared.sizes[place], left, weights,
    ), math.sqrt(noise.correction * max(rest, 0.0) / left)  # fmt: skip


@kernel
def _over_turns(
    equations: Array, freedom: float, prior: TurnPrior, scale: float, finely: bool
) -> tuple[Array, Array, float, float, Array]:
    """Integrate over the prior of the in-frame turn beside the motion.

    Args:
        equations: (55,55) of the turn, with the motion taken out; the last ones are the errors'.
            Or (55,55+c), with columns (54,c) of its combinations behind them.
        scale: their noise's variance, over twice that of the prior of noise.

    Returns:
        mean (54,) and covariance (54,54), or those of the combinations, which take a fifth of the
        time; logarithm of the evidence, against none; how much of the noise's variance is left;
        weights (k,) of the prior's parts.
    """
    (rows, columns), count = equations.shape, len(prior.odds)
    size, combines = rows - 1, columns > rows
    told = columns - rows if combines else size
    # Of combinations each part leaves its moments, and its factor stays in the processor's cache.
    wholes, means = np.empty((1 if combines else count, size, columns)), np.zeros((count, told))
    moments = np.empty((count if combines else 0, told, told))
    weights, left = np.full(count, -np.inf), np.ones(count)
    rest, best, covariance = equations[size, size], -np.inf, np.zeros((told, told))
    gain = fall = 0.0
    if np.all(np.isfinite(equations)):
        for k in range(count):
            spectrum, place = k // len(prior.scales), k % len(prior.scales)
            if place == 0:
                gain = fall = 0.0  # another spectrum, of which the smallest size is next to none
            # Evidence that falls from one size to the next falls no less to the one after it.
            if fall < 0.0 and prior.odds[k] + gain + fall < best - _HOPELESS:
                continue
            if prior.odds[k] == -np.inf:
                continue
            whole = wholes[k % len(wholes)]
            for i in range(size):
                row, own = whole[i, i:], equations[i, i:]
                more, factor = prior.informations[spectrum, i, i:], prior.scales[place]
                for j in range(len(more)):
                    row[j] = own[j] + factor * more[j]
                write(whole[i, size:], equations[i, size:])
            eliminate(whole, size)
            before, gain = gain, prior.volumes[k]
            for i in range(size):
                gain -= math.log(whole[i, i])
            left[k] = max(1.0 - np.sum(whole[:, size] ** 2) / rest, _LEAST_LEFT)
            gain += scale * rest / freedom * (1.0 - left[k]) - 0.5 * freedom * math.log(left[k])
            weights[k], fall = prior.odds[k] + gain, gain - before
            best = max(best, weights[k])
            if combines:
                half = whole[:, size:].copy()
                both = half.T @ half
                means[k], moments[k] = both[0, 1:], both[1:, 1:]
            else:
                back(whole, means[k])
    if not best > -np.inf:
        return np.zeros(told), covariance, -np.inf, 1.0, weights
    weights = np.exp(weights - best)
    total = np.sum(weights)
    weights /= total
    left *= rest / freedom
    mean, least = -(weights @ means), _NO_PART if finely else np.max(weights)
    share = 1.0 / np.sum(np.where(weights >= least, weights, 0.0))
    for k in range(count):
        means[k] = math.sqrt(weights[k]) * (means[k] + mean)
        if weights[k] >= least:
            if not combines:
                half = half_of(wholes[k])
            spread = moments[k] if combines else half.T @ half
            covariance += share * weights[k] * left[k] * spread
    covariance += means.T @ means
    return mean, covariance, best + math.log(total), np.sum(weights * left), weights


@inlined
def _near(noise: float, usual: float) -> float:
    """Return the noise (px) beside a smooth error, near that of a fit without one."""
    return max(min(max(noise, _LEAST_PART * usual), _MOST_PART * usual), LEAST_NOISE)


@entry
def fit(
    linear: Linear, shared: Shared, known: KnownMotion, noise: Noise, prior: TurnPrior,
    finely: bool,
) -> LinearFit:  # fmt: skip
    """Fit all unknowns, integrated over the size of what points share and over in-frame turns.

    Args:
        prior: of the in-frame turn; ``NO_TURN`` where the products have no such block.
        finely: with the covariance of all in-frame turns, and not of the most probable size alone,
            which takes a third of the time.
    """
    grid, usual = len(shared.sizes), max(noise.deviation, ORDINARY)
    deviation, best, found = max(noise.deviation, LEAST_NOISE), -np.inf, []
    first, odds, largest = 0, shared.odds.copy(), np.max(shared.squares)
    while first + 1 < grid and shared.sizes[first + 1] ** 2 * largest < _UNSEEN * deviation**2:
        first += 1  # what is smaller is no other fit
        odds[first] = np.logaddexp(odds[first - 1], odds[first])
    shared = Shared(shared.rows, shared.squares, shared.sizes, odds)
    for g in range(first, grid):
        one, rest = _at_size(linear, shared, g, deviation, known, noise, prior, finely)
        if g == first and grid > 1:  # the noise is what this size leaves
            deviation = _near(rest, usual)
            one, rest = _at_size(linear, shared, g, deviation, known, noise, prior, finely)
        if not one.evidence > -np.inf:
            break
        found.append(one)
        deviation, best = _near(rest, usual), max(best, one.evidence)
        if g > first and one.evidence < best - _HOPELESS and odds[g] < odds[g - 1]:
            break
    size = len(linear.every) - 1
    step, covariance, weights = np.zeros(size), np.zeros((size, size)), np.zeros(len(prior.odds))
    if not np.isfinite(best):
        return LinearFit(step, covariance, -np.inf, np.inf, -np.inf, deviation, 0.0, 1.0, weights)
    total = noise_found = squares = freedom = cost = gain = 0.0
    for one in found:
        part = math.exp(one.evidence - best)
        total += part
        step += part * one.step
    step /= total
    for one in found:
        part = math.exp(one.evidence - best) / total
        if part > _NO_PART:
            away = one.step - step
            covariance += part * (one.covariance + np.outer(away, away))
        if one.evidence == best:
            cost, gain = one.cost, one.gain
        weights += part * one.weights
        noise_found += part * one.noise
        squares += part * one.size**2
        freedom += part * one.freedom
    return LinearFit(
        step, covariance, best + math.log(total), cost, gain, noise_found, math.sqrt(squares),
        max(freedom, 6.0), weights,
    )  # fmt: skip


@entry
def hidden(
    lines: Lines, chosen: BoolArray1, shared: Shared, known: KnownMotion, deviation: float,
    freedom: float, expected: float, prior: TurnPrior,
) -> tuple[float, Array, Array]:  # fmt: skip
    """Return evidence and effect of vibration at the best motion without it.

    Args:
        shared: of one size, which is that without vibration.
        deviation, freedom: of the noise (px), likewise.
        expected: px, see :class:`Noise`.

    Returns:
        logarithm of its evidence, against none; (12,12) second moments of the motion by it;
        logarithms (k,) of the evidence of each size.
    """
    m, size, place = PARAMETERS, PARAMETERS + TURNS, MOTION_PARAMETERS
    deviation = max(deviation, LEAST_NOISE)
    taken, variance = taken_by(shared.squares, shared.sizes[0], deviation), deviation**2
    linear = linear_of(lines, chosen, True, shared)
    whole, half, positive = _without_motion(linear, taken, variance, known)
    # What is told of the turn is how it moves pose and velocities, beside the motion with none.
    equations = np.zeros((TURNS + 1, TURNS + 1 + place))
    equations[:, : TURNS + 1] = whole[m:, m:]
    equations[:TURNS, TURNS + 1 :] = (
        MIDDLE[:place] - half[:, :place].T.copy() @ whole[:m, m:size].copy()
    ).T
    freedom = max(freedom, _LEAST_FREEDOM * 2.0 * shared.rows.shape[1], 1.0)
    move, moments, gain, _, weights = _over_turns(
        equations, freedom, prior, 0.5 * variance / expected**2, True
    )
    if not (positive and gain > -np.inf):
        return -np.inf, np.zeros((place, place)), np.zeros(0)
    each = np.log(np.maximum(weights, TINY)) - prior.odds + gain
    vibrations = np.minimum(np.maximum(each, -_MOST_TOLD), _MOST_TOLD)
    return gain, moments + np.outer(move, move), vibrations
