# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The traced code against the same arithmetic in NumPy."""

import numba
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core.simd.algebra import cross, least_squares, nearest_rotation
from rs_localizer.core.simd.tracing import LANES, select, sqrt, traced, traced_sums
from rs_localizer.core.so3 import hat
from rs_localizer.native import COMPILES


def run(function, values, outputs):
    if not COMPILES:
        pytest.skip("what is traced is a part of kernels: RS_LOCALIZER_KERNELS=numba runs it")

    @numba.njit
    def call(source, target):
        function(source, target)

    target = np.full(outputs * LANES, np.nan)
    call(np.ascontiguousarray(values, dtype=float).ravel(), target)
    return target.reshape(outputs, LANES)


def values(count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, LANES))


def test_arithmetic_and_selection_are_those_of_numpy():
    """Lane by lane; comparisons with NaN are false, and structural zeros and ones are free."""
    x, y = given = values(2)
    x[0] = np.nan
    result = run(
        traced(
            lambda v: [v[0] + v[1], 2.0 - v[0], v[0] * v[1], v[0] / v[1], 1.0 / v[0], -v[0],
                       abs(v[0]), sqrt(v[0] * v[0] + 1.0), 3.0 * v[0] - 1.0,
                       0.0 * v[1], 1.0 * v[0], v[0] + 0.0, v[0] - 0.0, 0.0 - v[0],
                       select(v[0] > 0.0, v[1], -1.0),
                       select((v[0] > 0.0) & (v[1] < 0.0), 1.0, v[1])],
            2,
        ),
        given, 16,
    )  # fmt: skip
    expected = [
        x + y, 2 - x, x * y, x / y, 1 / x, -x, abs(x), np.sqrt(x * x + 1), 3 * x - 1, 0 * y, x, x,
        x, -x, np.where(x > 0, y, -1), np.where((x > 0) & (y < 0), 1, y),
    ]  # fmt: skip
    np.testing.assert_allclose(result, expected, rtol=1e-14)


@pytest.mark.parametrize(("rows", "columns"), [(3, 3), (6, 4), (8, 8), (12, 5)])
def test_least_squares_is_that_of_numpy(rows, columns):
    given = values(rows * (columns + 1))

    def body(v):
        matrix = [v[j * rows : (j + 1) * rows] for j in range(columns + 1)]
        return least_squares(matrix[:-1], matrix[-1])

    solution = run(traced(body, rows * (columns + 1)), given, columns)
    for lane in range(LANES):
        system = given[:, lane].reshape(columns + 1, rows).T
        expected = np.linalg.lstsq(system[:, :-1], system[:, -1], rcond=None)[0]
        np.testing.assert_allclose(solution[:, lane], expected, rtol=1e-9)


def test_a_singular_lane_is_not_finite_and_leaves_the_others_alone():
    given = values(9 + 3, seed=3)
    given[3:6, 2] = given[0:3, 2]  # two equal columns in lane 2
    solution = run(traced(lambda v: least_squares([v[0:3], v[3:6], v[6:9]], v[9:12]), 12), given, 3)
    size = np.abs(solution).max(axis=0)
    assert not size[2] < 1e12
    assert (np.delete(size, 2) < 1e3).all()


def test_cross_and_nearest_rotation():
    given = values(6)
    result = run(
        traced(
            lambda v: cross(v[0:3], v[3:6]) + [x for r in nearest_rotation(v[0:3]) for x in r],
            6,
        ),
        given, 12,
    )  # fmt: skip
    for lane in range(LANES):
        a, b = given[:3, lane], given[3:, lane]
        np.testing.assert_allclose(result[:3, lane], np.cross(a, b), atol=1e-14)
        u, _, vt = np.linalg.svd(np.eye(3) + hat(a))
        np.testing.assert_allclose(result[3:, lane].reshape(3, 3), u @ vt, atol=1e-13)
        assert Rotation.from_matrix(u @ vt).magnitude() == pytest.approx(
            np.arctan(np.linalg.norm(a))
        )


def test_sums_go_over_all_lanes_of_all_blocks():
    if not COMPILES:
        pytest.skip("what is traced is a part of kernels: RS_LOCALIZER_KERNELS=numba runs it")
    bodies = ((lambda v: [v[0] * v[1], v[2]], 2), (lambda v: [v[0] + v[2]], 1))
    sums = traced_sums(3, *bodies)

    @numba.njit
    def call(source, blocks, target):
        sums(source, blocks, target)

    source = np.random.default_rng(0).normal(size=(7, 3, LANES))
    target = np.full(3, np.nan)
    call(source.reshape(7, -1), 5, target)
    x, y, z = source[:5].transpose(1, 0, 2)
    np.testing.assert_allclose(target, [(x * y).sum(), z.sum(), (x + z).sum()], rtol=1e-13)
