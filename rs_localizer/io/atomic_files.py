# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Results that appear whole or not at all.

Results are made in a workplace: a hidden folder beside them, or within an existing folder, which
may be a mount point that nobody can rename. When they are whole and on the disk, the names change.
A process that is killed leaves its workplace, which blocks nothing; killed while the names change,
it leaves earlier results in the workplace's folder ``.old``.
"""

import contextlib
import os
import secrets
import shutil
import signal
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_UNFINISHED = ".unfinished-"
_OLD = ".old"  # of a workplace, for earlier results
# A disk of its own (ext4) has this from the start.
_OF_DISK = "lost+found"
_unfinished: set[Path] = set()


class OutputError(ValueError):
    """Results that could not be written; the message names the path and the fault."""


@contextlib.contextmanager
def atomic_directory(directory: Path, earlier: Iterable[str] = ()) -> Iterator[Path]:
    """Make a directory elsewhere within the context, which then takes the place of the old one.

    One that is there and empty, as a mount point may be, is filled.

    Args:
        directory: its final place.
        earlier: names in it that belong to an earlier result, which goes when the new one is whole.

    Raises:
        OutputError: when the directory is there already, or the disk takes no more.
    """
    final, earlier = Path(os.path.abspath(directory)), tuple(earlier)
    with write_errors(directory):
        exists = final.exists()
        if exists and not (final.is_dir() and (earlier or not content(final))):
            raise OutputError(f"{directory} exists already; it is not overwritten")
        parent = final if exists else final.parent
        parent.mkdir(parents=True, exist_ok=True)
        with _workplace(parent) as work:
            built = work / final.name
            with _renamed({built: directory}):
                yield built
            _commit(work, sorted(built.iterdir()) if exists else [built], earlier)


@contextlib.contextmanager
def atomic_files(*files: Path) -> Iterator[tuple[Path, ...]]:
    """Yield paths to write to within the context; the written ones then become the files.

    Raises:
        OutputError: when the disk takes no more, naming the first of them.
    """
    finals = [file.resolve() for file in files]
    # An existing path that is no file, such as /dev/stdout, is written to directly.
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
        for work in workplaces.values():
            _commit(work, [part for part in parts.values() if part.parent == work])


def content(directory: Path) -> list[str]:
    """Return the names in a directory; none if it is not there.

    Workplaces do not count, nor does what each disk has.
    """
    if not directory.is_dir():
        return []
    names = sorted(path.name for path in directory.iterdir())
    return [name for name in names if not name.startswith(_UNFINISHED) and name != _OF_DISK]


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
    """Remove what this process has not finished."""
    for path in tuple(_unfinished):
        shutil.rmtree(path, ignore_errors=True)


@contextlib.contextmanager
def write_errors(path: Path) -> Iterator[None]:
    """Name the path in faults of the file system within the context.

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
    """Make a directory beside the results for the context, and yield it."""
    work = parent / f"{_UNFINISHED}{secrets.token_hex(8)}"
    _unfinished.add(work)  # before it is there: a signal may come while it is made
    try:
        work.mkdir(mode=0o700)
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)
        _unfinished.discard(work)


def _commit(work: Path, made: Sequence[Path], earlier: Sequence[str] = ()) -> None:
    """Give the finished results their names.

    Args:
        work: the workplace, beside which the names are.
        made: results in it; those that are missing were not written.
        earlier: names that go.
    """
    made = [path for path in made if path.exists()]
    for file in (file for path in made for file in (path, *path.rglob("*"))):
        if file.is_file() and not file.is_symlink():
            with file.open("rb") as data:
                os.fsync(data.fileno())  # a power failure may follow
    folder, old, changed = work.parent, work / _OLD, list[tuple[Path, Path]]()
    old.mkdir()
    moves = [(folder / name, old / name) for name in earlier if os.path.lexists(folder / name)]
    # No signal comes while several names change.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        for source, target in (*moves, *((path, folder / path.name) for path in made)):
            os.rename(source, target)
            changed.append((source, target))
    except OSError:
        # Without earlier names, a file took the place of another, and stays.
        for source, target in reversed(changed if earlier else []):
            os.rename(target, source)
        raise
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _renamed(names: dict[Path, Path]) -> Iterator[None]:
    """Name the final path in faults within the context."""
    try:
        yield
    except ValueError as error:
        text = str(error)
        for part, file in names.items():
            text = text.replace(str(part), str(file))
        if text == str(error):
            raise
        raise type(error)(text) from error
