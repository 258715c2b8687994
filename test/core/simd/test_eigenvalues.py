# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Real eigenvalues in lanes against LAPACK's, on easy, cyclic, defective and broken matrices."""

import numba
import numpy as np
import pytest

from rs_localizer.core.simd.eigenvalues import real_eigenvalues, reduce_to_hessenberg
from rs_localizer.core.simd.tracing import LANES
from rs_localizer.core.simd.vectors import lane_array
from rs_localizer.native import COMPILES


@numba.njit
def _find(matrices, bound, counts, found):
    n = matrices.shape[1]
    h, room, values = lane_array((n + 1) ** 2), lane_array(n + 5), lane_array(n)
    for lane in range(LANES):
        for i in range(n):
            for j in range(n):
                h[(i * (n + 1) + j) * LANES + lane] = matrices[lane, i, j]
    reduce_to_hessenberg(h, n, room)
    real_eigenvalues(h, n, bound, room, counts, values)
    for lane in range(LANES):
        for k in range(counts[lane]):
            found[lane, k] = values[k * LANES + lane]


def find(matrices, bound=np.inf):
    """Sorted real eigenvalues of each of ``LANES`` matrices."""
    if not COMPILES:
        pytest.skip("only kernels call it: RS_LOCALIZER_KERNELS=numba runs it")
    n = matrices.shape[1]
    counts, found = np.zeros(LANES, np.int64), np.zeros((LANES, n))
    _find(np.ascontiguousarray(matrices, dtype=float), float(bound), counts, found)
    return [np.sort(row[:count]) for row, count in zip(found, counts, strict=True)]


def lapack(matrix, bound=np.inf):
    values = np.linalg.eigvals(matrix)
    return np.sort(values[(values.imag == 0) & (np.abs(values) <= bound)].real)


@pytest.mark.parametrize("n", [1, 2, 3, 4, 7, 20])
def test_random_matrices(n):
    rng = np.random.default_rng(n)
    total = 0
    for _ in range(30):
        matrices = rng.normal(size=(LANES, n, n))
        for ours, matrix in zip(find(matrices), matrices, strict=True):
            np.testing.assert_allclose(ours, lapack(matrix), rtol=1e-7, atol=1e-9)
            total += len(ours)
    assert total > 30


def test_symmetric_matrices_have_all_of_them_and_the_bound_selects():
    rng = np.random.default_rng(1)
    matrices = rng.normal(size=(LANES, 20, 20))
    matrices = matrices + matrices.swapaxes(1, 2)
    for ours, matrix in zip(find(matrices), matrices, strict=True):
        np.testing.assert_allclose(ours, np.linalg.eigvalsh(matrix), atol=1e-12)
    for ours, matrix in zip(find(matrices, 3.0), matrices, strict=True):
        expected = np.linalg.eigvalsh(matrix)
        np.testing.assert_allclose(ours, expected[np.abs(expected) <= 3.0], atol=1e-12)


def test_lanes_with_different_problems_do_not_disturb_each_other():
    n = 6
    rng = np.random.default_rng(2)
    cyclic = np.roll(np.eye(n), 1, axis=0)  # the usual shifts never end: it is orthogonal
    jordan = 2.0 * np.eye(n) + np.eye(n, k=1)
    broken, infinite = np.eye(n), np.eye(n)
    broken[3, 1] = np.nan
    infinite[0, 5] = np.inf
    plain = rng.normal(size=(n, n))
    blocks = np.kron(np.eye(3), [[0.0, 1.0], [-1.0, 0.0]])
    found = find(
        np.stack(
            [cyclic, jordan, broken, np.zeros((n, n)), plain, infinite, np.triu(plain), blocks]
        )
    )
    np.testing.assert_allclose(found[0], [-1.0, 1.0], atol=1e-12)
    assert (np.abs(found[1] - 2.0) < 1e-2).all()
    assert len(found[2]) == len(found[5]) == len(found[7]) == 0
    np.testing.assert_array_equal(found[3], np.zeros(n))
    np.testing.assert_allclose(found[4], lapack(plain), atol=1e-12)
    np.testing.assert_allclose(found[6], np.sort(np.diag(plain)), atol=1e-12)
