# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Student's t by a series, against SciPy's."""

import math

import pytest
from scipy.special import stdtrit

from rs_localizer.pipeline.readout_estimate import student_quantile


@pytest.mark.parametrize("chance", [3.2e-5, 1e-6])
@pytest.mark.parametrize("freedom", [0.05, 0.3, 1.0, 2.5, 5.0, 20.0, 200.0, 10_000.0])
def test_numbers_that_student_s_t_seldom_exceeds_are_those_of_scipy(freedom, chance):
    expected = -stdtrit(freedom, chance)
    assert student_quantile(freedom, chance) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("freedom", [0.0, 1e-4])
def test_where_nothing_is_known_no_number_is_large(freedom):
    assert student_quantile(freedom, 3.2e-5) == math.inf
