"""The benches of frames judge rightly: honest regions pass, lies and worse versions are seen."""

import math
import time
from dataclasses import replace

import numpy as np
import pytest

import rs_localizer as rsl
from benchmarks.frames import __main__ as command
from benchmarks.frames.compared import changes_of, changes_together, read, totals
from benchmarks.frames.conditions import (
    BENCHES,
    HAND,
    NARROW,
    Condition,
    Points,
    conditions,
    named,
    turning,
)
from benchmarks.frames.generated import generate
from benchmarks.frames.judged import FIGURES, Judged, camera_of, configured, judge, normalised
from benchmarks.frames.timed import calls_of, in_turns
from benchmarks.independent.rotations import logarithm
from benchmarks.independent.scenes import Rich, SmallPlane

CONDITION = Condition("hand", "some", HAND, Rich(40), 1.0)


def judged(count: int, wider: float = 1.0, farther: float = 1.0, seed: int = 0) -> Judged:
    """Frames whose errors are drawn from their covariances, which are then multiplied."""
    rng = np.random.default_rng(seed)
    figures = np.full((count, len(FIGURES)), 1.0)
    figures[:, 0] = np.arange(count)
    for name in ("pose_s", "pose", "twist"):
        figures[:, FIGURES.index(name)] = np.sum(rng.normal(size=(count, 6)) ** 2, axis=1) / wider
    for name in ("turn_s", "turn", "way", "angular", "linear"):
        figures[:, FIGURES.index(name)] = np.sum(rng.normal(size=(count, 3)) ** 2, axis=1) / wider
    for name in ("deg_s", "deg", "mm", "deg/s", "m/s"):
        figures[:, FIGURES.index(name)] = farther * rng.rayleigh(size=count)
    return Judged(figures, [""] * count)


def test_honest_regions_hold_and_are_sharp():
    row = judged(4000).row(CONDITION)
    for share in ("pose@stamp", "pose@mid", "twist@mid"):
        assert row[share] == pytest.approx(95.0, abs=1.2)
    assert row["over_5_sigma"] == 0.0
    assert row["sharp_turn"] == pytest.approx(1.0, abs=0.03)
    assert judged(4000, wider=4.0).row(CONDITION)["sharp_way"] == pytest.approx(2.0, abs=0.06)
    assert judged(4000, wider=0.1).row(CONDITION)["over_5_sigma"] > 10.0


@pytest.mark.parametrize(
    ("figure", "after", "sign"),
    [
        ("pose@m", {"wider": 0.5}, -1),
        ("twist@m", {"wider": 0.5}, -1),
        ("not>5s", {"wider": 0.1}, -1),
        ("deg", {"farther": 1.1}, -1),
        ("deg", {"farther": 0.9}, 1),
        ("deg/s", {"farther": 1.01}, 0),
        ("pose@s", {}, 0),
    ],
)
def test_what_is_certainly_worse_is_seen(figure, after, sign):
    assert changes_of(judged(100), judged(100, **after))[figure].sign == sign


def test_chance_is_no_change():
    changes = [
        change
        for seed in range(40)
        for change in changes_of(judged(40, seed=seed), judged(40, seed=seed + 1000)).values()
    ]
    assert sum(change.sign != 0 for change in changes) <= 0.03 * len(changes)


def test_refusals_count_and_frames_of_a_recording_are_one():
    every = judged(100)
    fewer = Judged(every.figures, ["uncertain"] * 20 + [""] * 80)
    assert changes_of(every, fewer)["localized"].sign == -1
    assert changes_of(fewer, every)["localized"].sign == 1
    one = every.figures.copy()
    one[:, 0] = 0.0
    assert changes_of(Judged(one, every.reasons), Judged(one, fewer.reasons))["localized"].sign == 0
    assert totals({"a/x": every, "b/y": fewer})["all"]["localized"] == 90.0


def test_small_changes_are_certain_of_many_conditions_together():
    before = {f"a/{k}": judged(40, seed=k) for k in range(30)}
    after = {f"a/{k}": judged(40, wider=0.8, farther=1.05, seed=k) for k in range(30)}
    changes = {name: changes_of(before[name], after[name]) for name in before}
    together = changes_together(before, after, changes)
    assert together["pose@m"].sign == -1
    assert together["localized"].sign == 0
    assert together["deg"].after == pytest.approx(1.05)
    assert together["deg"].sign == -1


def test_conditions_have_names_of_their_own_and_every_bench_some():
    names = [(one.bench, one.name) for one in conditions()]
    assert len(set(names)) == len(names)
    assert {bench for bench, _ in names} == set(BENCHES)


def test_the_same_seed_gives_the_same_frames():
    def pixels(seed: int) -> np.ndarray:
        return next(generate(CONDITION, 1, seed)).pixels

    np.testing.assert_array_equal(pixels(3), pixels(3))
    assert not np.array_equal(pixels(3), pixels(4))


def test_points_are_spoilt_as_described():
    def frame(**changes: object):
        return next(generate(replace(CONDITION, noise=1e-9, **changes), 1, 0))

    exact = frame()

    def off(**points: float) -> np.ndarray:
        other = frame(points=Points(**points))
        np.testing.assert_allclose(np.linalg.norm(other.points, axis=1) > 0.0, True)
        return np.linalg.norm(other.pixels - exact.pixels, axis=1)

    assert np.count_nonzero(off(wrong=0.5) > 1.0) == pytest.approx(20, abs=1)
    np.testing.assert_allclose(off(shift=0.3), 0.3, atol=1e-6)
    body = frame(points=Points(body=True)).pixels
    assert len(body) >= 25
    rough = frame(points=Points(rough_map=0.01)).points - exact.points
    assert np.std(rough) == pytest.approx(0.01, rel=0.3)
    tails = replace(CONDITION, points=Points(tails=3.0))
    errors = np.concatenate(
        [
            (spoilt.pixels - clean.pixels).ravel()
            for spoilt, clean in zip(
                generate(tails, 200, 0),
                generate(replace(CONDITION, noise=1e-9), 200, 0),
                strict=True,
            )
        ]
    )
    assert np.median(np.abs(errors)) == pytest.approx(0.765, rel=0.05)  # of t with 3 degrees
    assert np.mean(np.abs(errors) > 5.0) == pytest.approx(0.0154, rel=0.3)


def test_the_gyroscope_says_how_the_camera_turns():
    planes = Condition(
        "gyro", "x", turning(10.0), SmallPlane(), 1.0, points=Points(gyroscope=True), camera=NARROW
    )
    frame = next(generate(planes, 1, 0))
    assert frame.gyroscope is not None
    mean = frame.gyroscope.rates.mean(axis=0)
    np.testing.assert_allclose(mean, frame.middle[2], atol=math.radians(0.5))
    assert np.linalg.norm(mean) == pytest.approx(math.radians(10.0) / 0.03, rel=0.01)
    first, middle = frame.stamp[0], frame.middle[0]
    assert np.linalg.norm(logarithm(first.T @ middle)) == pytest.approx(math.radians(5.0), rel=1e-6)


def test_calibrations_are_off_as_described():
    centre = named("camera/centre 1px/rich/1px")
    for variant in range(4):
        off = camera_of(centre, variant).K - centre.camera.matrix
        assert np.linalg.norm(off[:2, 2]) == pytest.approx(1.0)
    focal = named("camera/focal 0.3%/wall/1px")
    ratios = {round(float(camera_of(focal, k).K[0, 0] / focal.camera.focal), 6) for k in range(4)}
    assert ratios == {0.997, 1.003}
    boards = named("camera/ten boards/rich/1px")
    for variant in range(2):
        found = camera_of(boards, variant)
        off = found.K - boards.camera.matrix
        assert 1e-3 < np.abs(off).max() < 3.0  # px
        np.testing.assert_allclose(found.D, boards.camera.distortion, atol=0.03)


def test_settings_have_dotted_names():
    config = configured(rsl.LocalizerConfig(), {"velocity_prior.angular": 0.5}, exact=True)
    assert config.velocity_prior.angular == 0.5
    with pytest.raises(ValueError, match="velocity is not a setting"):
        configured(rsl.LocalizerConfig(), {"velocity": 0.5}, exact=True)


def test_lengths_have_units():
    assert normalised(np.array([3.0, 4.0]), np.diag([9.0, 16.0])) == pytest.approx(2.0)
    assert normalised(np.array([1.0, 0.0]), np.diag([0.0, 1.0])) == math.inf
    assert normalised(np.zeros(2), np.zeros((2, 2))) == 0.0


def test_a_hand_before_a_rich_scene_is_honest():
    one = judge(CONDITION, 40, 0, {})
    assert one.localized.all()
    row = one.row(CONDITION)
    assert min(float(row[name]) for name in ("pose@stamp", "pose@mid", "twist@mid")) > 80.0
    assert 0.5 < float(row["sharp_turn"]) < 2.5


def test_times_are_taken_in_turns_and_calls_are_counted():
    frames = list(generate(CONDITION, 2, 0))
    done: list[str] = []

    def work(name: str, seconds: float) -> None:
        done.append(name)
        end = time.process_time() + seconds
        while time.process_time() < end:
            pass

    spent = in_turns([lambda _: work("a", 0.02), lambda _: work("b", 0.06)], frames, 3)
    assert done == ["a", "b"] * 7
    assert 2.0 < np.sum(spent[1]) / np.sum(spent[0]) < 4.0
    localizer = rsl.Localizer(camera_of(CONDITION, 0))
    calls, kernels, files = calls_of(
        lambda frame: localizer.localize(frame.points, frame.pixels), frames
    )
    assert calls > 3
    assert kernels > 3
    assert 3 < files <= calls + kernels
    assert calls_of(lambda frame: normalised(frame.points[0], np.eye(3)), frames) == (0, 0, 0)


def test_the_commands(tmp_path, capsys):
    table = tmp_path / "a.csv"
    words = ["--bench", "real", "--only", "slow", "tracked", "1px", "--frames", "2"]
    assert command.main(["run", "--out", str(table), *words]) == 0
    assert "slow/1px/tracked" in capsys.readouterr().out
    (name,) = read(table)
    assert name == "real/slow/1px/tracked"
    plot = tmp_path / "a.png"
    assert command.main(["compare", str(table), str(table), "--all", "--plot", str(plot)]) == 0
    out = capsys.readouterr().out
    assert "WORSE" not in out
    assert name in out
    assert plot.stat().st_size > 10_000
    assert command.main(["run", "--out", str(table), "--only", "nothing"]) == 2
    assert command.main(["run", "--out", str(table), "--set", "seed=1"]) == 2
