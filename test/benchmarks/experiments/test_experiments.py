# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What held still holds: all experiments with a few trials, against the verdicts expected of them.

Left out are the verdicts that need the default number of trials (differences of a few per cent) and
those on times, which are not the code's alone.
"""

from collections.abc import Iterable, Iterator

import pytest

from benchmarks.__main__ import EXPERIMENTS
from benchmarks.experiments import convergence
from benchmarks.experiments.results import Context

TRIALS = 300
# By experiment: claims that hold, and that do not.
HELD = {
    "motion": "two_step_poor r9p_ahead_exact r9p_fixed_ahead_noisy r9p_gauge_t r9p_gauge_pose",
    "translation": "vct_ahead",
    "noise": "joint_solvers_alike six_point_bound refined_reaches_bound few_inliers_seen_2 "
             "few_inliers_seen_4 few_inliers_seen_8",
    "linearisation": "useful_orientation useful_centre relinearized_flat",
    "convergence": "exact_at_rest exact_in_translation vcwt_solves least_squares vcwt_once "
                   "two_step_slow two_step_falls two_step_solves",
    "from-p3p": "vcwt_once_matches_r6p vcwt_beats_p3p r6p_vcwt_equals_r6p",
    "sequences": "vcwt_equals_r6p beat_p3p",
}  # fmt: skip
NOT_HELD = {
    "motion": "r9p_ahead_noisy r9p_no_velocity", "noise": "all_alike", "sequences": "r9p_best",
}  # fmt: skip


def untracked(items: Iterable, total: int) -> Iterator:
    return iter(items)


def test_right_solvers_are_exact():
    assert all(claim.held for claim in convergence.exactness(Context(40, 0, untracked)))


@pytest.mark.bench
@pytest.mark.parametrize("name", list(EXPERIMENTS))
def test_verdicts(name):
    found = EXPERIMENTS[name](Context(TRIALS, 0, untracked))
    claims = {claim.name.removeprefix(f"{name}."): claim for claim in found.claims}
    held, not_held = (set(known.get(name, "").split()) for known in (HELD, NOT_HELD))
    assert set(claims) >= held | not_held
    wrong = [
        f"{short} {claim.verdict}: {claim.finding}" for short, claim in claims.items()
        if short in (not_held if claim.held else held)
    ]  # fmt: skip
    assert wrong == []
    for short, claim in claims.items():
        assert "nan" not in claim.finding
        assert claim.why or short not in not_held
    assert found.notes
    for figure in found.figures.values():
        assert all(axes.lines for axes in figure.axes)
