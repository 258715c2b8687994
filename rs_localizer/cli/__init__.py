# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The commands: each one small file that parses, calls and prints."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from rs_localizer.cli.options import UsageError
from rs_localizer.io.atomic_files import atomic_files, check_writable, content

# Bars are shown by one process. tqdm's own lock for several is a semaphore, of which Python 3.14
# says that it leaked when a signal ends the command.
tqdm.set_lock(threading.RLock())


def earlier_result(
    args: Any, mark: str, place: Path | None = None, names: Sequence[str] | None = None
) -> Sequence[str]:
    """Return names of an earlier result in a directory, which a new one is to replace.

    Args:
        mark: a file that each result has.
        place: of the result; None: ``--out``.
        names: names of the parts of a result; None: everything in the directory.

    Raises:
        ValueError: the directory must not be replaced, or is something else.
    """
    out: Path = place or args.out
    there = content(out)
    if not out.exists() or (out.is_dir() and not there):
        return ()
    if not args.overwrite:
        raise ValueError(f"{out} exists; choose another OUT, or --overwrite")
    if not (out / mark).is_file():
        raise ValueError(f"{out} has no {mark}: it is no earlier result, and stays as it is")
    return there if names is None else names


def refuse_existing(args: Any, *files: Path) -> None:
    """Raise ``ValueError`` if one of the files (default: ``--out``) exists and is to stay.

    So it does if the first cannot be written.
    """
    files = files or (args.out,)
    for path in files:
        if path.exists() and not args.overwrite:
            raise ValueError(f"{path} exists; choose another OUT, or --overwrite")
    check_writable(files[0])


def write_all(writers: Mapping[Path, Callable[[Path], object]]) -> None:
    """Write files, all at once or none, and say which."""
    next(iter(writers)).parent.mkdir(parents=True, exist_ok=True)
    with atomic_files(*writers) as parts:
        for part, write in zip(parts, writers.values(), strict=True):
            write(part)
    for path in writers:
        print(f"written: {path}")


def read_counts(text: str, option: str) -> tuple[int, int]:
    """Read columns and rows of ``6x4``; raise UsageError for anything else."""
    try:
        columns, rows = (int(word) for word in text.split("x"))
    except ValueError:
        columns = rows = 0
    if min(columns, rows) < 1:
        raise UsageError(f"{option} must be of the form 6x4, got {text!r}")
    return columns, rows


@contextmanager
def stage(name: str, total: int) -> Iterator[Callable[[int], object]]:
    """Show a progress bar to a person who waits, and none in a log; yield what counts."""
    with tqdm(total=total, desc=name, disable=None) as bar:
        yield bar.update


def typed(*words: str) -> str:
    """Return a command line of this program, to be pasted.

    After ``make`` it is not in PATH.
    """
    program, in_path = Path(sys.argv[0]), shutil.which("rs_localizer")
    if program.name != "rs_localizer":
        start = [sys.executable, "-m", "rs_localizer"]
    elif in_path is not None and program.samefile(in_path):
        start = ["rs_localizer"]
    else:
        start = [os.path.relpath(program)]
    return shlex.join([*start, *words])
