# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Levels of processors, by NumPy's names, and the native module that fits this one.

``RS_LOCALIZER_LEVEL`` caps the level, so that machines of one fleet compute the same bits.
"""

from __future__ import annotations

import os
import platform
from importlib import import_module
from pathlib import Path

LEVELS = {"x86_64": ("v2", "v3", "v4"), "aarch64": ("generic",)}
"""By the machine, from the one that each has to the one that few have."""
CAP = "RS_LOCALIZER_LEVEL"
_FOLDER = Path(__file__).parent
_SUFFIX = ".abi3.so"


def name_of(level: str) -> str:
    """Return the name of the native module of a level."""
    return f"_kernels_{level}"


def file_of(level: str) -> Path:
    """Return the file of the native module of a level."""
    return _FOLDER / f"{name_of(level)}{_SUFFIX}"


def record_of(level: str) -> Path:
    """Return the file that says which sources a module was built from."""
    return _FOLDER / f"{name_of(level)}.json"


def of_machine() -> str:
    """Return the highest level that this processor and this operating system run.

    Raises:
        ImportError: a processor that no level is for.
    """
    machine = platform.machine()
    if machine not in LEVELS:
        raise ImportError(f"rs_localizer has kernels for {', '.join(LEVELS)}, not for {machine}")
    if len(LEVELS[machine]) == 1:
        return LEVELS[machine][0]
    # Compiled for any processor of the kind: this one may know none of the instructions.
    level: str = import_module("rs_localizer.native._cpu").level()
    if level not in LEVELS[machine]:
        raise ImportError(
            "the kernels of rs_localizer need x86-64-v2 (SSE 4.2), which this processor lacks"
        )
    return level


def choose_level() -> str | None:
    """Return the level of the native module to load; None: none has been built.

    Raises:
        ImportError: a cap that is no level, that this machine lacks, or that was not built.
    """
    cap, built = os.environ.get(CAP, ""), list(_FOLDER.glob(f"_kernels_*{_SUFFIX}"))
    if not built:
        return None
    known = LEVELS.get(platform.machine(), ())
    if cap and cap not in known:
        raise ImportError(f"{CAP} is {cap!r}; this machine's levels are {', '.join(known)}")
    most = of_machine()
    if cap and known.index(cap) > known.index(most):
        raise ImportError(f"{CAP} is {cap!r}, but this processor runs {most} at most")
    runs = known[: known.index(cap or most) + 1]
    if cap and not file_of(cap).is_file():
        raise ImportError(f"{CAP} is {cap!r}, but that level has not been built")
    return next((level for level in reversed(runs) if file_of(level).is_file()), None)
