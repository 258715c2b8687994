"""Verdicts come from the curves: each claim is shown data for it and data against it."""

import json

import numpy as np
from matplotlib.figure import Figure

from benchmarks.experiments.report import write_result, write_summary
from benchmarks.experiments.results import Result, Statement, Table
from benchmarks.experiments.sweeps import Curves

X = np.array([0.0, 10.0, 30.0])


def curves(**level: float) -> Curves:
    """Flat curves of these medians, in all metrics."""
    return Curves("x", X, {name: np.full((3, 3, 4), value) for name, value in level.items()})


def test_results_on_disk(tmp_path):
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
