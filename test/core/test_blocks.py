# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rs_localizer.core.blocks import median


@given(
    st.lists(st.one_of(st.floats(allow_nan=False), st.sampled_from([0.0, 1.0, 2.0])), max_size=40)
)
def test_the_median_is_where_sorting_puts_it(as_python, values):
    array = np.array(values, float)
    expected = np.sort(array)[len(array) // 2] if len(array) else np.nan
    np.testing.assert_array_equal(as_python(median)(array), expected)
    np.testing.assert_array_equal(array, values)
