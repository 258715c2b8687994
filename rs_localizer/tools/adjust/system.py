# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Normal equations of whitened rows, their solution, and what is known then.

Unknowns stand in three groups: ``motion``, the controls of a spline, of which a row touches a run
of neighbours; a dense ``border`` that many rows share; and blocks of ``width`` numbers that no row
couples with each other (landmarks, times of images). The blocks are eliminated first (Schur
complement; Triggs et al., *Bundle adjustment: a modern synthesis*, 1999, section 6). What is left
of the motion is a band, if the blocks touch neighbours only, and otherwise dense:

    [ H   C ] [x]     [g]
    [ C^T B ] [y] = - [h]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import (
    cho_factor,
    cho_solve,
    cho_solve_banded,
    cholesky_banded,
    solve_triangular,
)
from scipy.linalg.blas import dsymv, dtrmv
from scipy.linalg.lapack import dpotri
from scipy.sparse import csc_array, csr_array
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.simd.jit import kernel
from rs_localizer.tools.adjust.spline_kernels import CONTROL, LOCAL

# A motion whose band would be wider than this part of it is solved as a dense one.
_DENSE = 0.4
# Of the eigenvalue of a mode: a hundredth of what it makes of a deviation.
_MODE_TOLERANCE = 0.01


class Undetermined(ValueError):
    """The observations leave something open; the message says so."""


class Rows(NamedTuple):
    """What n measurements of r numbers each say, in their own standard deviations."""

    values: Array  # (n,r,w + k) derivatives by a run of w neighbours, then by k others
    first: IntArray  # (n,) number of the first unknown of the run
    others: IntArray  # (n,k) numbers of the others; negative: there is none
    errors: Array  # (n,r)
    cost: float  # sum of squares, or of what a robust loss makes of them

    def times(self, part: slice, by: Array) -> Array:
        """A part of the rows (m r,k) times what all unknowns are by others (N,k)."""
        others, first = self.others[part], self.first[part]
        columns = np.concatenate([first[:, None] + np.arange(_run(self)), others], axis=1)
        return np.asarray(_sparse(self.values[part], columns, len(by)) @ by)


class Quadratic(NamedTuple):
    """What is known of a few unknowns of the border together: ``cost = e^T information e``."""

    columns: IntArray  # (k,)
    information: Array  # (k,k)
    slope: Array  # (k,) information times error
    cost: float


@dataclass(frozen=True, slots=True)
class Groups:
    """How many unknowns there are, in this order."""

    motion: int
    border: int
    blocks: int = 0
    width: int = 1  # numbers of a block

    @property
    def kept(self) -> int:
        """Unknowns that are not eliminated."""
        return self.motion + self.border


@kernel
def _accumulate(
    values: Array, errors: Array, first: IntArray, others: IntArray, motion: int, kept: int,
    shift: int, own: Array, cross: Array, corner: Array, slope: Array,
) -> None:  # fmt: skip
    """Add rows (n,r,k) to the lower triangle; unknowns from ``kept`` on are left out.

    ``own[j, i - shift j]`` is the entry of row i and column j of the motion.
    """
    numbers, rest = values.shape[1], others.shape[1]
    run = values.shape[2] - rest
    for n in range(len(values)):
        base = first[n]
        for q in range(numbers):
            row, error = values[n, q], errors[n, q]
            for b in range(run):
                x = row[b]
                if x == 0.0:
                    continue
                slope[base + b] += x * error
                line, start = own[base + b], base - shift * (base + b)
                for a in range(b, run):
                    line[start + a] += x * row[a]
                side = cross[base + b]
                for k in range(rest):
                    i = others[n, k]
                    if 0 <= i < kept:
                        side[i - motion] += x * row[run + k]
            for k in range(rest):
                i, x = others[n, k], row[run + k]
                if i < 0 or i >= kept or x == 0.0:
                    continue
                slope[i] += x * error
                for m in range(rest):
                    j = others[n, m]
                    if 0 <= j <= i:
                        corner[i - motion, j - motion] += x * row[run + m]


@kernel
def _subtract(
    starts: IntArray, touched: IntArray, halves: Array, motion: int, shift: int, own: Array,
    cross: Array, corner: Array,
) -> None:  # fmt: skip
    """Take ``Y Y^T`` of each block off the lower triangle.

    Args:
        starts: (b + 1,) where the unknowns of each block begin in ``touched``.
        touched: (m,) rising numbers of the unknowns that a block couples.
        halves: (m,w) rows of Y.
    """
    width = halves.shape[1]
    for block in range(len(starts) - 1):
        begin, end = starts[block], starts[block + 1]
        for b in range(begin, end):
            j = touched[b]
            for a in range(b, end):
                i, total = touched[a], 0.0
                for w in range(width):
                    total += halves[a, w] * halves[b, w]
                if i < motion:
                    own[j, i - shift * j] -= total
                elif j < motion:
                    cross[j, i - motion] -= total
                else:
                    corner[i - motion, j - motion] -= total


class _Blocks(NamedTuple):
    """The eliminated blocks, and what couples them with the kept unknowns."""

    information: Array  # (b,w,w)
    slope: Array  # (b,w)
    starts: IntArray  # (b + 1,)
    touched: IntArray  # (m,)
    coupled: Array  # (m,w)
    of: IntArray  # (m,) the block of each

    def times(self, right: Array) -> Array:
        """``W^T x`` (b,w,q) of kept unknowns (N,q)."""
        products = self.coupled[:, :, None] * right[self.touched][:, None, :]
        return sums(products, self.of, len(self.slope))

    def back(self, right: Array, kept: int) -> Array:
        """``W y`` (N,q) of blocks (b,w,q)."""
        return sums(np.einsum("mw,mwq->mq", self.coupled, right[self.of]), self.touched, kept)


def sums(values: Array, groups: IntArray, count: int) -> Array:
    """Sums (count,...) of values (n,...) by group (n,)."""
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    picks = csr_array(
        (np.ones(len(groups)), (groups, np.arange(len(groups)))), shape=(count, len(groups))
    )
    return np.asarray(picks @ flat).reshape(count, *values.shape[1:])


class Matrix(NamedTuple):
    """A symmetric matrix of the kept unknowns; ``own`` and ``corner`` are its lower triangles."""

    shift: int  # 1: the motion is a band, 0: it is dense
    own: Array  # (c,w) or (c,c): own[j, i - shift j] is of row i and column j
    cross: Array  # (c,b)
    corner: Array  # (b,b)
    whole: Array | None  # (N,N) of which own and cross are parts, where the motion is dense

    @classmethod
    def zeros(cls, groups: Groups, reach: int | None) -> Matrix:
        """With a band so wide; None: dense."""
        count, border = groups.motion, groups.border
        corner = np.zeros((border, border))
        if reach is not None:
            return cls(1, np.zeros((count, reach)), np.zeros((count, border)), corner, None)
        return cls._dense(np.zeros((groups.kept, groups.kept)), count, corner)

    @classmethod
    def _dense(cls, whole: Array, count: int, corner: Array) -> Matrix:
        return cls(0, whole[:count, :count], whole[:count, count:], corner, whole)

    def damped(self, damping: float) -> Matrix:
        """A copy whose diagonal is multiplied by 1 + this."""
        if self.whole is not None:
            out = self._dense(self.whole.copy(), len(self.own), self.corner.copy())
            out.own[np.diag_indices(len(out.own))] *= 1.0 + damping
        else:
            out = Matrix(1, self.own.copy(), self.cross.copy(), self.corner.copy(), None)
            out.own[:, :1] *= 1.0 + damping
        out.corner[np.diag_indices(len(out.corner))] *= 1.0 + damping
        return out


class System:
    """The normal equations of terms.

    Args:
        groups: the unknowns.
        terms: rows, and what is known of the border.
    """

    def __init__(self, groups: Groups, terms: Sequence[Rows | Quadratic]) -> None:
        self.groups = groups
        rows = [term for term in terms if isinstance(term, Rows)]
        self.cost = sum(term.cost for term in terms)
        self.blocks = _eliminated(groups, rows) if groups.blocks else None
        reach = max((_run(term) for term in rows if len(term.values)), default=LOCAL)
        if self.blocks is not None:
            reach = max(reach, _reach(self.blocks, groups.motion))
        self.dense = reach > _DENSE * groups.motion
        self.matrix = Matrix.zeros(groups, None if self.dense else reach)
        self.slope = np.zeros(groups.kept)
        for term in terms:
            if isinstance(term, Quadratic):
                at = term.columns - groups.motion
                self.matrix.corner[np.ix_(at, at)] += np.tril(term.information)
                self.slope[term.columns] += term.slope
            elif len(term.values):
                _accumulate(
                    term.values, term.errors, term.first, term.others, groups.motion, groups.kept,
                    *self.matrix[:4], self.slope,
                )  # fmt: skip

    def product(self, x: Array) -> Array:
        """``H x`` of the kept unknowns of a dense motion, as if the blocks were known."""
        own, shared = np.split(x.ravel(), [self.groups.motion])
        _, motion, cross, corner, _ = self.matrix
        return np.concatenate([
            dsymv(1.0, motion.T, own, lower=1) + cross @ shared,
            cross.T @ own + (corner + np.tril(corner, -1).T) @ shared,
        ])  # fmt: skip


def _run(rows: Rows) -> int:
    return int(rows.values.shape[2] - rows.others.shape[1])


def _sparse(values: Array, columns: IntArray, width: int) -> csr_array:
    """Rows (n r,width) of derivatives (n,r,k) by unknowns (n,k); negative: there is none."""
    absent = columns < 0
    values = np.where(absent[:, None], 0.0, values)
    columns = np.repeat(np.where(absent, columns[:, :1], columns), values.shape[1], axis=0)
    starts = columns.shape[1] * np.arange(len(columns) + 1)
    return csr_array((values.ravel(), columns.ravel(), starts), shape=(len(columns), width))


def _eliminated(groups: Groups, rows: Sequence[Rows]) -> _Blocks:
    """Blocks of the rows that have one each, or none."""
    count, width, kept = groups.blocks, groups.width, groups.kept
    information, slope = np.zeros((count, width, width)), np.zeros((count, width))
    coupled = csc_array((kept, count * width))
    for term in rows:
        # The numbers of a block follow each other, in the same columns in all rows of a factor.
        inside = np.flatnonzero((term.others >= kept).any(axis=0))
        if not len(inside):
            continue
        run = _run(term)
        used = term.others[:, inside[0]] >= kept
        of = (term.others[used, inside[0]] - kept) // width
        own, errors = term.values[used][:, :, run + inside], term.errors[used]
        information += sums(np.einsum("nri,nrj->nij", own, own), of, count)
        slope += sums(np.einsum("nri,nr->ni", own, errors), of, count)
        rest = np.setdiff1d(np.arange(term.others.shape[1]), inside)
        first = term.first[used]
        columns = np.column_stack([first[:, None] + np.arange(run), term.others[used][:, rest]])
        if not columns.shape[1]:
            continue
        every = term.values[used]
        values = np.concatenate([every[:, :, :run], every[:, :, run + rest]], axis=2)
        at = width * of[:, None] + np.arange(width)
        own_rows = _sparse(own, at, count * width)
        coupled = coupled + (_sparse(values, columns, kept).T @ own_rows).tocsc()
    coupled = csc_array(coupled)
    coupled.sort_indices()
    sizes = np.diff(coupled.indptr)[::width]
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    block = np.repeat(np.arange(count), sizes)
    # Columns of a block have the same unknowns: of each, one after the other.
    place = width * starts[block] + (np.arange(len(block)) - starts[block])
    touched = coupled.indices[place].astype(np.int64)
    halves = np.column_stack([coupled.data[place + w * sizes[block]] for w in range(width)])
    return _Blocks(information, slope, starts, touched, halves.reshape(-1, width), block)


def _reach(blocks: _Blocks, motion: int) -> int:
    """Width of the band that the motion has without the blocks."""
    own = blocks.touched < motion
    low, high = np.full(len(blocks.slope), motion), np.full(len(blocks.slope), -1)
    np.minimum.at(low, blocks.of[own], blocks.touched[own])
    np.maximum.at(high, blocks.of[own], blocks.touched[own])
    return int(np.max(high - low, initial=0)) + 1


class Factored:
    """A factored system.

    Args:
        system: the normal equations.
        damping: the diagonal is multiplied by 1 + this (Levenberg and Marquardt).

    Raises:
        Undetermined: when the system is not positive definite.
    """

    def __init__(self, system: System, damping: float = 0.0) -> None:
        self.system, groups = system, system.groups
        matrix = system.matrix.damped(damping)
        corner = matrix.corner
        self._scale = 1.0 / np.sqrt(np.maximum(np.diag(corner), 1e-300))
        try:
            if system.blocks is not None:
                blocks, own = system.blocks, system.blocks.information.copy()
                own[:, np.arange(groups.width), np.arange(groups.width)] *= 1.0 + damping
                self._inverses = np.linalg.inv(own)
                roots = np.linalg.cholesky(self._inverses)
                halves = np.einsum("mw,mwv->mv", blocks.coupled, roots[blocks.of])
                _subtract(blocks.starts, blocks.touched, halves, groups.motion, *matrix[:4])
            corner += np.tril(corner, -1).T
            if matrix.whole is not None:
                matrix.whole[groups.motion :, groups.motion :] = corner
                self._whole = cho_factor(
                    matrix.whole.T, lower=True, overwrite_a=True, check_finite=False
                )
            else:
                self._factor_band(matrix)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise Undetermined(f"the observations do not determine the motion: {error}") from error

    def _factor_band(self, matrix: Matrix) -> None:
        self._band = cholesky_banded(matrix.own.T, lower=True, check_finite=False)
        self._cross = matrix.cross
        self._lifted = self._solve_band(matrix.cross)  # how the controls follow the border
        schur = matrix.corner - matrix.cross.T @ self._lifted
        scaled = schur * self._scale[:, None] * self._scale
        self._schur = cho_factor(scaled, lower=True) if len(schur) else None

    def _solve_band(self, right: Array) -> Array:
        if right.shape[1] == 0:
            return right
        return np.asarray(cho_solve_banded((self._band, True), right, check_finite=False))

    def _solve_schur(self, right: Array) -> Array:
        if self._schur is None:
            return right
        scale = self._scale[:, None]
        return np.asarray(scale * cho_solve(self._schur, scale * right))

    def kept(self, right: Array) -> Array:
        """Solutions (N,q) of the reduced system."""
        if self.system.dense:
            return np.asarray(cho_solve(self._whole, right, check_finite=False))
        own, shared = np.split(right, [self.system.groups.motion])
        inner = self._solve_band(own)
        border = self._solve_schur(shared - self._cross.T @ inner)
        return np.concatenate([inner - self._lifted @ border, border])

    def solve(self, right: Array, of_blocks: Array | None = None) -> tuple[Array, Array]:
        """Solutions (N,q) and of the blocks (b,w,q), for right sides of these shapes."""
        blocks, groups = self.system.blocks, self.system.groups
        if blocks is None:
            return self.kept(right), np.zeros((0, groups.width, right.shape[1]))
        assert of_blocks is not None
        own = self._inverses @ of_blocks
        found = self.kept(right - blocks.back(own, groups.kept))
        return found, own - self._inverses @ blocks.times(found)

    def step(self) -> Array:
        """The step of all unknowns in their order."""
        blocks = self.system.blocks
        of_blocks = None if blocks is None else -blocks.slope[:, :, None]
        kept, others = self.solve(-self.system.slope[:, None], of_blocks)
        return np.concatenate([kept[:, 0], others.ravel()])

    def border_covariance(self) -> Array:
        """Covariance (b,b) of the border, all else marginalised."""
        groups = self.system.groups
        if not self.system.dense:
            return self._solve_schur(np.eye(groups.border))
        unit = np.zeros((groups.kept, groups.border))
        unit[groups.motion :] = np.eye(groups.border)
        return self.kept(unit)[groups.motion :]

    def block_covariances(self) -> tuple[Array, Array]:
        """Of each block (b,w,w) and of the border (b,b); the factors of a dense one are used up."""
        blocks, motion = self.system.blocks, self.system.groups.motion
        assert blocks is not None
        assert self.system.dense
        inverse, failed = dpotri(self._whole[0], lower=1, overwrite_c=1)
        if failed:
            raise Undetermined("the images do not determine map and motion")

        def part(at: IntArray) -> Array:
            lower = np.tril(inverse[np.ix_(at, at)])  # numbers rise
            return np.asarray(lower + np.tril(lower, -1).T)

        out = self._inverses.copy()
        for k in range(len(out)):
            own = slice(blocks.starts[k], blocks.starts[k + 1])
            gain = blocks.coupled[own] @ self._inverses[k]
            out[k] += gain.T @ part(blocks.touched[own]) @ gain
        return np.asarray(out), part(np.arange(motion, len(inverse)))

    def modes(self, count: int) -> Array:
        """Independent errors (N,count) of the kept unknowns, one deviation of each.

        All N of them have the covariance ``S^-1``; these are the ones by which blocks that know
        nothing else of each other move the most, in their own deviations: the eigenvectors of
        ``H x = (1 + l) S x``, of which ``l`` is the squared sum of these moves. Fewer where these
        do not converge.
        """
        assert self.system.dense
        size = self.system.groups.kept
        factor = self._whole[0]
        solve = partial(cho_solve, self._whole, check_finite=False)

        def reduced(x: Array) -> Array:
            half = dtrmv(factor, x.ravel(), lower=1, trans=1)
            return np.asarray(dtrmv(factor, half, lower=1))

        start = np.random.default_rng(0).normal(size=size)  # the same images, the same map
        try:
            _, modes = eigsh(
                LinearOperator((size, size), self.system.product, dtype=float),
                min(count, size - 1),
                LinearOperator((size, size), reduced, dtype=float),
                Minv=LinearOperator((size, size), solve, dtype=float),
                which="LA", v0=start, tol=_MODE_TOLERANCE,
            )  # fmt: skip
        except ArpackNoConvergence as stopped:  # after all the work that a map is: what there is
            modes = stopped.eigenvectors
        return np.asarray(modes[:, ::-1])

    def local_covariances(self, firsts: IntArray) -> Array:
        """Covariances (m,24,24) of the four controls from each of ``firsts`` (m,) on.

        From the blocks on and beside the diagonal of the inverse of the band (a recursion from
        its end to its beginning), and from the border's covariance.
        """
        size, count = self.system.matrix.own.shape[1] - CONTROL, self.system.groups.motion
        if self.system.dense:
            inverse = self.kept(np.eye(self.system.groups.kept))
            at = CONTROL * firsts[:, None] + np.arange(LOCAL)
            return np.asarray(inverse[at[:, :, None], at[:, None, :]])
        diagonal, beside = self._inverse_blocks(size)
        border = self.border_covariance()
        out, pair = np.empty((len(firsts), LOCAL, LOCAL)), np.empty((2 * size, 2 * size))
        for m, first in enumerate(firsts):
            block, inside = divmod(CONTROL * int(first), size)
            following = min(block + 1, len(diagonal) - 1)
            pair[:size, :size], pair[size:, size:] = diagonal[block], diagonal[following]
            pair[:size, size:], pair[size:, :size] = beside[block], beside[block].T
            begin = CONTROL * int(first)
            lifted = self._lifted[begin : min(begin + LOCAL, count)]
            own = pair[inside : inside + LOCAL, inside : inside + LOCAL]
            out[m] = own + lifted @ border @ lifted.T
        return out

    def _inverse_blocks(self, size: int) -> tuple[Array, Array]:
        """Blocks (k,s,s) on the diagonal of H^-1, and those to their right."""
        band, count = self._band, self.system.groups.motion
        blocks = -(-count // size)
        lower, below = np.zeros((2, blocks, size, size))  # and L of the next block by this one
        lower[:] = np.eye(size)
        for d in range(min(len(band), count)):
            columns = np.arange(count - d)
            rows = columns + d
            where, value = (columns // size, rows % size, columns % size), band[d, : count - d]
            for ahead, blocks_of in ((0, lower), (1, below)):
                here = rows // size == columns // size + ahead
                blocks_of[tuple(w[here] for w in where)] = value[here]
        diagonal, beside = np.empty_like(lower), np.zeros_like(lower)
        for k in range(blocks - 1, -1, -1):
            inverse = solve_triangular(lower[k], np.eye(size), lower=True, check_finite=False)
            diagonal[k] = inverse.T @ inverse
            if k + 1 < blocks:
                gain = below[k] @ inverse  # (next, this): x_this = ... - gain^T x_next
                beside[k] = -gain.T @ diagonal[k + 1]
                diagonal[k] = diagonal[k] - beside[k] @ gain
        return diagonal, beside
