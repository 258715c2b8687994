"""Compiled kernels that nobody uses any more: each state of the sources has a folder of its own."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import shutil
import time
from pathlib import Path

_DAY = 86400.0
# Other versions, in other environments, may be at work beside this one.
_KEPT = 30.0 * _DAY
_OURS = re.compile(r"[0-9a-f]{16}")


@functools.cache
def mark(folder: Path) -> None:
    """Note that a folder is in use: by its time of change, once a day."""
    with contextlib.suppress(OSError):  # which is not ours to write
        if time.time() - folder.stat().st_mtime > _DAY:
            os.utime(folder)


@functools.cache
def remove_others(used: Path) -> None:
    """Remove the neighbours of a folder that have not been marked for a month.

    A process that still had one open compiles again what it has not loaded.
    """
    oldest = time.time() - _KEPT
    with contextlib.suppress(OSError):
        for folder in used.parent.iterdir():
            if folder != used and _is_ours(folder) and folder.stat().st_mtime < oldest:
                shutil.rmtree(folder, ignore_errors=True)


def _is_ours(folder: Path) -> bool:
    """Whether there are kernels of this package, and nothing else.

    ``NUMBA_CACHE_DIR`` is everybody's, and an empty folder may be anybody's.
    """
    if not _OURS.fullmatch(folder.name) or not folder.is_dir():
        return False
    names = [item.name for item in folder.iterdir()]
    return bool(names) and all(name.startswith("rs_localizer.") for name in names)
