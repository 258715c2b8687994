"""What a result depends on, so that it is known again: recording, settings, program."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

MARKER = "fleet.json"
"""Written last into a result's folder: it is complete, and of what."""

_PACKAGE = Path(__file__).parents[2]


@functools.cache
def program() -> str:
    """A digest of the sources of this package, its version among them."""
    found = hashlib.sha256()
    for file in sorted(_PACKAGE.rglob("*.py")):
        found.update(file.relative_to(_PACKAGE).as_posix().encode())
        found.update(file.read_bytes())
    return found.hexdigest()[:16]


def identity(command: str, settings: Mapping[str, Any], inputs: Sequence[Path]) -> str:
    """A digest of all that decides what a result is.

    Args:
        command: what is done with the recording.
        settings: how, as text can say it.
        inputs: the recording and all other files that are read; known by the names, sizes and
            times of what is in them, since reading all of a recording takes long.
    """
    said = json.dumps(
        [program(), command, settings, [_fingerprint(path) for path in inputs]],
        sort_keys=True,
        default=str,
    )
    return hashlib.sha256(said.encode()).hexdigest()


def _fingerprint(path: Path) -> list[tuple[str, int, int]]:
    """Name below the path, size and time of change (ns) of each file; of nothing, nothing."""
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    found = []
    for file in files:
        if file.is_file():
            about = file.stat()
            name = file.relative_to(path).as_posix()
            found.append((name, about.st_size, about.st_mtime_ns))
    return found


def write_marker(
    folder: Path, of: str, about: Mapping[str, Any], figures: Mapping[str, Any]
) -> None:
    """Say of a result's folder that it is complete.

    Args:
        folder: the result's.
        of: its :func:`identity`.
        about: what readers want to know of its making.
        figures: of the summary.
    """
    text = json.dumps({"identity": of, **about, "figures": figures}, indent=2, default=str)
    (folder / MARKER).write_text(f"{text}\n", encoding="utf-8")


def read_marker(folder: Path) -> dict[str, Any] | None:
    """What :func:`write_marker` wrote; None: the folder is no complete result."""
    try:
        found = json.loads((folder / MARKER).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    is_ours = isinstance(found, dict) and {"identity", "figures"} <= set(found)
    return found if is_ours else None
