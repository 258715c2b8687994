# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Commands write where only whole results leave: each test of a command holds that, too."""

import contextlib
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rs_localizer.cli import commands

_WRITING = os.O_WRONLY | os.O_RDWR
_watched: list[Path] = []  # where results of tests are, while a command works
_seen: list[str] = []


def _hear(event: str, given: tuple[Any, ...]) -> None:
    if event != "open" or not _watched or not isinstance(given[0], str):
        return
    path, _, flags = given
    if flags & _WRITING and Path(path).is_relative_to(_watched[0]):
        _seen.append(path)


sys.addaudithook(_hear)  # for good: Python removes none


@pytest.fixture
def ran(capsys) -> Callable[..., Any]:
    """Runs a command line and returns what it has printed; its exit code is as expected."""

    def ran(*words: object, code: int = 0) -> Any:
        capsys.readouterr()
        assert commands.main([*map(str, words)]) == code
        return capsys.readouterr()

    return ran


@pytest.fixture(autouse=True)
def whole_results_only(monkeypatch, tmp_path_factory) -> Iterator[None]:
    """Within a command, files are opened for writing in a workplace of atomic_files alone."""
    output = commands._output

    @contextlib.contextmanager
    def watched(common: Any) -> Iterator[Any]:
        with output(common) as kept:
            _watched.append(tmp_path_factory.getbasetemp())
            try:
                yield kept
            finally:
                _watched.clear()

    monkeypatch.setattr(commands, "_output", watched)
    _seen.clear()
    yield
    assert [path for path in _seen if ".unfinished-" not in path] == []
