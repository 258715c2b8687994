# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Work by several threads comes back in order, a few at a time; images survive their encoding."""

import threading
import time

import pytest

from rs_localizer.simulation.image_sequence import in_order


def test_results_come_in_order_and_few_wait():
    started: list[int] = []

    def work(item: int) -> int:
        started.append(item)
        time.sleep(0.002 * (7 * item % 5))
        return item**2

    results = in_order(work, range(200))
    assert [next(results) for _ in range(3)] == [0, 1, 4]
    time.sleep(0.1)  # nobody takes more: nothing is made ahead without bound
    assert len(started) < 100
    assert list(results) == [item**2 for item in range(3, 200)]


def test_an_error_ends_the_work():
    before = threading.active_count()

    def work(item: int) -> int:
        if item == 5:
            raise ValueError("five")
        return item

    results = in_order(work, iter(range(10**9)))
    with pytest.raises(ValueError, match="five"):
        list(results)
    assert threading.active_count() == before
