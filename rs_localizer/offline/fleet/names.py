"""What the folders of many results are called."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path


def folder_names(recordings: Sequence[Path], reserved: Collection[str] = ()) -> list[str]:
    """A name for each recording: its own, with as many parent folders as tell it from the others.

    Args:
        recordings: different absolute paths.
        reserved: names of what else is there.

    Returns:
        as many different names: of ``a/flight`` and ``b/flight``, ``a_flight`` and ``b_flight``.
    """
    names: dict[Path, str] = {}
    depth = 1
    while left := [path for path in recordings if path not in names]:
        labels = {path: _label(path, depth) for path in left}
        counts = Counter(labels.values())
        taken = {*reserved, *names.values()}
        deepest = depth > max(len(path.parts) for path in left)
        for path, label in labels.items():
            if counts[label] == 1 and label not in taken:
                names[path] = label
            elif deepest:  # "a/b_c" and "a_b/c", say
                names[path] = _numbered(label, {*taken, *names.values()})
        depth += 1
    return [names[path] for path in recordings]


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
