"""The commands: each one small file that parses, calls and prints."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Callable
from pathlib import Path


class UsageError(ValueError):
    """Wrong arguments that argparse cannot see by itself."""


def add_overwrite(parser: argparse._ActionsContainer) -> None:
    """For :func:`replaced`."""
    parser.add_argument("--overwrite", action="store_true", help="replace an earlier result")


def replaced(args: argparse.Namespace, mark: str) -> Callable[[Path], None] | None:
    """What removes an earlier result from ``--out``, where that is wanted; every result has a file
    of the name ``mark``.

    Raises:
        ValueError: when what is there is something else.
    """
    out: Path = args.out
    if not args.overwrite or not out.is_dir() or not any(out.iterdir()):
        return None
    if not (out / mark).is_file():
        raise ValueError(f"{out} has no {mark}: it is no earlier result, and stays as it is")
    return _clear


def _clear(directory: Path) -> None:
    for path in directory.iterdir():
        if path.is_dir() and not path.is_symlink():
            if not path.name.startswith(".unfinished-"):
                shutil.rmtree(path)
        else:
            path.unlink()
