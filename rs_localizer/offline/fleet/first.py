"""The first process on a machine compiles the kernels for all others, which wait for it.

As many processes that compile at once take as much longer; and kernels that two of them compile at
once may round differently.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

import numba
from llvmlite import binding

from rs_localizer.core.simd.jit import cache_directory
from rs_localizer.offline.fleet.identity import program


@contextlib.contextmanager
def alone_until_compiled(kernels: str) -> Iterator[bool]:
    """Within ``with``, no other process of this machine is, unless one has been through.

    Args:
        kernels: names what is compiled within.

    Returns:
        whether this is the first one.
    """
    folder = cache_directory() / "fleet"
    done = folder / _name(kernels)
    lock = None if done.exists() else _locked(done)
    try:
        yield lock is not None
        if lock is not None:
            with contextlib.suppress(OSError):
                done.touch()
    finally:
        if lock is not None:
            lock.close()


def _name(kernels: str) -> str:
    config: Any = numba.config
    cpu = config.CPU_NAME or binding.get_host_cpu_name()
    # Numba takes no machine code of another version of itself or of Python.
    compiler = f"{numba.__version__} {sys.implementation.cache_tag}"
    said = f"{program()} {kernels} {compiler} {cpu}"
    return hashlib.sha256(said.encode()).hexdigest()[:16]


def _locked(done: Path) -> IO[str] | None:
    """A lock that goes with the process, however it ends; None: nobody needs to wait (any more)."""
    try:
        done.parent.mkdir(parents=True, exist_ok=True)
        lock = done.with_suffix(".lock").open("w")
        fcntl.flock(lock, fcntl.LOCK_EX)
    except OSError:  # nothing can be kept there: each process compiles for itself
        return None
    if done.exists():
        lock.close()
        return None
    return lock
