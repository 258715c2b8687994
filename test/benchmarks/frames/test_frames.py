# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The benches of frames judge rightly: honest regions pass, lies and worse versions are seen."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.frames import __main__ as command
from benchmarks.frames.compared import changes_of, read, totals
from benchmarks.frames.conditions import NARROW, Condition, Points, turning
from benchmarks.frames.generated import generate
from benchmarks.frames.judged import FIGURES, FIVE_SIGMA, REGION, Judged, of_pose, of_twist
from benchmarks.independent.rotations import logarithm
from benchmarks.independent.scenes import SmallPlane
from rs_localizer.io.outputs import BodyPose, Twist


def judged(count: int, wider: float = 1.0, farther: float = 1.0, seed: int = 0) -> Judged:
    """Frames whose errors are drawn from their covariances, which are then multiplied."""
    rng = np.random.default_rng(seed)
    figures = np.full((count, len(FIGURES)), 1.0)
    figures[:, 0] = np.arange(count)
    for freedom, names in ((6, "pose_s pose twist"), (3, "turn_s turn way angular linear")):
        for name in names.split():
            figures[:, FIGURES.index(name)] = rng.chisquare(freedom, count) / wider
    for name in ("deg_s", "deg", "mm", "deg/s", "m/s"):
        figures[:, FIGURES.index(name)] = farther * rng.rayleigh(size=count)
    return Judged(figures, [""] * count)


def published(rng: np.random.Generator, wider: float) -> tuple[float, float]:
    """Squared errors of a pose and twist, drawn from covariances that are then multiplied."""
    spread = rng.normal(size=(6, 6)) * np.repeat([1e-3, 1e-2], 3)[:, None]
    covariance = spread @ spread.T
    rotation = Rotation.random(random_state=rng.integers(2**31)).as_matrix()
    position, rate, velocity = rng.normal(size=(3, 3))
    way, turn = np.split(spread @ rng.normal(size=6), 2)
    # In the fixed axes of the map, as REP-103's covariances.
    turned = Rotation.from_rotvec(-turn).as_matrix() @ rotation
    pose = BodyPose(position - way, turned, covariance * wider)
    linear, angular = np.split(spread @ rng.normal(size=6), 2)
    twist = Twist(velocity - linear, rate - angular, covariance * wider)
    truth = rotation, position, rate, velocity
    return of_pose(pose, truth)[0], of_twist(twist, truth)[0]


@pytest.mark.parametrize(
    ("wider", "least", "most"), [(1.0, 0.938, 0.962), (0.5, 0.5, 0.7), (3.0, 0.99, 1.0)]
)
def test_errors_are_weighed_by_the_covariances_that_are_published(wider, least, most):
    rng = np.random.default_rng(0)
    squared = np.array([published(rng, wider) for _ in range(2000)])
    inside = np.mean(squared < REGION, axis=0)
    assert np.all((least < inside) & (inside <= most)), inside
    assert wider < 1.0 or squared.max() < FIVE_SIGMA


def test_honest_regions_hold_and_are_sharp():
    def row(**off: float) -> dict[str, float]:
        return totals({"hand/some": judged(4000, **off)})["all"]

    for share in ("pose@s", "pose@m", "twist@m"):
        assert row()[share] == pytest.approx(95.0, abs=1.2)
    assert row()[">5s"] == 0.0
    assert row()["s_turn"] == pytest.approx(1.0, abs=0.03)
    assert row(wider=4.0)["s_way"] == pytest.approx(2.0, abs=0.06)
    assert row(wider=0.1)[">5s"] > 10.0


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


def test_the_commands(tmp_path, capsys):
    table = tmp_path / "a.npz"
    words = ["--bench", "real", "--only", "slow", "tracked", "1px", "--frames", "2"]
    assert command.main(["run", "--out", str(table), *words]) == 0
    out, said = capsys.readouterr()
    assert out.splitlines()[1].startswith("real ")
    assert "slow/1px/tracked" in said
    (name,) = read(table)
    assert name == "real/slow/1px/tracked"
    assert command.main(["compare", str(table), str(table), "--all"]) == 0
    out = capsys.readouterr().out
    assert "WORSE" not in out
    assert name in out
    assert command.main(["run", "--out", str(table), "--only", "nothing"]) == 2
