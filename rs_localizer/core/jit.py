"""How kernels of this package are compiled."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])

_jit = numba.njit(
    cache=True,
    nogil=True,
    # Without it every division is checked for zero, which stops vectorization.
    error_model="numpy",
    # NaN and infinity keep their meaning: they mark lanes and points without a solution.
    fastmath={"contract", "reassoc", "nsz", "arcp"},
)


def kernel(function: F) -> F:
    """Compile a function with Numba: cached on disk, without the GIL, NaN preserved."""
    compiled: F = _jit(function)
    return compiled
