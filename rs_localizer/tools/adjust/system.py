# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Normal equations of whitened rows, their solution, and its covariance.

Unknowns stand in three groups: ``motion``, the controls of a spline, of which a row touches a run
of neighbours; a dense ``border`` that many rows share; and blocks of ``width`` numbers that no row
couples with each other (landmarks, times of images). The blocks are eliminated first (Schur
complement; Triggs et al., *Bundle adjustment: a modern synthesis*, 1999, section 6). What is left
of the motion is a band, if the blocks touch neighbours only, and otherwise dense:

    [ H   C ] [x]     [g]
    [ C^T B ] [y] = - [h]
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded, solve_triangular
from scipy.linalg.blas import dtrmv
from scipy.linalg.lapack import dpotri
from scipy.sparse import bsr_array, csc_array, csr_array, dia_array, vstack
from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.tools.adjust.row_kernels import accumulate
from rs_localizer.tools.adjust.spline_kernels import CONTROL, LOCAL

# A motion whose band would be wider than this part of it is solved as a dense one.
_DENSE = 0.4
# Rows of a dense matrix from which the blocks are taken at once: 100 MB of 10,000.
_ROWS_AT_ONCE = 1000
# Tolerance of a mode's eigenvalue: a hundredth of its effect on a deviation.
_MODE_TOLERANCE = 0.01


class Undetermined(ValueError):
    """The observations leave something open; the message says so."""


class Rows(NamedTuple):
    """Whitened rows of n measurements of r numbers each."""

    values: Array  # (n,r,w + k) derivatives by a run of w neighbours, then by k others
    first: IntArray  # (n,) number of the first unknown of the run
    others: IntArray  # (n,k) numbers of the others; negative: there is none
    errors: Array  # (n,r)
    cost: float  # sum of squares, or of what a robust loss makes of them

    @property
    def run(self) -> int:
        """How many neighbours a row touches."""
        return int(self.values.shape[2] - self.others.shape[1])

    def matrix(self, width: int, part: slice = slice(None)) -> csr_array:
        """Return derivatives (m r,width) by the first unknowns, of all measurements or a part."""
        others, values = self.others[part], self.values[part]
        columns = np.concatenate([self.first[part, None] + np.arange(self.run), others], axis=1)
        absent = (columns < 0) | (columns >= width)
        values = np.where(absent[:, None], 0.0, values)
        columns = np.where(absent, np.clip(columns[:, :1], 0, width - 1), columns)
        columns = np.repeat(columns, values.shape[1], axis=0)
        starts = columns.shape[1] * np.arange(len(columns) + 1)
        return csr_array((values.ravel(), columns.ravel(), starts), shape=(len(columns), width))


class Quadratic(NamedTuple):
    """Knowledge of a few unknowns of the border together: ``cost = e^T information e``."""

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


class _Blocks(NamedTuple):
    """The eliminated blocks, and what couples them with the kept unknowns."""

    information: Array  # (b,w,w)
    slope: Array  # (b w,)
    coupled: csc_array  # (N,b w)


class Band(NamedTuple):
    """A symmetric matrix of the kept unknowns, whose motion is a band."""

    own: Array  # (c,w) own[j, i - j] is of row i >= j and column j
    cross: Array  # (c,b)
    corner: Array  # (b,b)


class System:
    """The normal equations of terms.

    Args:
        groups: the unknowns.
        terms: rows, and priors of the border.
        dense: the motion is dense even if it is a band, as covariances of blocks and modes need.
    """

    def __init__(
        self, groups: Groups, terms: Sequence[Rows | Quadratic], dense: bool = False
    ) -> None:
        self.groups = groups
        rows = [term for term in terms if isinstance(term, Rows) and len(term.values)]
        known = [term for term in terms if isinstance(term, Quadratic)]
        self.cost = sum(term.cost for term in terms)
        self.blocks = _eliminated(groups, rows) if groups.blocks else None
        reach = max((term.run for term in rows), default=LOCAL)
        if self.blocks is not None:  # without the blocks, the motion has a band as wide as they
            own = csc_array(self.blocks.coupled[: groups.motion])
            own.sort_indices()
            firsts, ends = own.indptr[:-1], own.indptr[1:]
            some = ends > firsts
            widths = own.indices[ends[some] - 1] - own.indices[firsts[some]]
            reach = max(reach, int(np.max(widths, initial=0)) + 1)
        self.slope = np.zeros(groups.kept)
        self.matrix: Array | Band  # (N,N) of a dense motion
        if dense or reach > _DENSE * groups.motion:
            self.matrix = np.zeros((groups.kept, groups.kept))
            for term in rows:
                own = term.matrix(groups.kept)
                square = (own.T @ own).tocoo()
                self.matrix[square.row, square.col] += square.data
                self.slope += own.T @ term.errors.ravel()
        else:
            sizes = (groups.motion, reach), (groups.motion, groups.border), (groups.border,) * 2
            self.matrix = Band(*map(np.zeros, sizes))
            for term in rows:
                accumulate(
                    term.values, term.errors, term.first, term.others, groups.motion, groups.kept,
                    *self.matrix, self.slope,
                )  # fmt: skip
            self.corner[:] += np.tril(self.corner, -1).T
        for one in known:
            at = one.columns - groups.motion
            self.corner[np.ix_(at, at)] += one.information
            self.slope[one.columns] += one.slope

    @property
    def dense(self) -> bool:
        """True where the motion is no band."""
        return not isinstance(self.matrix, Band)

    @property
    def corner(self) -> Array:
        """The border's own part (b,b)."""
        if isinstance(self.matrix, Band):
            return self.matrix.corner
        return self.matrix[self.groups.motion :, self.groups.motion :]


def _eliminated(groups: Groups, rows: Sequence[Rows]) -> _Blocks:
    """Return the blocks of the rows that have one each, or none."""
    count, width, kept = groups.blocks, groups.width, groups.kept
    with_block = [term for term in rows if np.any(term.others >= kept)]
    whole = vstack([term.matrix(kept + count * width) for term in with_block]).tocsc()
    errors = np.concatenate([term.errors.ravel() for term in with_block])
    rest, own = whole[:, :kept], whole[:, kept:]
    information, square = np.zeros((count, width, width)), (own.T @ own).tocoo()
    information[square.row // width, square.row % width, square.col % width] = square.data
    coupled = csc_array(rest.T @ own)
    coupled.sort_indices()
    return _Blocks(information, np.asarray(own.T @ errors), coupled)


class Factored:
    """A factored system.

    Args:
        system: the normal equations.
        damping: the diagonal is multiplied by 1 + this (Levenberg and Marquardt).

    Raises:
        Undetermined: when the system is not positive definite.
    """

    def __init__(self, system: System, damping: float = 0.0) -> None:
        self.system, blocks = system, system.blocks
        try:
            reduction: csr_array | None = None
            if blocks is not None:
                own = blocks.information.copy()
                own[:, np.arange(own.shape[1]), np.arange(own.shape[1])] *= 1.0 + damping
                self._inverses = np.linalg.inv(own)
                count = np.arange(len(own) + 1)
                inverse = bsr_array((self._inverses, count[:-1], count))
                reduction = csr_array(blocks.coupled @ inverse)
            if isinstance(system.matrix, Band):
                self._factor_band(Band(*map(np.copy, system.matrix)), damping, reduction)
            else:
                self._factor_dense(system.matrix.copy(), damping, reduction)
        except (np.linalg.LinAlgError, ValueError) as error:
            raise Undetermined(f"the observations do not determine the motion: {error}") from error

    def _factor_dense(self, matrix: Array, damping: float, reduction: csr_array | None) -> None:
        matrix[np.diag_indices(len(matrix))] *= 1.0 + damping
        if reduction is not None and self.system.blocks is not None:
            others = self.system.blocks.coupled.T
            for first in range(0, len(matrix), _ROWS_AT_ONCE):
                some = slice(first, first + _ROWS_AT_ONCE)
                matrix[some] -= (reduction[some] @ others).toarray()
        self._whole = cho_factor(matrix.T, lower=True, overwrite_a=True, check_finite=False)

    def _factor_band(self, band: Band, damping: float, reduction: csr_array | None) -> None:
        band.own[:, 0] *= 1.0 + damping
        band.corner[np.diag_indices(len(band.corner))] *= 1.0 + damping
        scale = 1.0 / np.sqrt(np.maximum(np.diag(band.corner), 1e-300))
        if reduction is not None and self.system.blocks is not None:
            motion, coupled = len(band.own), self.system.blocks.coupled
            shared = coupled[motion:].toarray().T
            band.corner[:] -= reduction[motion:] @ shared
            band.cross[:] -= reduction[:motion] @ shared
            square = (reduction[:motion] @ coupled[:motion].T).tocoo()
            i, j, lower = square.row, square.col, square.row >= square.col
            band.own[j[lower], (i - j)[lower]] -= square.data[lower]
        self._band = cholesky_banded(band.own.T, lower=True, check_finite=False)
        self._cross, self._scale = band.cross, scale
        self._lifted = self._solve_band(band.cross)  # how the controls follow the border
        schur = band.corner - band.cross.T @ self._lifted
        scaled = schur * scale[:, None] * scale
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
        """Return the solutions (N,q) of the reduced system."""
        if self.system.dense:
            return np.asarray(cho_solve(self._whole, right, check_finite=False))
        own, shared = np.split(right, [self.system.groups.motion])
        inner = self._solve_band(own)
        border = self._solve_schur(shared - self._cross.T @ inner)
        return np.concatenate([inner - self._lifted @ border, border])

    def solve(self, right: Array, of_blocks: Array) -> tuple[Array, Array]:
        """Return solutions (N,q) and of the blocks (b,w,q), for right sides of these shapes."""
        blocks, count = self.system.blocks, right.shape[1]
        assert blocks is not None
        own = self._inverses @ of_blocks
        found = self.kept(right - blocks.coupled @ own.reshape(-1, count))
        back = (blocks.coupled.T @ found).reshape(own.shape)
        return found, own - self._inverses @ back

    def step(self) -> Array:
        """Return the step of all unknowns in their order."""
        right, blocks = -self.system.slope[:, None], self.system.blocks
        if blocks is None:
            return self.kept(right)[:, 0]
        of_blocks = -blocks.slope.reshape(len(self._inverses), -1, 1)
        kept, others = self.solve(right, of_blocks)
        return np.concatenate([kept[:, 0], others.ravel()])

    def border_covariance(self) -> Array:
        """Return the covariance (b,b) of the border, all else marginalized."""
        groups = self.system.groups
        if not self.system.dense:
            return self._solve_schur(np.eye(groups.border))
        return self.kept(np.eye(groups.kept, groups.border, -groups.motion))[groups.motion :]

    def block_covariances(self) -> tuple[Array, Array]:
        """Return covariances of blocks (b,w,w) and border (b,b); uses up a dense factor."""
        blocks, motion = self.system.blocks, self.system.groups.motion
        assert blocks is not None
        assert self.system.dense
        inverse, failed = dpotri(self._whole[0], lower=1, overwrite_c=1)
        if failed:
            raise Undetermined("the images do not determine map and motion")

        def part(at: IntArray) -> Array:
            lower = np.tril(inverse[np.ix_(at, at)])  # numbers rise
            return np.asarray(lower + np.tril(lower, -1).T)

        out, starts = self._inverses.copy(), blocks.coupled.indptr
        width = out.shape[1]
        for k in range(len(out)):
            ends = starts[width * k : width * (k + 1) + 1]
            own = slice(ends[0], ends[-1])
            at, place = np.unique(blocks.coupled.indices[own], return_inverse=True)
            coupled = np.zeros((len(at), width))
            coupled[place, np.repeat(np.arange(width), np.diff(ends))] = blocks.coupled.data[own]
            gain = coupled @ self._inverses[k]
            out[k] += gain.T @ part(at) @ gain
        return np.asarray(out), part(np.arange(motion, len(inverse)))

    def modes(self, count: int) -> Array:
        """Return independent errors (N,count) of the kept unknowns, one deviation of each.

        All N of them have the covariance ``S^-1``; these are the ones by which blocks that know
        nothing else of each other move the most, in their own deviations: the eigenvectors of
        ``H x = (1 + l) S x``, of which ``l`` is the squared sum of these moves. Fewer where these
        do not converge.
        """
        size, matrix = self.system.groups.kept, self.system.matrix
        assert not isinstance(matrix, Band)
        factor = self._whole[0]
        solve = partial(cho_solve, self._whole, check_finite=False)

        def reduced(x: Array) -> Array:
            half = dtrmv(factor, x.ravel(), lower=1, trans=1)
            return np.asarray(dtrmv(factor, half, lower=1))

        start = np.random.default_rng(0).normal(size=size)  # the same images, the same map
        try:
            _, modes = eigsh(
                matrix, min(count, size - 1), LinearOperator((size, size), reduced, dtype=float),
                Minv=LinearOperator((size, size), solve, dtype=float),
                which="LA", v0=start, tol=_MODE_TOLERANCE,
            )  # fmt: skip
        except ArpackNoConvergence as stopped:  # after all the work that a map is: what there is
            modes = stopped.eigenvectors
        return np.asarray(modes[:, ::-1])

    def local_covariances(self, firsts: IntArray) -> Array:
        """Return covariances (m,24,24) of four controls from each of ``firsts`` (m,) on.

        From the blocks on and beside the diagonal of the inverse of the band (a recursion from
        its end to its beginning), and from the border's covariance.
        """
        count, starts = self.system.groups.motion, (CONTROL * firsts).tolist()
        if not isinstance(self.system.matrix, Band):
            inverse = self.kept(np.eye(self.system.groups.kept))
            at = CONTROL * firsts[:, None] + np.arange(LOCAL)
            return np.asarray(inverse[at[:, :, None], at[:, None, :]])
        size = self.system.matrix.own.shape[1] - CONTROL
        diagonal, beside = self._inverse_blocks(size)
        border = self.border_covariance()
        out, pair = np.empty((len(firsts), LOCAL, LOCAL)), np.empty((2 * size, 2 * size))
        for m, start in enumerate(starts):
            block, inside = divmod(start, size)
            following = min(block + 1, len(diagonal) - 1)
            pair[:size, :size], pair[size:, size:] = diagonal[block], diagonal[following]
            pair[:size, size:], pair[size:, :size] = beside[block], beside[block].T
            lifted = self._lifted[start : min(start + LOCAL, count)]
            own = slice(inside, inside + LOCAL)
            out[m] = pair[own, own] + lifted @ border @ lifted.T
        return out

    def _inverse_blocks(self, size: int) -> tuple[Array, Array]:
        """Return the blocks (k,s,s) on the diagonal of H^-1, and those to their right."""
        count = self.system.groups.motion
        blocks = -(-count // size)
        band = np.zeros((len(self._band), blocks * size))  # of whole blocks
        band[0], band[:, :count] = 1.0, self._band
        lower = dia_array((band, -np.arange(len(band))), shape=(blocks * size,) * 2).tocsr()
        diagonal, beside = np.zeros((2, blocks, size, size))
        for k in range(blocks - 1, -1, -1):
            own, following = (slice(i * size, (i + 1) * size) for i in (k, k + 1))
            inverse = solve_triangular(
                lower[own, own].toarray(), np.eye(size), lower=True, check_finite=False
            )
            diagonal[k] = inverse.T @ inverse
            if k + 1 < blocks:
                # (next, this): x_this = ... - gain^T x_next
                gain = lower[following, own].toarray() @ inverse
                beside[k] = -gain.T @ diagonal[k + 1]
                diagonal[k] -= beside[k] @ gain
        return diagonal, beside
