# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Bordered banded systems: solutions and marginal covariances (SciPy's LAPACK, Schur complement).

    [ H   C ] [x]     [g]
    [ C^T B ] [y] = - [h]

``H`` is the band of the controls, ``B`` the border that all frames share.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cho_solve_banded, cholesky_banded, solve_triangular

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.trajectory.normal_kernels import Normal
from rs_localizer.trajectory.spline_kernels import CONTROL, LOCAL


class Undetermined(ValueError):
    """The observations leave something open; the message says so."""


class Factored:
    """A factored bordered system.

    Args:
        normal: the normal equations.
        damping: the diagonal is multiplied by 1 + this (Levenberg and Marquardt).

    Raises:
        Undetermined: when the system is not positive definite.
    """

    def __init__(self, normal: Normal, damping: float = 0.0) -> None:
        band = normal.band.copy()
        # Size of the blocks of the block-tridiagonal form: as many neighbouring controls as the
        # band couples lie in two blocks.
        self._block = len(band) - CONTROL
        band[0] *= 1.0 + damping
        corner = normal.corner + np.tril(normal.corner, -1).T
        corner[np.diag_indices_from(corner)] *= 1.0 + damping
        self._normal = normal
        try:
            self._band = cholesky_banded(band, lower=True, check_finite=False)
            self.lifted = self._solve(normal.cross)  # H^-1 C: how the controls follow the border
            schur = corner - normal.cross.T @ self.lifted
            self._scale = 1.0 / np.sqrt(np.maximum(np.diag(corner), 1e-300))
            scaled = schur * self._scale[:, None] * self._scale
            self._schur = cho_factor(scaled, lower=True) if len(schur) else None
        except (np.linalg.LinAlgError, ValueError) as error:
            raise Undetermined(f"the observations do not determine the motion: {error}") from error

    def _solve(self, right: Array) -> Array:
        if right.ndim == 2 and right.shape[1] == 0:
            return right
        solved: Array = cho_solve_banded((self._band, True), right, check_finite=False)
        return solved

    def _solve_schur(self, right: Array) -> Array:
        if self._schur is None:
            return right
        scale = self._scale if right.ndim == 1 else self._scale[:, None]
        solved: Array = scale * cho_solve(self._schur, scale * right)
        return solved

    def step(self) -> tuple[Array, Array]:
        """The step (6 n,) of the controls and (b,) of the border."""
        inner = self._solve(self._normal.slope)
        border = -self._solve_schur(self._normal.border_slope - self._normal.cross.T @ inner)
        return -inner - self.lifted @ border, border

    def border_covariance(self) -> Array:
        """Covariance (b,b) of the border, the controls marginalised."""
        return self._solve_schur(np.eye(len(self._scale)))

    def local_covariances(self, firsts: IntArray) -> Array:
        """Covariances (m,24,24) of the four controls from each of ``firsts`` (m,) on.

        From the blocks on and beside the diagonal of the inverse of the band (a recursion from
        its end to its beginning), and from the border's covariance.
        """
        diagonal, beside = self._inverse_blocks()
        border = self.border_covariance()
        out = np.empty((len(firsts), LOCAL, LOCAL))
        size, count = self._block, len(self._band[0])
        pair = np.empty((2 * size, 2 * size))
        for m, first in enumerate(firsts):
            block, inside = divmod(CONTROL * int(first), size)
            following = min(block + 1, len(diagonal) - 1)
            pair[:size, :size] = diagonal[block]
            pair[size:, size:] = diagonal[following]
            pair[:size, size:] = beside[block]
            pair[size:, :size] = beside[block].T
            begin = CONTROL * int(first)
            lifted = self.lifted[begin : min(begin + LOCAL, count)]
            own = pair[inside : inside + LOCAL, inside : inside + LOCAL]
            out[m] = own + lifted @ border @ lifted.T
        return out

    def _inverse_blocks(self) -> tuple[Array, Array]:
        """Blocks (k,s,s) on the diagonal of H^-1, and those to their right."""
        band, size = self._band, self._block
        count = band.shape[1]
        blocks = -(-count // size)
        lower = np.zeros((blocks, size, size))
        below = np.zeros((blocks, size, size))  # L of the next block by this one
        lower[:] = np.eye(size)
        for d in range(min(len(band), count)):
            columns = np.arange(count - d)
            rows = columns + d
            where = (columns // size, rows % size, columns % size)
            value = band[d, : count - d]
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
