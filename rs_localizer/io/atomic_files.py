# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Results that appear whole or not at all, however their making ends."""

import contextlib
import secrets
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM)
_UNFINISHED = ".unfinished-"
_unfinished: set[Path] = set()


class OutputError(ValueError):
    """Results that could not be written; the message names the path and the fault."""


@contextlib.contextmanager
def atomic_directory(
    directory: Path, replaced: Callable[[Path], object] | None = None
) -> Iterator[Path]:
    """Within ``with``, make a directory of the same name elsewhere, which then takes its place.

    One that is there and empty, as a mount point may be, is filled.

    Args:
        directory: its final place.
        replaced: removes an earlier result from a directory that is not empty.

    Raises:
        OutputError: when the directory is there already, or the disk takes no more.
    """
    exists = directory.exists()
    if exists and not (directory.is_dir() and (replaced or not any(directory.iterdir()))):
        raise OutputError(f"{directory} exists already; it is not overwritten")
    parent = directory if exists else directory.absolute().parent
    with contextlib.ExitStack() as stack:
        stack.enter_context(write_errors(directory))
        parent.mkdir(parents=True, exist_ok=True)
        built = stack.enter_context(_workplace(parent)) / directory.absolute().name
        with _renamed({built: directory}):
            yield built
        with _undisturbed():
            if not exists:
                built.rename(directory)
            else:
                if replaced:
                    replaced(directory)
                for item in built.iterdir():
                    item.rename(directory / item.name)


@contextlib.contextmanager
def atomic_files(*files: Path) -> Iterator[tuple[Path, ...]]:
    """Within ``with``, write to the paths that are yielded; those written then become the files.

    Raises:
        OutputError: when the disk takes no more, naming the first of them.
    """
    finals = [file.resolve() for file in files]
    # What is there and no file, such as /dev/stdout, is written to as it is.
    ordinary = [file for file in finals if file.is_file() or not file.exists()]
    with contextlib.ExitStack() as stack, write_errors(files[0]):
        workplaces = {
            parent: stack.enter_context(_workplace(parent))
            for parent in {file.parent for file in ordinary}
        }
        parts = {file: workplaces[file.parent] / file.name for file in ordinary}
        with _renamed(
            {parts[f]: file for f, file in zip(finals, files, strict=True) if f in parts}
        ):
            yield tuple(parts.get(file, file) for file in finals)
        with _undisturbed():
            for file, part in parts.items():
                if part.exists():
                    part.replace(file)


def check_writable(place: Path) -> None:
    """Refuse a place where nothing can be written, before the work whose result it shall have.

    Raises:
        OutputError: what writing there would raise.
    """
    target = place.absolute()
    above = next(path for path in target.parents if path.exists())
    with atomic_files(above / target.name):
        pass


def remove_unfinished() -> None:
    """Removal of what a process leaves that ends in the middle of its work."""
    for path in tuple(_unfinished):
        shutil.rmtree(path, ignore_errors=True)


@contextlib.contextmanager
def write_errors(path: Path) -> Iterator[None]:
    """Faults of the file system within ``with`` name the path.

    Writing to a full disk fails without saying which one.
    """
    try:
        yield
    except BrokenPipeError:  # of the screen, not of the disk
        raise
    except OSError as error:
        hidden = not error.filename or _UNFINISHED in str(error.filename)
        where = path if hidden else error.filename
        raise OutputError(f"{where} cannot be written: {error.strerror or error}") from error


@contextlib.contextmanager
def _workplace(parent: Path) -> Iterator[Path]:
    """Within ``with``, a directory beside the results."""
    path = parent / f"{_UNFINISHED}{secrets.token_hex(8)}"
    _unfinished.add(path)  # before it is there: a signal may come while it is made
    try:
        path.mkdir(mode=0o700)
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        _unfinished.discard(path)


@contextlib.contextmanager
def _renamed(names: dict[Path, Path]) -> Iterator[None]:
    """Within ``with``, faults name the final path."""
    try:
        yield
    except ValueError as error:
        text = str(error)
        for part, file in names.items():
            text = text.replace(str(part), str(file))
        if text == str(error):
            raise
        raise type(error)(text) from error


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Signals wait while several names change."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
