"""What counts as visible, flat and off; and each claim is shown data for it and data against it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.experiments.augmented_reality_claims import Frames, claims
from benchmarks.experiments.results import Verdict
from rs_localizer import data
from rs_localizer.core.shutter import Motion
from rs_localizer.evaluation.cube_clip import clip_cube, clip_stamps, cube_errors
from rs_localizer.io.trajectories import read_tum
from rs_localizer.simulation.frames import middle_stamp
from rs_localizer.simulation.marker_frames import CAMERA, MarkerFrame, MarkerWalls, visible

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
SPREAD = np.linspace(0.0, 1.0, 400)

GOOD = Frames(
    taken=410,
    speeds=np.repeat([20.0, 100.0], [160, 240]),
    plain={"p3p": 1.5 + SPREAD, "r6p": 0.5 + SPREAD, "r9p": 0.6 + SPREAD},
    plain_owners=np.arange(400) % 100,
    products={"p3p": 1.0 + SPREAD, "r6p_vcwt": 0.1 + 0.5 * SPREAD},
    owners=np.arange(400) % 100,
    positions={"p3p": np.full(400, 0.3), "r6p_vcwt": np.full(400, 0.01)},
    seconds={"p3p": np.full(400, 1e-3), "r6p_vcwt": np.full(400, 2e-3)},
    cube={"p3p": np.full(80, 9.0), "localizer": np.full(80, 0.4)},
)


def verdicts(found: Frames) -> dict[str, Verdict]:
    return {claim.name.removeprefix("augmented-reality."): claim.verdict for claim in claims(found)}


def test_all_claims_hold_where_they_should() -> None:
    assert set(verdicts(GOOD).values()) == {Verdict.HELD}


def changed(values: np.ndarray, share: float, to: float) -> np.ndarray:
    """The last so many of them are another."""
    found = values.copy()
    found[len(found) - round(share * len(found)) :] = to
    return found


@pytest.mark.parametrize(
    ("claim", "change"),
    [
        # One quantile above the median is enough, and so is one method.
        ("plain", {"plain": GOOD.plain | {"r6p": changed(0.5 + SPREAD, 0.02, 9.0)}}),
        ("r9p", {"plain": GOOD.plain | {"r9p": 2.0 + SPREAD}}),
        ("localizer", {"products": GOOD.products | {"joint": changed(SPREAD, 0.02, np.inf)}}),
        ("localized", {"positions": GOOD.positions
                       | {"r6p_vcwt": changed(np.full(400, 0.01), 0.06, np.inf)}}),
        # 2.9 times better, where it is fast.
        ("position", {"positions": GOOD.positions
                      | {"r6p_vcwt": changed(np.zeros(400), 0.6, 0.3 / 2.9)}}),
        ("reprojection", {"products": {"p3p": 9.0 + SPREAD, "r6p_vcwt": 0.1 + SPREAD}}),
        ("time", {"seconds": GOOD.seconds | {"r6p_vcwt": changed(np.zeros(400), 0.09, 6e-3)}}),
        ("cube", {"cube": GOOD.cube | {"localizer": np.where(np.arange(80) % 8, 0.4, 4.0)}}),
        ("cube", {"cube": GOOD.cube | {"localizer": np.full(80, 1.1)}}),
    ],
)  # fmt: skip
def test_one_claim_falls_at_a_time(claim: str, change: dict) -> None:
    found = verdicts(replace(GOOD, **change))
    assert [name for name, verdict in found.items() if verdict is Verdict.NOT_HELD] == [claim]


def test_what_so_few_cannot_tell_is_undecided() -> None:
    few = {
        "speeds": np.full(40, 100.0),
        "positions": {name: values[:40] for name, values in GOOD.positions.items()},
        "seconds": {name: values[:40] for name, values in GOOD.seconds.items()},
        "cube": {name: values[:24] for name, values in GOOD.cube.items()},
    }
    found = verdicts(replace(GOOD, **few))
    undecided = {name for name, verdict in found.items() if verdict is Verdict.UNDECIDED}
    assert undecided == {"localized", "time", "cube"}


def test_frames_without_a_pose_are_no_better_than_others() -> None:
    refused = changed(1.0 + SPREAD, 0.5, np.inf)
    (p3p_refuses,) = (c for c in claims(replace(GOOD, products=GOOD.products | {"p3p": refused}))
                      if c.name == "augmented-reality.localizer")  # fmt: skip
    assert p3p_refuses.verdict is Verdict.HELD
    assert "inf" in p3p_refuses.finding


@pytest.mark.parametrize(
    ("quad", "expected"),
    [
        (100.0 + 20.0 * SQUARE, True),
        (100.0 + 15.0 * SQUARE, False),  # too small
        (100.0 + 20.0 * SQUARE[::-1], False),  # from behind
        (100.0 + np.array([60.0, 17.0]) * (SQUARE @ [[1.0, 0.9], [0.0, 1.0]]), True),
        (100.0 + np.array([60.0, 60.0]) * (SQUARE @ [[1.0, 0.9], [0.9, 1.0]]), False),  # a sliver
        ([1.0, 100.0] + 20.0 * SQUARE, False),  # on the rim
        ([619.0, 100.0] + 20.0 * SQUARE, False),
        (np.where(SQUARE > 0.5, np.nan, 100.0), False),  # behind the camera
    ],
)
def test_what_is_visible(quad: np.ndarray, expected: bool) -> None:
    assert visible(np.array([quad]), (640, 480)).tolist() == [expected]


def test_one_wall_is_flat() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-3, 3, (12, 2)), np.full(12, 2.0)])
    frame = MarkerFrame(0, 0, wall, np.zeros((12, 2)), 3, np.zeros(3), 0.0)
    assert frame.is_flat
    assert not replace(frame, points=wall + np.eye(12, 3)).is_flat


def test_a_turned_pose_puts_the_cube_off() -> None:
    walls = MarkerWalls(read_tum(data.path(data.HAND_MOTION)), 0)
    middle, away = (middle_stamp(CAMERA, clip_stamps(walls)[k]) for k in (90, 60))
    state, cube = walls.motion.state(middle, np.zeros(1)), clip_cube(walls)
    rotation = state.rotations[0].T
    true = Motion(
        rotation, -rotation @ state.positions[0],
        CAMERA.readout_time * state.angular[0], CAMERA.readout_time * state.linear[0],
    )  # fmt: skip
    still = replace(true, angular_velocity=np.zeros(3), linear_velocity=np.zeros(3))
    off = cube_errors(walls.motion, middle, cube, {"true": true, "still": still, "none": None})
    # The true motion is no constant velocity, and yet nearly one during a readout.
    assert off["true"] < 0.5
    assert off["still"] > 3.0
    assert off["none"] == np.inf
    assert cube_errors(walls.motion, away, cube, {"true": true}) == {}
