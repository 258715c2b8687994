# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What a result depends on, so that it is known again, and what its folder is called."""

import functools
import hashlib
import json
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from rs_localizer.io.remote import Location, fingerprint, is_url

MARKER = "fleet.json"
"""Written last into a result's folder: it is complete, and of what."""

_PACKAGE = Path(__file__).parents[2]


@functools.cache
def program() -> str:
    """A digest of the sources of this package, its version among them."""
    digest = hashlib.sha256()
    for file in sorted(_PACKAGE.rglob("*.py")):
        digest.update(file.relative_to(_PACKAGE).as_posix().encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def identity(command: str, settings: Mapping[str, Any], inputs: Sequence[Location]) -> str:
    """A digest of all that decides what a result is.

    Args:
        command: what is done with the recording.
        settings: how, as text can say it.
        inputs: the recording and all other files that are read; known by the names, sizes and
            times of what is in them, since reading all of a recording takes long.
    """
    said = json.dumps(
        [program(), command, settings, [_fingerprint(place) for place in inputs]],
        sort_keys=True,
        default=str,
    )
    return hashlib.sha256(said.encode()).hexdigest()


def _fingerprint(place: Location) -> list[tuple[str, int, int]] | str:
    """Name below the path, size and time of change (ns) of each file; of nothing, nothing."""
    if is_url(place):
        return fingerprint(place)
    path = Path(place)
    files = sorted(path.rglob("*")) if path.is_dir() else [path]
    entries = []
    for file in files:
        if file.is_file():
            about = file.stat()
            name = file.relative_to(path).as_posix()
            entries.append((name, about.st_size, about.st_mtime_ns))
    return entries


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
        content = json.loads((folder / MARKER).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    is_ours = isinstance(content, dict) and {"identity", "figures"} <= set(content)
    return content if is_ours else None


def folder_names(recordings: Sequence[Location], reserved: Collection[str] = ()) -> list[str]:
    """A name for each recording: its own, with as many parent folders as tell it from the others.

    Args:
        recordings: different absolute paths, or URLs.
        reserved: names of what else is there.

    Returns:
        as many different names: of ``a/flight`` and ``b/flight``, ``a_flight`` and ``b_flight``.
    """
    paths = [_as_path(place) for place in recordings]
    names: dict[Path, str] = {}
    depth = 1
    while unnamed := [path for path in paths if path not in names]:
        labels = {path: _label(path, depth) for path in unnamed}
        counts = Counter(labels.values())
        taken = {*reserved, *names.values()}
        deepest = depth > max(len(path.parts) for path in unnamed)
        for path, label in labels.items():
            if counts[label] == 1 and label not in taken:
                names[path] = label
            elif deepest:  # "a/b_c" and "a_b/c", say
                names[path] = _numbered(label, {*taken, *names.values()})
        depth += 1
    return [names[path] for path in paths]


def _as_path(place: Location) -> Path:
    """Of a URL: its parts below the scheme."""
    return Path("/", place.replace("://", "/")) if is_url(place) else Path(place)


def _label(path: Path, depth: int) -> str:
    """The last parts of a path; the suffix of a file only where folders alone do not tell."""
    plain = depth == 1 and not path.is_dir()
    name = path.stem if plain else path.name
    parents = [part.strip("/") for part in path.parts[:-1]]
    return "_".join([*filter(None, parents[len(parents) + 1 - depth :] if depth > 1 else []), name])


def _numbered(label: str, taken: set[str]) -> str:
    number = 2
    while f"{label}_{number}" in taken:
        number += 1
    return f"{label}_{number}"
