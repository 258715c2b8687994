# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Beginning of every program: signals, threads, arguments, and what is not installed."""

import os

_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS")


def limit_threads() -> None:
    """Let BLAS use one thread, whatever the user has said; before NumPy is imported.

    How many there are changes the last bits of poses. The OpenBLAS of SciPy 1.11 wakes a thread per
    core for systems of 12 unknowns: a camera of 60 Hz and 500 points then takes 150 % of a core
    instead of 17 %. Only programs call this: in a library it is not ours to decide.
    """
    for name in _THREADS:
        os.environ[name] = "1"
