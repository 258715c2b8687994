# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Kernels run by Numba, after an edit and for the build, which compiles all of them.

If the native module fits the sources, nothing of this is imported. Machine code is kept in the
checkout, in a folder named by the digest of a kernel's file and of all files that it imports.
Without that digest Numba would run old code after a callee in another file has changed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import config, types
from numba.core.registry import CPUDispatcher

from rs_localizer.native import sources
from rs_localizer.native.declared import (
    ArrayOf,
    Declaration,
    Kind,
    Scalar,
    declaration,
    fits,
    refuse,
)

ENTRIES: dict[str, Any] = {}
"""All entries that have been declared so far, by name."""

_SCALARS = {"d": types.float64, "q": types.int64, "?": types.boolean}


class _CompiledKernel(CPUDispatcher):
    """A function that kernels call, and Python does not."""

    def __call__(self, *arguments: Any) -> Any:
        raise TypeError(uncallable(f"{self.__module__}.{self.__qualname__}"))


class _CompiledEntry(CPUDispatcher):
    """A kernel that Python calls: with what it declares, and nothing else."""

    # Declaration, also of an entry that was unpickled in another process.
    declared: Declaration | None = None
    native: Callable[..., Any] | None = None

    def __call__(self, *arguments: Any) -> Any:
        if self.native is not None:
            return self.native(*arguments)
        # Classes that annotations name may come later in a module than the entry.
        if self.declared is None:
            self.declared = declaration(self.py_func)
        if not fits(self.declared, arguments):
            refuse(self.declared, arguments)
        return super().__call__(*map(_writable, arguments))


def uncallable(name: str) -> str:
    """Return a function that refuses the call of a kernel that is no entry."""
    return f"{name} is called by kernels alone; Python calls what is declared as @entry"


def _writable(argument: Any) -> Any:
    """Copy the read-only arrays of an argument, which are of another type to Numba."""
    if isinstance(argument, tuple):
        parts = [_writable(part) for part in argument]
        return argument._make(parts) if hasattr(argument, "_make") else tuple(parts)
    if isinstance(argument, np.ndarray) and not argument.flags.writeable:
        return argument.copy()
    return argument


def numba_type(kind: Kind) -> Any:
    """Return Numba's type of what an entry declares."""
    if isinstance(kind, Scalar):
        return _SCALARS[kind.code]
    if isinstance(kind, ArrayOf):
        return types.Array(numba.from_dtype(np.dtype(kind.element)), kind.dimensions, "C")
    return types.BaseTuple.from_types(tuple(map(numba_type, kind.fields)), kind.kind)


def signature(declared: Declaration) -> tuple[Any, ...]:
    """Return Numba's types of an entry's arguments."""
    return tuple(map(numba_type, declared.arguments.values()))


def compiled(function: Callable[..., Any], inline: bool, is_built: bool) -> Any:
    """Return a kernel for Numba.

    Args:
        inline: compiled as a part of the kernel that calls it.
        is_built: for the build, which makes its own way from Python to the machine code.
    """
    made = numba.njit(
        nogil=True,
        inline="always" if inline else "never",
        no_cfunc_wrapper=True,
        no_cpython_wrapper=is_built,
        # Without it every division is checked for zero, which stops vectorization.
        error_model="numpy",
        # NaN and infinity keep their meaning: they mark lanes and points without a solution.
        fastmath={"contract", "reassoc", "nsz", "arcp"},
    )(function)
    template = made.get_call_template
    # Numba would compile a callee for every constant among its arguments, as often with all that
    # it calls.
    made.get_call_template = lambda positional, named: template(
        tuple(map(types.unliteral, positional)),
        {name: types.unliteral(kind) for name, kind in named.items()},
    )
    made.__class__ = _CompiledKernel
    path = sources.path_of_ours(function.__module__)
    if not is_built and path is not None and str(path) == function.__code__.co_filename:
        kept = sources.PACKAGE.parent / ".kernels" / sources.digest(function.__module__)[:16]
        before, config.CACHE_DIR = config.CACHE_DIR, str(kept)
        made.enable_caching()
        config.CACHE_DIR = before
    return made


def entry(function: Callable[..., Any], is_built: bool, native: Any) -> Any:
    """Return an entry for Numba; ``native`` is what Python calls instead where it fits."""
    made = compiled(function, False, is_built)
    made.__class__, made.declared, made.native = _CompiledEntry, None, native
    ENTRIES[f"{function.__module__}.{function.__qualname__}"] = made
    return made
