# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Mappings in files that people write, read key by key, with errors that say where."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any


class EntryError(ValueError):
    """Says already which entry it is about."""


class Entry:
    """A mapping of the file whose keys are taken one after the other; the rest is unknown."""

    def __init__(self, tree: Any, where: str) -> None:
        self.where = where
        if not isinstance(tree, dict):
            raise EntryError(f"{where} must be a mapping, found {tree!r}")
        self._left = dict(tree)

    def __contains__(self, name: str) -> bool:
        return name in self._left

    def names(self) -> list[str]:
        """The keys that are left."""
        return [str(name) for name in self._left]

    def take(self, name: str, kind: type | tuple[type, ...], *default: Any) -> Any:
        if name not in self._left and default:
            return default[0]
        if name not in self._left:
            names = ", ".join(map(str, self._left)) or "nothing else"
            raise EntryError(f"{self.where} has no {name}; it has {names}")
        value = self._left.pop(name)
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise EntryError(f"{self.where}: {name} cannot be {value!r}")
        return value

    def number(self, name: str) -> float:
        return float(self.take(name, (int, float)))

    def entries(self, name: str, one: str) -> list[Entry]:
        listed = self.take(name, (list, type(None)), None) or []
        return [Entry(item, f"{one} {index + 1}") for index, item in enumerate(listed)]

    def finish(self) -> None:
        if self._left:
            raise EntryError(f"{self.where} has the unknown {', '.join(map(str, self._left))}")

    @contextlib.contextmanager
    def named(self) -> Iterator[None]:
        """Faults within are about this entry."""
        try:
            yield
        except EntryError:
            raise
        except ValueError as error:
            raise EntryError(f"{self.where}: {error}") from error
