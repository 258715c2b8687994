# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Products with a clipped matrix: as by LAPACK's eigenvectors."""

import numpy as np
import pytest

from rs_localizer.inertial.filter import clipped_product


@pytest.mark.parametrize("size", [1, 2, 3, 18])
@pytest.mark.parametrize("kind", ["any", "equal", "repeated", "scales", "diagonal"])
def test_eigenvalues_beyond_the_limit_are_clipped(size, kind):
    rng = np.random.default_rng(size)
    vectors = np.linalg.qr(rng.normal(size=(size, size)))[0]
    if kind == "diagonal":
        vectors = np.eye(size)
    values = {
        "equal": np.ones(size),
        "repeated": np.round(rng.normal(0.0, 2.0, size)),
        "scales": 10.0 ** rng.uniform(-12.0, 3.0, size),
    }.get(kind, rng.normal(0.0, 2.0, size))
    columns = rng.normal(size=(size, 4))
    expected = (vectors * np.minimum(values, 0.5)) @ vectors.T @ columns
    found = clipped_product((vectors * values) @ vectors.T, 0.5, columns)
    np.testing.assert_allclose(found, expected, atol=1e-13 * max(1.0, np.abs(values).max()))
