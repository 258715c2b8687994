# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A short campaign over all readers, and that a campaign sees what it is there to see."""

from typing import Any

from benchmarks.fuzzing import Target, run, targets

EXECUTIONS = 6000


def test_no_reader_raises_another_error(tmp_path):
    everything = targets(tmp_path)
    *_, report = run(everything, EXECUTIONS, seed=1)
    assert report.failures == [], report.text()
    assert report.executions == EXECUTIONS
    for name, outcomes in report.outcomes.items():
        # Some of it is read all the same, some is not: the damages are neither nothing nor all.
        assert outcomes["read"] > 0, name
        assert len(outcomes) > 1 or name.startswith("localize"), name


def test_what_fails_is_reported():
    def read(case: Any) -> None:
        if case > 1:
            raise (KeyError("three") if case == 3 else ValueError("two"))

    target = Target(lambda random: random.randint(0, 3), read, (ValueError,))
    *_, report = run({"numbers": target}, 200, seed=0)
    outcomes = report.outcomes["numbers"]
    assert set(outcomes) == {"read", "ValueError", "FAILED: KeyError"}
    assert len(report.failures) == outcomes["FAILED: KeyError"] > 20
    assert {failure.case for failure in report.failures} == {3}
    assert "KeyError('three') in read" in report.text()
