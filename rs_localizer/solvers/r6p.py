# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""R6P: all solutions of the double-linearized rolling-shutter model for six points.

    lambda x = (I + r [w]x) (I + [v]x) X + C + r t

The polynomial solver that the linear ones are measured against, in NumPy: the system of Albl,
Kukelova, Pajdla, "R6P - Rolling shutter absolute camera pose", CVPR 2015, solved by a smaller
elimination:

1. The translations are linear; an orthogonal transformation of the twelve equations removes
   them. Six remain, bilinear in v and w: ``A(v) [w; 1] = 0``, A 6x4 with linear entries.
2. All fifteen 4x4 minors of A vanish at up to 20 v: quartics with 35 monomials. They express
   those of degree four by the 20 others. Multiplication by v_y thereby becomes a 20x20 matrix,
   whose eigenvectors are these 20 monomials at the solutions (Cox, Little, O'Shea, "Using
   Algebraic Geometry", 2005, sec. 2.4). Only real eigenvalues in range are followed up.
3. v follows from the eigenvector, w from the null vector of A(v), and Newton steps on the six
   equations polish both; then C and t.

Six points in the frame of the initial rotation, any unit of length, |v| below a bound (|v| is the
tangent of the angle to the initial rotation); up to 20 solutions. The multiplier is v_y; v_x would
do as well, while v_z, the turn about the optical axis, costs a digit of the eigenvalues.
"""

import itertools
from typing import Any, NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, IntArray

SAMPLE_SIZE, SOLUTIONS = 6, 20
# Largest |v|, 45 degrees from the initial rotation. Below it the solver finds everything that the
# authors' code finds. Solutions beyond it were never within 5 degrees of the truth (none of 248
# samples without other solutions, from initial rotations up to 25 degrees off, at up to 30 degrees
# per readout and 1 px).
BOUND = 1.0

_BLOCK = 256  # samples at a time: 10 MB
_NEAR = 2.0  # the bound of what Newton's steps polish, over that of solutions
_NEWTON_STEPS = 2
_CONVERGED = 1e-7  # the longest last step; another one would be about its square
_AXES = np.eye(3)

# Exponents of v in the monomials, those up to each degree first: 1 x y z xx ...
_MONOMIALS = sorted(
    (m for m in itertools.product(range(5), repeat=3) if sum(m) <= 4),
    key=lambda m: (sum(m), [-power for power in m]),
)
_COUNT = (1, 4, 10, 20, 35)  # monomials up to that degree


def _place(*factors: tuple[int, ...]) -> int:
    return _MONOMIALS.index(tuple(map(sum, zip(*factors, strict=True))))


def _products(degree: int) -> Array:
    """Return the matrix (4 m, k) of products of linear polynomials and m monomials of a degree."""
    factors = itertools.product(_MONOMIALS[:4], _MONOMIALS[: _COUNT[degree]])
    return np.eye(_COUNT[degree + 1])[[_place(*pair) for pair in factors]]


def _minors(size: int) -> tuple[IntArray, IntArray]:
    """Return the rows (m, size) of all minors, and the places of the minors without each of them.

    Minors are numbered by their rows, and expanded along their last column (Laplace).
    """
    smaller = list(itertools.combinations(range(6), size - 1))
    rows = list(itertools.combinations(range(6), size))
    others = [[smaller.index((*of[:i], *of[i + 1 :])) for i in range(size)] for of in rows]
    return np.array(rows), np.array(others)


_EXPANSIONS = [(*_minors(size), _products(size - 1)) for size in (2, 3, 4)]
_SIGNS = np.array([1.0, -1.0, 1.0, -1.0])[:, None]
_TIMES_Y = np.array([_place(m, (0, 1, 0)) for m in _MONOMIALS[:SOLUTIONS]])


class _Solutions(NamedTuple):
    """Solutions of some samples, those of a sample in the order of their |v|."""

    sample: IntArray  # (c,)
    number: IntArray  # (c,) in the sample, from 0
    v: Array  # (c,3)
    w: Array  # (c,3)
    c: Array  # (c,3)
    t: Array  # (c,3)


def find_solutions(points: Array, rays: Array, tau: Array, bound: float = BOUND) -> _Solutions:
    """Return all solutions with |v| below ``bound``.

    Args:
        points: (h,6,3) in the frame of the initial rotation.
        rays: (h,6,2)
        tau: (h,6)
    """
    with np.errstate(all="ignore"):
        a = _eliminated(points, rays, tau)
        size = np.abs(a).max((1, 2, 3))
        sample = np.flatnonzero(np.isfinite(size) & (size > 0.0))
        points, rays, tau = points[sample], rays[sample], tau[sample]
        a = a[sample] / size[sample, None, None, None]
        found, v = _candidates(a, bound)
        v, w, change = _polished(a[found], v)
        length = np.linalg.norm(v, axis=1)
        kept = (change < _CONVERGED) & (length < bound)
        kept = np.flatnonzero(kept)[np.lexsort((length[kept], found[kept]))]
        found, v, w = found[kept], v[kept], w[kept]
        c, t = _translations(points[found], rays[found], tau[found], v, w)
        number = np.arange(len(found)) - np.searchsorted(found, found)
    return _Solutions(sample[found], number, v, w, c, t)


def _seen(vectors: Array, rays: Array) -> Array:
    """Return the equations (...,12) of vectors (...,6,3) that should lie along rays (...,6,2)."""
    equations = vectors[..., :2] - rays * vectors[..., 2:]
    return equations.reshape(*equations.shape[:-2], 12)


def _of_translations(rays: Array, tau: Array) -> Array:
    """Return the coefficients (h,12,6) of C and t in the twelve equations of each sample."""
    moved = np.broadcast_to(_AXES[:, None, None], (3, len(rays), 6, 3))
    columns = [_seen(axis * r, rays) for r in (1.0, tau[..., None]) for axis in moved]
    return np.stack(columns, axis=-1)


def _eliminated(points: Array, rays: Array, tau: Array) -> Array:
    """Return the coefficients (h,6,4,4) of A(v): rows; w and a constant; 1 and v."""
    r = tau[..., None]
    turned = [points, *(np.cross(axis, points) for axis in _AXES)]  # by 1 and v
    turns = [[r * np.cross(axis, one) for one in turned] for axis in _AXES]
    whole = np.array([[_seen(one, rays) for one in column] for column in (*turns, turned)])
    free = np.linalg.qr(_of_translations(rays, tau), mode="complete")[0][:, :, 6:]
    coefficients: Array = np.einsum("her,jkhe->hrjk", free, whole, optimize=True)
    return coefficients


def _candidates(a: Array, bound: float) -> tuple[IntArray, Array]:
    """Return the places of samples and v (c,3) where A(v) drops rank."""
    minors = a[:, :, 0]
    for size, (rows, others, products) in enumerate(_EXPANSIONS, start=2):
        last = a[:, rows, size - 1] * _SIGNS[:size]
        by_linear = last.swapaxes(-1, -2) @ minors[:, others]
        minors = by_linear.reshape(*by_linear.shape[:2], -1) @ products
    quartic = -np.linalg.pinv(minors[..., SOLUTIONS:]) @ minors[..., :SOLUTIONS]
    times_y = np.empty((len(a), SOLUTIONS, SOLUTIONS))
    lower = _TIMES_Y < SOLUTIONS
    times_y[:, lower] = np.eye(SOLUTIONS)[_TIMES_Y[lower]]
    times_y[:, ~lower] = quartic[:, _TIMES_Y[~lower] - SOLUTIONS]
    values, vectors = np.linalg.eig(times_y)
    found, number = np.nonzero((values.imag == 0.0) & (np.abs(values.real) <= bound))
    vector = vectors[found, :, number].real
    v = vector[:, 1:4] / vector[:, :1]
    near = np.linalg.norm(v, axis=1) < _NEAR * bound  # nor NaN
    return found[near], v[near]


def _polished(a: Array, v: Array) -> tuple[Array, Array, Array]:
    """Return v, w (c,3) after Newton steps on ``A(v) [w; 1] = 0``, and the last step's length."""
    step = np.zeros((len(v), 6))
    rows = a[..., 0] + np.einsum("crjk,ck->crj", a[..., 1:], v)
    w = -(np.linalg.pinv(rows[..., :3]) @ rows[..., 3:])[..., 0]
    for _ in range(_NEWTON_STEPS):
        factors = np.column_stack([w, np.ones(len(w))])
        by_v = np.einsum("crjk,cj->crk", a[..., 1:], factors)
        both = np.concatenate([by_v, rows[..., :3]], axis=-1)
        step = (np.linalg.pinv(both) @ (rows @ factors[..., None]))[..., 0]
        v, w = v - step[:, :3], w - step[:, 3:]
        rows = a[..., 0] + np.einsum("crjk,ck->crj", a[..., 1:], v)
    return v, w, np.linalg.norm(step, axis=1)


def _translations(
    points: Array, rays: Array, tau: Array, v: Array, w: Array
) -> tuple[Array, Array]:
    """Return C and t (c,3) of candidates v and w, by least squares."""
    turned = points + np.cross(v[:, None], points)
    known = _seen(turned + tau[..., None] * np.cross(w[:, None], turned), rays)
    both = -(np.linalg.pinv(_of_translations(rays, tau)) @ known[..., None])[..., 0]
    return both[:, :3], both[:, 3:]


def _nearest_rotations(v: Array) -> Array:
    """Return the rotations (c,3,3) nearest to ``I + [v]x``: about v, by the arctangent of |v|."""
    cosine = 1.0 / np.sqrt(1.0 + np.sum(v**2, axis=1))[:, None, None]
    cross = np.cross(v[:, None], _AXES).swapaxes(1, 2)
    turned: Array = _AXES + cosine * cross + cosine**2 / (1.0 + cosine) * (cross @ cross)
    return turned


def solve_batch(
    points: Array, rays: Array, tau: Array, samples: Any, rotations: Array, iterations: int,
    models: Array, bound: float = BOUND,
) -> None:  # fmt: skip
    """Solve a batch as in :mod:`rs_localizer.solvers.batch`, without iterations.

    Args:
        bound: of |v|.

    The solutions of a sample come first, those nearest to the initial rotation before others.
    """
    models[:] = np.nan
    for start in range(0, len(samples), _BLOCK):
        rows = samples[start : start + _BLOCK]
        initial = rotations[start : start + _BLOCK] if len(rotations) > 1 else rotations
        seen = points[rows] @ initial.swapaxes(1, 2)
        sample, number, v, w, c, t = find_solutions(seen, rays[rows], tau[rows], bound)
        rotated = _nearest_rotations(v) @ (initial[sample] if len(rotations) > 1 else initial)
        models[number, :, start + sample] = np.hstack([rotated.reshape(-1, 9), c, w, t])
