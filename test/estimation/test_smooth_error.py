# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Columns of errors that points share."""

import numpy as np
import pytest

from rs_localizer.estimation.projection import linearized
from rs_localizer.estimation.smooth_error import bend_of, smooth_columns, smooth_error

from .frames import frame


@pytest.mark.parametrize("bent", [False, True])
def test_combinations_of_columns_are_orthonormal_and_say_the_same(bent):
    observations, truth = frame(3, 0.05, 0.4, count=30)
    chosen = np.ones(30, bool)
    chosen[[4, 17]] = False
    lines = linearized(observations.packed, 30, truth, np.zeros((30, 6)))
    bend = bend_of(observations.points, chosen, 4.0 / 590.0) if bent else np.zeros((30, 0))
    shared = smooth_error(lines, chosen, bend, 0.2)
    columns = smooth_columns(lines.by_motion[chosen], lines.image[chosen], bend[chosen])
    columns = columns.reshape(56, -1)
    np.testing.assert_allclose(shared.rows.T @ shared.rows, np.eye(len(shared.squares)), atol=1e-9)
    most = shared.squares.max()
    np.testing.assert_allclose(
        (shared.rows * shared.squares) @ shared.rows.T, columns @ columns.T, atol=1e-3 * most
    )
    assert np.exp(shared.odds).sum() == pytest.approx(1.0)
    # The logarithm of the size is known with a deviation of one.
    assert np.diff(shared.odds) == pytest.approx(-0.5 * np.diff(np.log(shared.sizes / 0.2) ** 2))


def test_a_smooth_error_of_one_pixel_has_a_mean_square_of_one():
    """Over the image of a scene without depth, of u and of v."""
    observations, truth = frame(5, 0.0, 0.0, count=2000)
    lines = linearized(observations.packed, 2000, truth, np.zeros((2000, 6)))
    shared = smooth_error(lines, np.ones(2000, bool), np.zeros((2000, 0)), 1.0)
    assert 0.5 < np.sum(shared.squares) / 4000 < 2.0
