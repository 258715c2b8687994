"""Times per piece of work, taken in turns."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator

import numpy as np
import pytest

from benchmarks.experiments.stopwatch import Subject, interleaved, ratio


def untracked(items: Iterable, total: int) -> Iterator:
    return iter(items)


def test_subjects_take_turns() -> None:
    turns: list[str] = []
    subjects = {name: Subject(lambda name=name: turns.append(name), 1) for name in "abc"}
    interleaved(subjects, 3, untracked)
    assert "".join(turns) == "abc" * 4  # one to warm up


def test_times_are_per_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 1.0, 10.0, 12.0, 20.0, 29.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    times = interleaved({"a": Subject(lambda: None, 4)}, 3, untracked)
    np.testing.assert_allclose(times["a"], [0.25e6, 0.5e6, 2.25e6])


def test_ratios_are_taken_turn_by_turn() -> None:
    # The machine runs at half its speed in two turns of three.
    fast_and_slow = np.array([1.0, 2.0, 2.0])
    assert ratio(3.0 * fast_and_slow, fast_and_slow) == 3.0
