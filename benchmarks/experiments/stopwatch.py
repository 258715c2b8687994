# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Times of many subjects on a machine that has other things to do."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from benchmarks.experiments.results import Track
from rs_localizer.core.arrays import Array


@dataclass(frozen=True, slots=True)
class Subject:
    """Something to be timed: ``run`` does its work ``count`` times."""

    run: Callable[[], object]
    count: int


def interleaved(subjects: Mapping[str, Subject], repeats: int, track: Track) -> dict[str, Array]:
    """Times (repeats,) per piece of work of each subject, in microseconds.

    All subjects take turns, so that a slow moment of the machine hits all of them alike: compare
    them turn by turn, see :func:`ratio`.
    """
    for subject in subjects.values():
        subject.run()  # compiles, fills caches
    times: dict[str, list[float]] = {name: [] for name in subjects}
    rounds: Iterable[int] = range(repeats)
    for _ in track(rounds, repeats):
        for name, subject in subjects.items():
            start = time.perf_counter()
            subject.run()
            times[name].append(time.perf_counter() - start)
    return {name: 1e6 * np.array(times[name]) / subjects[name].count for name in subjects}


def ratio(one: Array, other: Array) -> float:
    """Median of what one subject took in units of what the other took in the same turn."""
    return float(np.median(one / other))
