# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The correction of odometry: each rule by the smallest input that trips it, and by silence."""

import math
from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.config import NodeConfig
from rs_localizer.io.transforms import Transform
from rs_localizer.pipeline.carried_pose import Click, FoundPose, Odometry
from rs_localizer.pipeline.map_to_odom import CorrectionState, Decision, Standing, decide

SECOND = 10**9
SPREAD = (0.01, 0.005)  # m, rad, of each axis of a pose
# As RViz gives it.
CLICK = np.diag([0.25, 0.25, 0.01, 0.0025, 0.0025, 0.0685])


def place(x: float, y: float, yaw: float) -> Transform:
    return Transform(Rotation.from_euler("z", yaw).as_matrix(), np.array([x, y, 0.0]))


class Drive:
    """A robot at half a metre a second with turns, its odometry, and what is decided."""

    def __init__(
        self, *, scale: float = 0.03, turn: float = 0.005, seed: int = 0, **settings: Any
    ) -> None:
        self.rng, self.scale, self.turn = np.random.default_rng(seed), scale, turn
        self.body, self.odom, self.time = place(0, 0, 0), place(5, 3, 1.0), 10.0
        self.settings, self.decision = NodeConfig(**settings), decide(
            NodeConfig(**settings), CorrectionState(), Odometry(0, place(5, 3, 1.0))
        )  # fmt: skip
        self.said: list[str] = []
        self.standings: Counter[Standing] = Counter()
        self.worst = 0.0  # error over what is claimed

    @property
    def at(self) -> Odometry:
        return Odometry(round(self.time * SECOND), self.odom)

    def take(self, seen: Odometry | FoundPose) -> Decision:
        self.decision = decide(self.settings, self.decision.state, seen)
        if self.decision.said:
            self.said.append(self.decision.said)
        self.standings[self.decision.standing] += 1
        if self.decision.map_from_odom is not None:
            off, claimed = self.errors()
            self.worst = max(self.worst, off / claimed)
        return self.decision

    def errors(self) -> tuple[float, float]:
        """Distance from the truth, and the standard deviation of it that is claimed."""
        found = self.decision.map_from_odom @ self.odom
        off = float(np.linalg.norm(found.translation - self.body.translation))
        return off, math.sqrt(self.decision.covariance[:3, :3].trace())

    def go(self, seconds: float, *, poses: bool = True, rate: float = 30.0, **seen: Any) -> None:
        for _ in range(round(seconds * rate)):
            self.time += 1.0 / rate
            turns = 0.4 * math.sin(self.time / 6.0)
            self.body = self.body @ place(0.5 / rate, 0.0, turns / rate)
            noise = self.rng.normal(0, 1e-4)
            self.odom = self.odom @ place(
                0.5 / rate * (1.0 + self.scale) + noise, 0.0, (turns + self.turn) / rate
            )
            self.take(self.pose(**seen) if poses else self.at)

    def carry(self, way: float, seconds: float, *, poses: bool, rate: float = 30.0) -> None:
        """Be carried, which odometry does not see."""
        for _ in range(round(rate * seconds)):
            self.time += 1.0 / rate
            step = np.array([0.0, way / seconds / rate, 0.0])
            self.body = replace(self.body, translation=self.body.translation + step)
            if poses:
                self.take(self.pose())
            else:
                self.decision = decide(self.settings, self.decision.state, self.at)

    def pose(self, off: float = 0.0, doubt: float = 0.0, wide: float = 1.0) -> FoundPose:
        """What a frame finds, in a map that is off by so much, or less certain than usual."""
        noise = self.rng.normal(0.0, np.repeat(SPREAD, 3))
        found = Transform(
            Rotation.from_rotvec(noise[3:]).as_matrix() @ self.body.rotation,
            self.body.translation + noise[:3] + [off, 0.0, 0.0],
        )
        return FoundPose(self.at, found, wide**2 * np.diag(np.repeat(SPREAD, 3) ** 2), doubt)

    def click(self, x: float = 0.0, y: float = 0.0) -> str:
        off = Transform(self.body.rotation, self.body.translation + np.array([x, y, 0.0]))
        return self.take(Click(self.at, off, CLICK)).said


@pytest.mark.parametrize("two_d", [False, True])
def test_an_hour_of_right_poses_trips_no_rule(two_d):
    drive = Drive(two_d_mode=two_d)
    drive.go(3600.0, rate=3.0)
    assert drive.said == []
    assert set(drive.standings) == {Standing.TRACKING}
    assert drive.worst < 4.0
    metres, radians = drive.decision.smallest
    assert 0.05 < metres < 0.12
    assert 0.02 < radians < 0.06


def tracking(**settings: Any) -> Drive:
    drive = Drive(**settings)
    drive.go(20.0)
    drive.worst = 0.0
    return drive


def test_the_smallest_jump_that_is_refused_is_what_is_said():
    for share, refused in ((0.9, False), (1.1, True)):
        drive = tracking()
        jump = share * drive.decision.smallest[0]
        drive.time += 1e-3  # nothing grows in between
        exact = replace(drive.pose(), map_from_body=drive.decision.map_from_odom @ drive.odom)
        x, y, z = exact.map_from_body.translation
        shifted = Transform(exact.map_from_body.rotation, np.array([x, y + jump, z]))
        drive.take(replace(exact, map_from_body=shifted))
        assert (drive.decision.state.aside is not None) == refused


# How frames of a wrong map come: what `go` is told, one after the other.
WRONG = [
    *([(seconds, {"off": jump})] for seconds in (1.5, 60.0) for jump in (0.15, 0.5, 3.0)),
    # A first pose that is unsure, as a track's after a jump.
    [(1 / 30, {"off": 0.12, "wide": 3.0}), (6.0, {"off": 0.12})],
    [(1 / 30, {"off": 0.5, "wide": 15.0}), (6.0, {"off": 0.5})],
    # A slow camera: at 1.5 m/s a hand would come as far, but not from rest to rest.
    *([(1 / rate, {"off": 0.1}), (4.0, {"off": 0.1, "rate": rate})] for rate in (10.0, 15.0)),
    [
        (1 / 15, {"off": 0.1}),
        (1 / 15, {"off": 0.5, "wide": 4.0}),
        (4.0, {"off": 0.1, "rate": 15.0}),
    ],
    # Now and then another pose, a right one or one that is wrong elsewhere.
    *(6 * [(1.0, {"off": 0.15}), (1 / 30, {"off": other, "wide": 2.0})] for other in (0.0, 0.4)),
]


@pytest.mark.parametrize("frames", WRONG)
def test_a_map_that_is_wrong_is_not_believed(frames):
    drive = Drive()
    drive.go(20.0, rate=frames[-1][1].get("rate", 30.0))
    drive.worst = 0.0
    for seconds, seen in frames:
        drive.go(seconds, **seen)
    assert drive.decision.standing is Standing.CONTRADICTED
    assert drive.said == []
    assert drive.worst < 5.0
    assert "; contradicted by poses " in str(drive.decision)
    if len(frames) == 1:
        drive.go(1.2)  # until then the other may come back
        assert drive.decision.standing is Standing.TRACKING
        assert drive.errors()[0] < 0.1


@pytest.mark.parametrize(("jump", "wide"), [(0.12, 3.0), (0.5, 15.0)])
def test_a_pose_that_is_unsure_moves_nothing_and_is_as_sure_as_it_says(jump, wide):
    drive = tracking()
    drive.go(1.0 / 30.0, off=jump, wide=wide)
    assert drive.decision.standing is Standing.TRACKING
    assert drive.errors()[0] < 0.03
    assert drive.errors()[1] == pytest.approx(wide * SPREAD[0] * math.sqrt(3.0), rel=0.05)


@pytest.mark.parametrize(
    ("way", "seconds", "rate", "poses"),
    [
        *(carried for poses in (False, True)
          for carried in ((1.0, 1.0, 30.0, poses), (5.0, 4.0, 30.0, poses))),
        *((*shove, rate, True) for rate in (10.0, 15.0, 30.0)
          for shove in ((0.2, 0.3), (0.3, 0.4), (0.5, 0.6))),
    ],
)  # fmt: skip
def test_a_robot_that_is_carried_or_shoved_is_found(way, seconds, rate, poses):
    drive = Drive()
    drive.go(20.0, rate=rate)
    drive.worst = 0.0
    drive.carry(way, seconds, poses=poses, rate=rate)
    drive.go(1.5, rate=rate)
    assert poses or drive.said[0].startswith("map -> odom moves the body by ")
    assert drive.decision.standing is Standing.TRACKING
    assert drive.errors()[0] < 0.1
    assert way < 1.0 or drive.worst < 5.0


@pytest.mark.parametrize(("doubt", "moved"), [(0.64, True), (0.66, False)])
def test_a_jump_that_a_body_can_have_made_is_no_ground_for_doubt(doubt, moved):
    drive = tracking()
    drive.carry(1.0, 1.0, poses=False)
    drive.go(1.5, doubt=doubt)
    assert bool(drive.said) == moved
    assert (drive.errors()[0] < 0.1) == moved
    assert drive.worst < 5.0


def test_odometry_that_starts_over_and_a_first_pose_that_is_wrong_do_not_stay():
    restarted, misled = tracking(), Drive()
    restarted.odom = place(0, 0, 0)
    misled.take(misled.pose(off=2.0))
    for drive in (restarted, misled):
        drive.go(1.5)
        assert drive.decision.standing is Standing.TRACKING
        assert drive.errors()[0] < 0.1


def test_a_pose_that_is_probably_wrong_is_no_evidence():
    drive = Drive()
    drive.go(1.0, doubt=0.7)
    assert drive.decision.standing is Standing.LOST
    drive = tracking()
    drive.go(5.0, doubt=0.7)
    assert drive.decision.standing is Standing.HELD
    # Nor does it make a jump look like a way that somebody went in the meantime.
    drive.go(3.0, off=0.5, doubt=0.7)
    drive.go(3.0, off=0.5)
    assert drive.decision.standing is Standing.CONTRADICTED
    for unsaid in (math.nan, 0.64):
        drive = tracking()
        drive.go(1.0, doubt=unsaid)
        assert drive.decision.standing is Standing.TRACKING


def test_refusals_widen_no_gate():
    drive, other = tracking(), tracking()
    drive.go(10.0, off=3.0)
    other.go(10.0, poses=False)
    assert drive.decision.smallest == pytest.approx(other.decision.smallest, rel=1e-3)


def test_acceptances_make_drift_no_larger_than_any_odometry_has():
    drive = Drive(scale=1.0, turn=0.3)  # a wheel that spins on ice
    drive.go(20.0)
    drive.go(1.0, poses=False)
    assert drive.decision.smallest[0] < 2.0


@pytest.mark.parametrize(("scale", "turn"), [(0.03, 0.005), (0.0, 0.02), (-0.1, 0.0)])
@pytest.mark.parametrize("gap", [0.3, 2.0, 30.0])
def test_the_error_stays_within_what_is_claimed(scale, turn, gap):
    worst = []
    for seed in range(2):
        drive = tracking(scale=scale, turn=turn, seed=seed)
        drive.go(gap, poses=False)
        off, claimed = drive.errors()
        assert drive.decision.standing is (Standing.HELD if gap > 0.5 else Standing.TRACKING)
        assert drive.decision.seconds == pytest.approx(gap)
        assert str(drive.decision).startswith(f"holding for {gap:.1f} s, ")
        drive.go(1.0)
        assert drive.decision.standing is Standing.TRACKING
        worst.append(drive.worst)
        assert claimed < 10.0 * off + 0.1  # and is not just large
    assert max(worst) < 4.0


def test_it_is_held_for_ever_or_as_long_as_is_wanted():
    drive = tracking(hold=2.0)
    drive.go(1.9, poses=False)
    assert drive.decision.standing is Standing.HELD
    drive.go(0.2, poses=False)
    assert drive.decision.standing is Standing.LOST
    assert drive.decision.map_from_odom is None
    assert str(drive.decision).startswith("not sent since hold ended, 2.1 s after the last frame, ")
    drive.take(drive.pose())
    assert drive.decision.standing is Standing.TRACKING
    assert str(decide(NodeConfig(), CorrectionState(), drive.at)) == "lost"


def test_a_recording_that_starts_over_is_no_jump():
    drive = tracking()
    drive.time, drive.body = 10.0, place(9, 0, 0)
    drive.take(drive.pose())
    assert drive.decision.standing is Standing.TRACKING
    assert drive.errors()[0] < 0.1
    # One that is late is left out.
    drive.go(1.0)
    before = drive.decision.state.held
    drive.time -= 0.2
    drive.take(drive.pose(off=5.0))
    assert drive.decision.state.held is before


def test_a_click_begins_where_nothing_is_known():
    drive = Drive()
    drive.go(1.0, poses=False)
    for x in (4.0, 0.3):  # the next one replaces what no pose has confirmed
        assert drive.click(x=x) == "taken: map -> odom begins with it"
    assert drive.decision.standing is Standing.HELD
    assert drive.errors() == pytest.approx((0.3, math.sqrt(0.51)), rel=1e-6)
    drive.go(3.0, poses=False)
    assert drive.errors()[0] == pytest.approx(0.3, abs=0.1)
    drive.go(0.1)  # a pose that it allows for takes its place
    assert drive.errors()[0] < 0.05
    assert drive.decision.standing is Standing.TRACKING


def test_a_click_counts_by_its_covariance():
    drive = tracking(turn=0.05)
    drive.go(20.0, poses=False)
    off, claimed = drive.errors()
    assert off > 0.3
    assert drive.click() == "taken as a measurement"
    assert drive.errors()[0] < off
    assert drive.errors()[1] < claimed
    drive = tracking()
    before = drive.decision.map_from_odom.translation
    assert drive.click(x=0.5) == "taken as a measurement"
    assert drive.decision.map_from_odom.translation == pytest.approx(before, abs=0.001)


def test_a_click_that_is_far_off_is_taken_when_it_comes_twice_or_explains_a_contradiction():
    drive = tracking()
    drive.go(2.0, poses=False)
    answer = drive.click(x=5.0)
    assert answer.startswith("refused: it lies 5 m, ")
    assert answer.endswith("; the same again is taken")
    assert drive.errors()[0] < 0.2
    drive.go(1.0, poses=False)
    assert drive.click(x=-5.0).startswith("refused: ")
    assert drive.click(x=-5.2) == "taken: it came twice"
    assert drive.errors()[0] == pytest.approx(5.2, abs=0.1)
    drive.go(1.5)  # poses that deny it are believed
    assert drive.errors()[0] < 0.1
    drive.go(3.0, off=4.0)
    assert drive.decision.standing is Standing.CONTRADICTED
    assert drive.click(x=4.0) == "taken for what contradicts it"
    assert drive.decision.standing is Standing.TRACKING
    assert drive.errors()[0] == pytest.approx(4.0, abs=0.1)


def test_the_covariance_of_the_transform_gives_that_of_the_body_back():
    drive = tracking()
    drive.go(5.0, poses=False)
    found, odom = drive.decision.map_from_odom, drive.odom
    rng, drawn = np.random.default_rng(0), []
    for error in rng.multivariate_normal(np.zeros(6), drive.decision.of_transform, 20_000):
        turned = Rotation.from_rotvec(error[3:]).as_matrix() @ found.rotation
        drawn.append(turned @ odom.translation + found.translation + error[:3])
    expected = drive.decision.covariance[:3, :3]
    assert np.cov(np.transpose(drawn)) == pytest.approx(expected, abs=0.05 * expected.max())


@pytest.mark.parametrize("two_d", [True, False])
def test_in_the_plane_the_body_has_its_x_and_y_and_heading(two_d):
    tilted = Transform(
        Rotation.from_euler("zyx", [0.7, 0.02, -0.03]).as_matrix(), np.array([3.0, 4.0, 0.2])
    )
    odometry, covariance = place(-1.0, 2.0, 0.4), np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    seen = FoundPose(Odometry(SECOND, odometry), tilted, covariance)
    decision = decide(NodeConfig(two_d_mode=two_d), CorrectionState(), seen)
    body, flat = decision.map_from_odom @ odometry, place(3.0, 4.0, 0.7)
    expected = flat if two_d else tilted
    assert body.translation == pytest.approx(expected.translation)
    assert body.rotation == pytest.approx(expected.rotation, abs=2e-3 if two_d else 1e-9)
    sure = [1, 2, 0, 0, 0, 6] if two_d else [1, 2, 3, 4, 5, 6]
    assert decision.covariance.diagonal() == pytest.approx(sure)
