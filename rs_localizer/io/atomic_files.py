# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Results that appear whole or not at all, however their making ends.

Results are made in a workplace: a hidden folder beside them, or within an existing folder, which
may be a mount point that nobody can rename. When they are whole and on the disk, a journal in the
workplace lists the names that change, and then the names change. A process holds a lock on its
workplace. A workplace without a lock belongs to a dead process: :func:`resume` finishes the changes
of its journal, and removes it.
"""

import contextlib
import errno
import fcntl
import json
import os
import secrets
import shutil
import signal
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGALRM)
_UNFINISHED = ".unfinished-"
# Files of a workplace beside the results: the journal, the earlier results, the lock.
_JOURNAL, _OLD, _LOCK = ".journal", ".old", ".lock"
# A disk of its own (ext4) has this from the start.
_OF_DISK = "lost+found"
# Answers of a file system that has no locks, or of one that syncs no folders.
_UNSUPPORTED = (errno.ENOSYS, errno.EOPNOTSUPP, errno.ENOLCK, errno.EINVAL, errno.EBADF)
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
        for place in (final.parent, final):
            resume(place)
        exists = final.exists()
        if exists and not (final.is_dir() and (earlier or not content(final))):
            raise OutputError(f"{directory} exists already; it is not overwritten")
        parent = final if exists else final.parent
        parent.mkdir(parents=True, exist_ok=True)
        with _workplace(parent) as work:
            built = work / final.name
            with _renamed({built: directory}):
                yield built
            if exists:
                _commit(work, final.name, sorted(path.name for path in built.iterdir()), earlier)
            else:
                _commit(work, "", [final.name])


@contextlib.contextmanager
def atomic_files(*files: Path) -> Iterator[tuple[Path, ...]]:
    """Yield paths to write to within the context; the written ones then become the files.

    All files of a folder change together.

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
            _commit(work, "", [part.name for part in parts.values() if part.parent == work])


def content(directory: Path) -> list[str]:
    """Return the names in a directory; none if it is not there.

    Workplaces do not count, nor does what each disk has.
    """
    if not directory.is_dir():
        return []
    names = sorted(path.name for path in directory.iterdir())
    return [name for name in names if not name.startswith(_UNFINISHED) and name != _OF_DISK]


def resume(folder: Path) -> bool:
    """Finish what dead processes left in a folder, or remove it if it is not whole.

    Returns:
        Whether another process is at work in the folder.

    Raises:
        OSError: when a name cannot be changed that a journal asks for.
    """
    busy = False
    for work in _workplaces(folder):
        try:
            lock = _lock(work, wait=(work / _JOURNAL).exists())
        except BlockingIOError:
            busy = True
            continue
        except OSError:  # it has gone, or the disk has no locks or cannot be written: it stays
            continue
        try:
            _change_names(work)
            shutil.rmtree(work, ignore_errors=True)
        finally:
            os.close(lock)
    return busy


def resume_results(paths: Iterable[Path]) -> None:
    """Finish what dead processes were replacing at some paths, before these are read."""
    for folder in {place for path in paths for place in (path, path.absolute().parent)}:
        if any((work / _JOURNAL).exists() for work in _workplaces(folder)):
            resume(folder)


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
    """Remove what a process has left that ended in the middle of its work."""
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


# -- workplaces -------------------------------------------------------------------------------


@contextlib.contextmanager
def _workplace(parent: Path) -> Iterator[Path]:
    """Lock a directory beside the results for the context, and yield it."""
    resume(parent)
    work, lock = parent / f"{_UNFINISHED}{secrets.token_hex(8)}", None
    _unfinished.add(work)  # before it is there: a signal may come while it is made
    try:
        while lock is None:
            work.mkdir(mode=0o700, exist_ok=True)
            # Until it is locked, others take it for a dead process's, and remove it.
            with contextlib.suppress(FileNotFoundError):
                lock = _lock(work, wait=True)
        yield work
    finally:
        if not (work / _JOURNAL).exists():  # else the next command goes on with it
            shutil.rmtree(work, ignore_errors=True)
        _unfinished.discard(work)
        if lock is not None:
            os.close(lock)


def _workplaces(folder: Path) -> list[Path]:
    """Return the workplaces of this user in a folder; other users' are left alone."""
    try:
        with os.scandir(folder) as items:
            found = [
                item.path
                for item in items
                if item.name.startswith(_UNFINISHED)
                and item.is_dir(follow_symlinks=False)
                and item.stat(follow_symlinks=False).st_uid == os.geteuid()
            ]
    except OSError:  # a file, or a folder that is not there or may not be listed
        return []
    return [Path(path) for path in sorted(found)]


def _lock(work: Path, wait: bool) -> int:
    """Lock a workplace, until the descriptor that is returned is closed or the process dies.

    Args:
        wait: for the end of another process that holds it; also, do without where there are none.

    Raises:
        BlockingIOError: another process holds it.
        FileNotFoundError: it has gone.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
    lock = os.open(work / _LOCK, flags, 0o600)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except OSError as error:
            if not wait or error.errno not in _UNSUPPORTED:
                raise
        # Its last owner may have removed it.
        if not os.path.samestat(os.fstat(lock), os.stat(work / _LOCK)):
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(work))
    except BaseException:
        os.close(lock)
        raise
    return lock


# -- names ------------------------------------------------------------------------------------


def _commit(work: Path, folder: str, names: Sequence[str], earlier: Sequence[str] = ()) -> None:
    """Give the finished results their names.

    Args:
        work: the workplace, beside which the names are.
        folder: of the results, in the workplace; empty: itself.
        names: of the results.
        earlier: names that go.
    """
    names = [name for name in names if (work / folder / name).exists()]
    if not names and not earlier:
        return
    (work / _OLD).mkdir()
    _sync(work)
    journal = json.dumps({"folder": folder, "names": names, "earlier": list(earlier)})
    with _undisturbed():
        _unfinished.discard(work)
        _write_journal(work, journal)
        try:
            _change_names(work)
        except OSError:
            _change_back(work)
            raise
        _unfinished.add(work)


def _write_journal(work: Path, text: str) -> None:
    part = work / f"{_JOURNAL}.part"
    part.write_text(text, encoding="utf-8")
    _sync(part)
    os.rename(part, work / _JOURNAL)
    _sync_folders(work, work.parent)


def _read_journal(work: Path) -> tuple[Path, list[str], list[str]] | None:
    """Return the folder of the results, their names, and the names that go; None without journal.

    One that would reach beyond the folder of its workplace is none: an archive may have brought it.
    """
    try:
        said = json.loads((work / _JOURNAL).read_text(encoding="utf-8"))
        folder, names, earlier = said["folder"], said["names"], said["earlier"]
        said_names = (*names, *earlier, *([folder] if folder else []))
        inside = all(Path(name).name == name not in ("", "..") for name in said_names)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    source = work / folder
    if not inside or source.is_symlink() or (work / _OLD).is_symlink():
        return None
    return source, names, earlier


def _change_names(work: Path) -> None:
    """Change all names that the journal asks for and that have not changed yet."""
    if (journal := _read_journal(work)) is None:
        return
    source, names, earlier = journal
    for name in earlier:
        if os.path.lexists(work.parent / name) and not os.path.lexists(work / _OLD / name):
            os.rename(work.parent / name, work / _OLD / name)
    for name in names:
        if os.path.lexists(source / name):
            os.rename(source / name, work.parent / name)
    _sync_folders(work.parent, source, work / _OLD)
    # Without its journal, what is in the workplace may go in any order.
    os.unlink(work / _JOURNAL)
    _sync_folders(work)


def _change_back(work: Path) -> None:
    """Undo the changes of names; a file that took the place of another stays."""
    if (journal := _read_journal(work)) is None:
        return
    source, names, earlier = journal
    for name in names if earlier else ():
        if not os.path.lexists(source / name):
            os.rename(work.parent / name, source / name)
    for name in earlier:
        if os.path.lexists(work / _OLD / name):
            os.rename(work / _OLD / name, work.parent / name)
    os.unlink(work / _JOURNAL)


def _sync(path: Path) -> None:
    """Write a file, or a folder with all that is in it, to the disk."""
    if path.is_symlink():
        return
    if path.is_dir():
        for inner in path.iterdir():
            _sync(inner)
        _sync_folders(path)
        return
    with path.open("rb") as file:
        os.fsync(file.fileno())


def _sync_folders(*folders: Path) -> None:
    """Write the names in folders to the disk, if the file system can do it."""
    for folder in folders:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            os.fsync(descriptor)
        except OSError as error:
            if error.errno not in _UNSUPPORTED:
                raise
        finally:
            os.close(descriptor)


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


@contextlib.contextmanager
def _undisturbed() -> Iterator[None]:
    """Delay signals within the context, while several names change."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
