"""How kernels of this package are compiled and where the machine code is kept."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, cast

import numba

F = TypeVar("F", bound=Callable[..., Any])

_CONFIG: Any = numba.config


def _cache_directory() -> str | None:
    """A folder of the user's cache that belongs to exactly these sources; None if unwritable.

    Numba notices a change of the file that holds a kernel, not of what the kernel calls in other
    files; after an update it would run the old code. Hence one folder per state of the sources.
    """
    package = Path(__file__).resolve().parent.parent
    digest = hashlib.sha256()
    for folder in ("core", "solvers"):
        for file in sorted((package / folder).glob("*.py")):
            digest.update(file.read_bytes())
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    base = Path(_CONFIG.CACHE_DIR or Path(home) / "rs_localizer")
    directory = base / digest.hexdigest()[:16]
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError:
        return None
    return str(directory) if os.access(directory, os.W_OK) else None


_CACHE_DIRECTORY = _cache_directory()


def kernel(function: F) -> F:
    """Compile a function with Numba: cached on disk, without the GIL, NaN preserved."""
    users_directory = _CONFIG.CACHE_DIR
    _CONFIG.CACHE_DIR = _CACHE_DIRECTORY or users_directory
    try:
        compiled: Any = numba.njit(
            cache=_CACHE_DIRECTORY is not None,
            nogil=True,
            # Without it every division is checked for zero, which stops vectorization.
            error_model="numpy",
            # NaN and infinity keep their meaning: they mark lanes and points without a solution.
            fastmath={"contract", "reassoc", "nsz", "arcp"},
        )(function)
    finally:
        _CONFIG.CACHE_DIR = users_directory
    return cast(F, compiled)
