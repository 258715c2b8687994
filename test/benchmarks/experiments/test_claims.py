"""Verdicts come from the curves: each claim is shown data for it and data against it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from benchmarks.experiments import methods as m
from benchmarks.experiments.motion import equal_to_r6p, joint_is_best
from benchmarks.experiments.report import count_verdicts, write_result, write_summary
from benchmarks.experiments.results import Result, Statement, Table, Verdict
from benchmarks.experiments.sweeps import Curves

X = np.array([0.0, 10.0, 30.0])


def curves(**level: float) -> Curves:
    """Flat curves of these medians, in all metrics."""
    return Curves("x", X, {name: np.full((3, 3, 4), value) for name, value in level.items()})


def test_equal_to_r6p() -> None:
    assert equal_to_r6p("e", [curves(r6p=1.0, r6p_vcwt=1.04)]).verdict is Verdict.HELD
    claim = equal_to_r6p("e", [curves(r6p=1.0, r6p_vcwt=1.0), curves(r6p=1.0, r6p_vcwt=1.06)])
    assert claim.verdict is Verdict.NOT_HELD
    assert "6.0%" in claim.finding
    assert equal_to_r6p("e", [curves(r6p_vcwt=1.0)]).verdict is Verdict.NOT_TESTED


def test_equal_to_r6p_as_far_as_it_reaches() -> None:
    found = curves(r6p=1.0, r6p_vcwt=1.0)
    found.quartiles["r6p"][2] = 9.0
    assert equal_to_r6p("e", [found]).verdict is Verdict.NOT_HELD
    assert equal_to_r6p("e", [found], up_to=10.0).verdict is Verdict.HELD


def test_joint_is_measured_against_the_better_one() -> None:
    within = curves(joint=1.04, r6p_vcwt=1.0, r6p_vct_w=2.0)
    assert joint_is_best("e", within).verdict is Verdict.HELD
    beyond = curves(joint=1.04, r6p_vcwt=1.0, r6p_vct_w=0.9)
    assert joint_is_best("e", beyond).verdict is Verdict.NOT_HELD


def test_why_is_for_claims_that_do_not_hold() -> None:
    assert Statement("a.b", "s", "it flies", "c").judged("f", True, "no wings").why == ""
    assert Statement("a.b", "s", "it flies", "c").judged("f", False, "no wings").why == "no wings"


def test_every_method_can_be_told_from_the_others() -> None:
    from benchmarks.experiments.charts import look

    looks = [look(method) for method in m.ALL]
    assert len({style.color for style in looks}) == len(looks)
    # In black and white, lines that are drawn together differ in marker or fill.
    for together in ((*m.PAPERS, m.REFINED), (*m.OURS, m.R6P, m.VCWT, m.R9P)):
        shapes = {(look(x).marker, look(x).filled, look(x).line) for x in together}
        assert len(shapes) == len(together)


def test_results_on_disk(tmp_path: Path) -> None:
    held = Statement("flight.up", "paper", "birds | fly", "up").judged("3 m", True)
    fell = Statement("flight.fish", "paper", "fish fly", "up").judged("0 m", False, "no wings")
    result = Result(
        "Flight", "In air.", [held, fell], {"flight": Table(("x", "name"), [(1 / 3, "a")])},
        {"flight": Figure()}, ["line\nline"], {"flight.gif": b"GIF89a"},
    )  # fmt: skip
    write_result(tmp_path, result)
    write_summary(tmp_path, {"flight": result}, {"flight": 1.25}, trials=7, seed=3)
    assert (tmp_path / "flight.csv").read_text() == "x,name\n0.333333,a\n"
    assert (tmp_path / "flight.png").read_bytes()[:4] == b"\x89PNG"
    assert (tmp_path / "flight.gif").read_bytes() == b"GIF89a"
    text = (tmp_path / "summary.md").read_text()
    assert "![flight.gif](flight.gif)" in text
    assert "| birds \\| fly | paper | up | 3 m | held |" in text
    assert "**did not hold**" in text
    assert "no wings" in text
    assert "1 held, 1 did not hold" in text
    data = json.loads((tmp_path / "summary.json").read_text())
    assert (data["trials"], data["seed"]) == (7, 3)
    assert [(c["name"], c["verdict"]) for c in data["claims"]] == [
        ("flight.up", "held"),
        ("flight.fish", "did not hold"),
    ]


def test_counting_verdicts() -> None:
    assert count_verdicts([]) == "no claims"
