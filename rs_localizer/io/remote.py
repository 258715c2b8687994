# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Files in other places, by the URLs that fsspec opens (``s3://``, ``gs://``, ``memory://``).

A reader of bags jumps about in its file: what is elsewhere is fetched whole before it is read.
"""

import contextlib
import re
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeGuard

from rs_localizer.io.atomic_files import atomic_files, write_errors

Location = Path | str
"""A path of this machine, or a URL."""

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")


class RemoteError(ValueError):
    """A URL that cannot be read or written; the message names it and the fault."""


def is_url(place: Location) -> TypeGuard[str]:
    """Whether it is a URL, and no path of this machine."""
    return isinstance(place, str) and _SCHEME.match(place) is not None


def location(text: str) -> Location:
    """What a user has written, for ``add_argument(type=...)``: a Path would merge the slashes."""
    return text if is_url(text) else Path(text)


def url_name(url: str) -> str:
    """The last part of a URL."""
    return url.partition("://")[2].rstrip("/").rpartition("/")[2]


@contextlib.contextmanager
def local_copy(place: Location) -> Iterator[Path]:
    """Within ``with``, a path of this machine with the content of a place.

    Raises:
        RemoteError: for a URL that cannot be read.
        ImportError: without fsspec, for a URL.
    """
    if not is_url(place):
        yield Path(place)
        return
    with tempfile.TemporaryDirectory(prefix="rs_localizer-") as folder:
        copy = Path(folder) / (url_name(place) or "root")
        with _faults(place, "read"):
            files, path = _filesystem(place)
            files.get(path, str(copy), recursive=bool(files.isdir(path)))
        yield copy


@contextlib.contextmanager
def placed(place: Location) -> Iterator[Path]:
    """Within ``with``, write a file to the path that is yielded; then it is put to its place.

    Raises:
        OutputError: when the disk takes no more.
        RemoteError: for a URL that cannot be written.
        ImportError: without fsspec, for a URL.
    """
    if not is_url(place):
        target = Path(place)
        with write_errors(target):
            target.parent.mkdir(parents=True, exist_ok=True)
        with atomic_files(target) as (part,):
            yield part
        return
    with tempfile.TemporaryDirectory(prefix="rs_localizer-") as folder:
        part = Path(folder) / "file"
        yield part
        with _faults(place, "written"):
            files, path = _filesystem(place)
            files.put_file(str(part), path)


def check_writable(place: Location) -> None:
    """Refuse a place where nothing can be written, before the work whose result it shall have.

    Raises:
        OutputError, RemoteError: what writing there would raise.
        ImportError: without fsspec, for a URL.
    """
    if is_url(place):
        with _faults(place, "written"):
            _filesystem(place)
        return
    target = Path(place).absolute()
    above = next(path for path in target.parents if path.exists())
    with atomic_files(above / target.name):
        pass


@contextlib.contextmanager
def placed_beside(url: str) -> Iterator[Path]:
    """Within ``with``, make a result at the path that is yielded; at the end it goes to its place.

    So does all that stands beside it. What is there already is never replaced.

    Raises:
        RemoteError: for a URL that cannot be written, or where something is.
        ImportError: without fsspec.
    """
    with tempfile.TemporaryDirectory(prefix="rs_localizer-") as folder:
        with _faults(url, "written"):
            files, path = _filesystem(url.rstrip("/"))
            if files.exists(path):
                raise RemoteError("something is there already; choose another place")
        yield Path(folder) / url_name(url)
        with _faults(url, "written"):
            above = path.rpartition("/")[0]
            for part in Path(folder).iterdir():
                files.put(str(part), f"{above}/{part.name}", recursive=part.is_dir())


def fingerprint(url: str) -> str:
    """By what a file or a folder elsewhere is known again: fsspec's digest of name, size, time.

    Raises:
        RemoteError: for a URL that cannot be read.
        ImportError: without fsspec.
    """
    with _faults(url, "read"):
        files, path = _filesystem(url)
        paths = sorted(files.find(path)) or [path]
        return " ".join(str(files.ukey(file)) for file in paths)


def _filesystem(url: str) -> tuple[Any, str]:
    from fsspec.core import url_to_fs

    files, path = url_to_fs(url)
    return files, str(path)


@contextlib.contextmanager
def _faults(url: str, done: str) -> Iterator[None]:
    """Faults within ``with``, of whichever file system, name the URL."""
    try:
        yield
    except ModuleNotFoundError as error:
        if error.name == "fsspec":
            raise
        raise RemoteError(f"{url} cannot be {done}: {error}") from error
    except Exception as error:
        # Each file system raises errors of its own.
        reason = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, FileNotFoundError):
            reason = "it does not exist"
        raise RemoteError(f"{url} cannot be {done}: {reason}") from error
