# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""One thread for linear algebra.

The OpenBLAS of SciPy 1.11 wakes a thread per core for systems of 12 unknowns: a camera of 60 Hz and
500 points then takes 150 % of a core instead of 17 %.
"""

import os

_VARIABLES = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")


def limit() -> None:
    """Let BLAS use one thread, unless the user has said how many; before NumPy is imported.

    Only programs call this: in a library it is not ours to decide.
    """
    for name in _VARIABLES:
        os.environ.setdefault(name, "1")
