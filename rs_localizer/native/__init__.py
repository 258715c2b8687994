# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Kernels: Python functions that are compiled when the package is built.

``@entry`` declares what Python calls, ``@kernel`` what other kernels call, ``@inlined`` what
becomes a part of the one kernel that calls it. An installed package has one native module for each
level of the processor (:mod:`rs_localizer.native.levels`) and needs no compiler. In a checkout a
module counts only where it was built from the sources that are there: what has been edited since is
compiled by Numba (:mod:`rs_localizer.native.jit`).
"""

from __future__ import annotations

import importlib
import importlib.util
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

from rs_localizer.native import declared, levels

F = TypeVar("F", bound=Callable[..., Any])

HOW_TO_BUILD = "python -m rs_localizer.native.build"
_MODE = "RS_LOCALIZER_KERNELS"
"""Environment: ``numba`` has Numba run all kernels, ``build`` is for the build."""


class _Kernel:
    """A function that kernels call, in a process that does not compile."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __call__(self, *arguments: object) -> None:
        raise TypeError(
            f"{self._name} is called by kernels alone; Python calls what is declared as @entry"
        )


def _edited(level: str) -> frozenset[str]:
    """Return the modules whose sources differ from those that the native module was built from.

    An installed package has no record of its sources, and trusts its module.
    """
    record = levels.record_of(level)
    if not record.is_file():
        return frozenset()
    from rs_localizer.native import sources

    built = json.loads(record.read_text())
    if all(
        (sources.PACKAGE / name).is_file() and sources.digest_of_file(sources.PACKAGE / name) == it
        for name, it in built["files"].items()
    ):
        return frozenset()
    now = sources.digests()
    return frozenset(name for name in now if now[name] != built["modules"].get(name))


def _load() -> tuple[Any, frozenset[str], bool]:
    """Return the native module, the modules that do not fit it, and whether Numba compiles them.

    Raises:
        ImportError: neither is there; the text says what to type.
    """
    if os.environ.get(_MODE) in ("numba", "build"):
        return None, frozenset(), True
    has_numba = importlib.util.find_spec("numba") is not None
    level = levels.choose_level()
    if level is None:
        if has_numba and Path(__file__).with_name("jit.py").is_file():
            return None, frozenset(), True
        raise ImportError(f"the kernels of rs_localizer are not built: {HOW_TO_BUILD}")
    module = importlib.import_module(f"{__name__}.{levels.name_of(level)}")
    edited = _edited(level)
    if edited and not has_numba:
        raise ImportError(f"{min(edited)} was edited after its kernels were built: {HOW_TO_BUILD}")
    return module, edited, bool(edited)


# The build imports this package before there is anything to load: who declares an entry is told.
_fault = ""
try:
    _module, EDITED, COMPILES = _load()
except ImportError as error:
    _module, EDITED, COMPILES, _fault = None, frozenset(), False, str(error)

IS_BUILT = os.environ.get(_MODE) == "build"
LEVEL: str | None = None if _module is None else _module.LEVEL
"""The level of the native module in use; None: Numba compiles all kernels."""


def bound(name: str) -> Any:
    """Return the native entry of that name, whose method ``call`` runs it; for unpickling."""
    return _module.bound(name)


def entry(function: F) -> F:
    """Declare a kernel that Python calls; its annotations say with what."""
    if _fault:
        raise ImportError(_fault)
    name, native = f"{function.__module__}.{function.__qualname__}", None
    if _module is not None and function.__module__ not in EDITED:
        native = bound(name).call
        declared.FUNCTIONS[name] = function
    if not COMPILES:
        return cast(F, native)
    from rs_localizer.native import jit

    return cast(F, jit.entry(function, IS_BUILT, native))


def kernel(function: F) -> F:
    """Declare a function that kernels call."""
    return _declared(function, inline=False)


def inlined(function: F) -> F:
    """Declare a function that is compiled as a part of the kernel that calls it, at one place.

    By itself it would be compiled and optimized twice, once for nobody.
    """
    return _declared(function, inline=True)


def _declared(function: F, inline: bool) -> F:
    if not COMPILES:
        return cast(F, _Kernel(f"{function.__module__}.{function.__qualname__}"))
    from rs_localizer.native import jit

    return cast(F, jit.compiled(function, inline, IS_BUILT))
