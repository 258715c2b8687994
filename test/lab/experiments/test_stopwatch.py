"""Times are medians per piece of work, taken in turns."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator

import pytest

from rs_localizer.lab.experiments.stopwatch import Subject, interleaved


def untracked(items: Iterable, total: int) -> Iterator:
    return iter(items)


def test_subjects_take_turns() -> None:
    turns: list[str] = []
    subjects = {name: Subject(lambda name=name: turns.append(name), 1) for name in "abc"}
    interleaved(subjects, 3, untracked)
    assert "".join(turns) == "abc" * 4  # one to warm up


def test_median_per_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 1.0, 10.0, 12.0, 20.0, 29.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    assert interleaved({"a": Subject(lambda: None, 4)}, 3, untracked) == {"a": 0.5e6}
