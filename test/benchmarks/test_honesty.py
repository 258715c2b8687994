"""The benches judge rightly: honest estimates pass, and each kind of lie is seen."""

import csv
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.experiments.results import Verdict
from benchmarks.honesty import __main__ as command
from benchmarks.honesty import against_p3p, claims
from benchmarks.honesty.benches import Recordings, benches
from benchmarks.honesty.estimating import Found
from benchmarks.honesty.scores import Score, Scores, Truth, normalised, score
from rs_localizer.io.outputs import Pose, Twist

BENCHES = benches(Recordings(Path("tags"), {}, Path("nowhere")))


def published(rng: np.random.Generator, wider: float = 1.0) -> Score:
    """A pose and twist drawn from their covariances, which are then multiplied."""
    spread = rng.normal(size=(6, 6)) * np.repeat([1e-3, 1e-2], 3)[:, None]
    covariance = spread @ spread.T
    truth = Truth(
        Rotation.random(random_state=rng.integers(2**31)).as_matrix(),
        rng.normal(size=3), rng.normal(size=3), rng.normal(size=3),
    )  # fmt: skip
    way, turn = np.split(spread @ rng.normal(size=6), 2)
    pose = Pose(
        truth.position - way,
        # In the fixed axes of the map, as REP-103's covariances.
        Rotation.from_rotvec(-turn).as_matrix() @ truth.rotation,
        covariance * wider,
    )
    linear, angular = np.split(spread @ rng.normal(size=6), 2)
    twist = Twist(truth.linear - linear, truth.angular - angular, covariance * wider)
    return score(pose, twist, truth, int(rng.integers(2**31)))


def scores(count: int, wider: float) -> Scores:
    rng = np.random.default_rng(0)
    return Scores([published(rng, wider) for _ in range(count)])


def test_truths_drawn_from_the_covariance_lie_inside():
    honest = scores(2000, 1.0)
    for part in ("pose", "twist"):
        assert np.mean(honest.inside(part)) == pytest.approx(0.95, abs=0.012)
    assert not honest.far_off().any()


@pytest.mark.parametrize(
    ("wider", "verdict"), [(1.0, Verdict.HELD), (0.5, Verdict.NOT_HELD), (3.0, Verdict.NOT_HELD)]
)
def test_too_small_and_too_large_covariances_are_seen(wider, verdict):
    some = scores(2500, wider)
    found = {f"{motion}/all": Found(some, some) for motion in ("rest", "hand")}
    judged = {claim.name: claim.verdict for claim in claims.rendered_claims(found)}
    assert judged == {"honesty.rendered_pose": verdict, "honesty.rendered_twist": verdict}


def test_few_frames_decide_nothing():
    some = scores(40, 1.0)
    (claim, _) = claims.rendered_claims({"x/all": Found(some, some)})
    assert claim.verdict is Verdict.UNDECIDED


def test_one_bad_condition_among_many_is_seen():
    good, bad = scores(400, 1.0), scores(60, 0.1)
    found = {f"good {k}": Found(good, good) for k in range(20)} | {"bad": Found(bad, bad)}
    claim = claims.rendered_claims(found)[0]
    assert claim.verdict is Verdict.NOT_HELD
    assert "bad" in claim.finding


def pair(ours: np.ndarray, p3p: np.ndarray) -> against_p3p.Pair:
    def of(errors: np.ndarray) -> Scores:
        return Scores(
            [
                Score(k, "residual") if np.isinf(error) else Score(k, orientation=error, moving=1.0)
                for k, error in enumerate(errors)
            ]
        )

    return against_p3p.Pair(of(ours), of(p3p))


@pytest.mark.parametrize(
    ("factor", "verdict"), [(0.7, Verdict.HELD), (1.5, Verdict.NOT_HELD), (1.08, Verdict.UNDECIDED)]
)
def test_p3p_is_compared_frame_by_frame(factor, verdict):
    rng = np.random.default_rng(0)
    p3p = rng.exponential(size=300)
    ours = factor * p3p * rng.uniform(0.8, 1.2, 300)
    judged = {c.name: c.verdict for c in claims.p3p_claims({"board/0ms/x": pair(ours, p3p)})}
    assert judged["honesty.p3p_median"] is verdict
    assert judged["honesty.p3p_refused"] is Verdict.HELD
    assert judged["honesty.global_shutter"] is Verdict.HELD


def test_more_refusals_than_p3ps_are_seen():
    ours, p3p = np.ones(100), np.ones(100)
    ours[:20], p3p[20:22] = np.inf, np.inf
    judged = {c.name: c for c in claims.p3p_claims({"board/0ms/x": pair(ours, p3p)})}
    assert judged["honesty.p3p_refused"].verdict is Verdict.NOT_HELD
    assert "20 and 2 refused" in judged["honesty.p3p_refused"].finding


def test_a_covariance_that_denies_an_error_is_infinitely_wrong():
    flat = np.diag([1.0, 1.0, 0.0])
    assert normalised(np.zeros(3), flat) == 0.0
    assert normalised(np.array([0.0, 0.0, 1e-9]), flat) == np.inf
    assert normalised(np.array([3.0, 4.0, 0.0]), np.diag([1.0, 4.0, 1.0])) == pytest.approx(13.0)


def test_conditions_have_names_of_their_own():
    for bench in BENCHES.values():
        names = [condition.name for condition in bench.conditions]
        assert len(set(names)) == len(names)
    chosen = BENCHES["p3p"].matching(["board", "lens 10%", "bend 0mm", "0.1px", "5ms"])
    faults = "board/lens 10% bend 0mm/0.1px/5ms"
    assert [one.name for one in chosen] == [
        f"{faults}/{told}" for told in ("unset", "set", "tracked")
    ]


@pytest.mark.bench
def test_a_condition_against_p3p():
    bench = BENCHES["p3p"]
    condition = bench.conditions[-1]
    ((found, result),) = bench.run([condition], 5, 0)
    row = bench.row(found, result)
    assert len(row) == len(bench.columns)
    assert row[:2] == (condition.name, 5)


def test_the_command(tmp_path, capsys, monkeypatch):
    words = [
        "honesty",
        "p3p",
        "--only",
        "markers",
        "lens 30%",
        "0.5px",
        "30ms/set",
        "--frames",
        "3",
    ]
    monkeypatch.setattr(sys, "argv", [*words, "--csv", str(tmp_path)])
    assert command.main() == 0
    assert "markers/lens 30% bend 0mm/0.5px/30ms/set" in capsys.readouterr().out
    with (tmp_path / "p3p.csv").open() as file:
        assert len(list(csv.reader(file))) == 2
    monkeypatch.setattr(sys, "argv", ["honesty", "p3p", "--only", "nowhere"])
    assert command.main() == 2
    assert "no condition" in capsys.readouterr().err
