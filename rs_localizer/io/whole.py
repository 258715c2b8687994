"""Results that appear whole or not at all, however their making ends."""

from __future__ import annotations

import contextlib
import shutil
from collections.abc import Iterator
from pathlib import Path


class OutputError(ValueError):
    """Results that could not be written; the message names the path and the fault."""


@contextlib.contextmanager
def whole(directory: Path) -> Iterator[Path]:
    """Within ``with``, make a directory; after an exception (Ctrl-C among them) it is gone.

    A directory that is there and empty, as interrupted programs leave them, is in nobody's way.

    Raises:
        OutputError: when the directory is there already, or the disk takes no more.
    """
    if directory.is_dir() and not any(directory.iterdir()):
        directory.rmdir()
    if directory.exists():
        raise OutputError(f"{directory} exists already; it is not overwritten")
    try:
        with told(directory):
            yield directory
    except BaseException:
        shutil.rmtree(directory, ignore_errors=True)
        raise


@contextlib.contextmanager
def whole_files(*files: Path) -> Iterator[None]:
    """Within ``with``, write these files; after an exception none of them is left.

    Raises:
        OutputError: when the disk takes no more, naming the first of them.
    """
    try:
        with told(files[0]):
            yield
    except BaseException:
        for file in files:
            with contextlib.suppress(OSError):
                file.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def told(path: Path) -> Iterator[None]:
    """Faults of the file system within ``with`` name the path.

    Writing to a full disk fails without saying which one.
    """
    try:
        yield
    except BrokenPipeError:  # of the screen, not of the disk
        raise
    except OSError as error:
        where = error.filename or path
        raise OutputError(f"{where} cannot be written: {error.strerror or error}") from error
