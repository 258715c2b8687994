"""Inliers of sequences: each claim is shown frames for it, against it, and too few to tell."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.experiments import methods as m
from benchmarks.experiments.real_claims import METHODS, OURS, claims
from benchmarks.experiments.results import Claim, Verdict

MEANS = {"p3p": 30, "r6p": 80, "r6p_vc_wt": 40, "r6p_vct_w": 82, "r6p_vct_wt": 80, "r6p_vcwt": 80,
         "r9p": 95, "r6p_vcwt_relinearized": 97, "r9p_trace_fixed": 96, OURS: 105}  # fmt: skip
SEQUENCES = ("phone", "action_camera", "hard", "webcam")


def found(frames: int = 60, where: str = "", **means: float) -> dict[str, dict[str, np.ndarray]]:
    """Inliers that scatter by a tenth about these means, in one sequence about others."""
    rng = np.random.default_rng(0)
    return {
        name: {
            method: mean * rng.uniform(0.9, 1.1, frames)
            for method, mean in (MEANS | (means if name == where else {})).items()
        }
        for name in SEQUENCES
    }


def verdicts(rows: dict[str, dict[str, np.ndarray]]) -> dict[str, Claim]:
    return {claim.name.removeprefix("real."): claim for claim in claims(rows)}


def test_all_methods_are_here() -> None:
    assert {*MEANS} == {OURS, *(method.name for method in METHODS)}


def test_all_claims_hold_where_they_should() -> None:
    assert {claim.verdict for claim in verdicts(found()).values()} == {Verdict.HELD}


@pytest.mark.parametrize(
    ("claim", "where", "means"),
    [
        ("vcwt_equals_r6p", "phone", {"r6p": 100}),
        ("vcwt_ahead_of_p3p", "action_camera", {"p3p": 90}),
        ("r9p_hardest", "hard", {"r6p_vct_w": 100}),
        ("localizer_most", "webcam", {OURS: 90}),
    ],
)
def test_one_claim_falls_at_a_time(claim: str, where: str, means: dict[str, float]) -> None:
    fallen = verdicts(found(where=where, **means))
    assert [n for n, c in fallen.items() if c.verdict is Verdict.NOT_HELD] == [claim]


def test_two_of_them_speak_of_any_sequence() -> None:
    rows = found()
    for name in SEQUENCES:
        rows[name][m.VC_WT.name] = rows[name][m.VCWT.name]
        for method in (m.VCT_W, m.VCT_WT):
            rows[name][method.name] = rows[name][m.VCWT.name] - 1
    judged = verdicts(rows)
    assert judged["vct_often_more"].verdict is Verdict.NOT_HELD
    assert judged["vc_wt_unstable"].verdict is Verdict.NOT_HELD
    rows["hard"][m.VC_WT.name] = 0.4 * rows["hard"][m.VCWT.name]
    rows["phone"][m.VCT_W.name] = rows["phone"][m.VCWT.name] + 1
    judged = verdicts(rows)
    assert judged["vct_often_more"].verdict is Verdict.HELD
    assert judged["vc_wt_unstable"].verdict is Verdict.HELD


def test_what_so_few_frames_cannot_tell_is_undecided() -> None:
    rows = found(12, "hard", r9p=81.0)
    judged = verdicts(rows)
    assert judged["r9p_hardest"].verdict is Verdict.UNDECIDED
    assert "undecided at 12 trials" in judged["r9p_hardest"].finding
