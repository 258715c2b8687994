# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The correction of odometry between and without frames: where it is, and how sure of it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.io.outputs import BodyPose, Localized
from rs_localizer.io.transforms import Transform
from rs_localizer.pipeline.map_to_odom import MapToOdom, corrected

SECOND = 10**9


def place(x: float, y: float, yaw: float, z: float = 0.0) -> Transform:
    return Transform(Rotation.from_euler("z", yaw).as_matrix(), np.array([x, y, z]))


def found(stamp_ns: int, at: Transform, deviation: float = 0.01) -> Localized:
    """A frame that has found the body there."""
    pose = BodyPose(at.translation, at.rotation, deviation**2 * np.eye(6))
    return Localized(
        input_stamp_ns=stamp_ns, stamp_ns=stamp_ns, map_frame="map", body_frame="base_link",
        pose=pose, twist=None, inliers=np.zeros(0), dropped=0, estimate=None,
    )  # fmt: skip


def test_in_the_plane_the_body_has_its_x_and_y_and_heading():
    tilted = Transform(
        Rotation.from_euler("zyx", [0.7, 0.02, -0.03]).as_matrix(), np.array([3.0, 4.0, 0.2])
    )
    odometry = place(-1.0, 2.0, 0.4)
    flat = corrected(tilted, odometry, two_d=True)
    body = flat @ odometry
    assert body.translation == pytest.approx([3.0, 4.0, 0.0])
    assert Rotation.from_matrix(body.rotation).as_euler("zyx") == pytest.approx(
        [0.7, 0, 0], abs=1e-3
    )
    whole = corrected(tilted, odometry, two_d=False) @ odometry
    assert whole.translation == pytest.approx(tilted.translation)
    assert whole.rotation == pytest.approx(tilted.rotation)


def test_in_the_plane_it_is_as_sure_as_of_x_and_y_and_heading():
    frame = found(SECOND, place(1, 0, 0))
    frame.pose.covariance[...] = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    for two_d, expected in ((True, [3.0, 6.0]), (False, [6.0, 15.0])):
        correction = MapToOdom()
        correction.take(frame, place(0, 0, 0), two_d=two_d)
        holding = correction.holding(SECOND, place(0, 0, 0), 0.0)
        assert [holding.position**2, holding.angle**2] == pytest.approx(expected)


def drive(rng: np.random.Generator, scale: float, turn: float) -> tuple[list, list]:
    """A minute of a robot at 0.5 m/s with turns, 30 frames a second; odometry is off like this."""
    truth, odometry = [place(0, 0, 0)], [place(5, 3, 1.0)]
    for i in range(1, 1800):
        rate = 0.4 * np.sin(i / 200.0)
        truth.append(truth[-1] @ place(0.5 / 30, 0.0, rate / 30))
        odometry.append(
            odometry[-1]
            @ place(0.5 / 30 * (1 + scale) + rng.normal(0, 1e-4), 0.0, (rate + turn) / 30)
        )
    return truth, odometry


@pytest.mark.parametrize(("scale", "turn"), [(0.03, 0.005), (0.0, 0.02), (-0.1, 0.0)])
@pytest.mark.parametrize("gap", [9, 60, 900])
def test_the_error_stays_within_what_is_claimed(scale, turn, gap):
    inside, total = 0, 0
    for seed in range(2):
        rng = np.random.default_rng(seed)
        truth, odometry = drive(rng, scale, turn)
        correction = MapToOdom()
        for i, (body, odom) in enumerate(zip(truth, odometry, strict=True)):
            stamp = i * SECOND // 30
            if i < 600:  # twenty seconds with frames, then none
                off = place(*rng.normal(0, 0.01, 3), z=rng.normal(0, 0.01))
                assert correction.take(found(stamp, body @ off), odom, two_d=False) == ""
            elif i < 600 + gap:
                error = correction.held(stamp, 0.0) @ odom
                claimed = correction.holding(stamp, odom, 0.0)
                off = np.linalg.norm(error.translation - body.translation)
                inside += off < 2.0 * claimed.position
                total += 1
                assert off < 4.0 * claimed.position
    assert inside > 0.9 * total
    assert claimed.seconds == pytest.approx(gap / 30.0)


def test_a_jump_that_nothing_explains_is_told():
    correction = MapToOdom()
    odom = place(2, 0, 0)
    correction.take(found(SECOND, place(1, 0, 0)), odom, two_d=False)
    assert correction.take(found(2 * SECOND, place(1.05, 0, 0)), odom, two_d=False) == ""
    told = correction.take(found(3 * SECOND, place(1.5, 0, 0.4)), odom, two_d=False)
    assert told.startswith("map -> odom jumps by 45 cm and 23 deg after 1.0 s, ")
    # A recording that starts over is none.
    assert correction.take(found(SECOND, place(9, 0, 0)), odom, two_d=False) == ""


def test_it_is_held_for_ever_or_as_long_as_is_wanted():
    correction = MapToOdom()
    assert correction.held(SECOND, 0.0) is None
    assert correction.holding(SECOND, place(0, 0, 0), 0.0) is None
    assert correction.take(found(SECOND, place(1, 0, 0)), place(0, 0, 0), two_d=False) == ""
    for hold, seconds, there in ((0.0, 1e4, True), (2.0, 1.9, True), (2.0, 2.1, False)):
        now = SECOND + round(seconds * SECOND)
        held = correction.held(now, hold)
        assert (held is not None) == there
        # What is said of it is what is sent of it.
        said = str(correction.holding(now, place(0, 0, 0), hold))
        assert said.startswith(f"holding for {seconds:.1f} s, " if there else "not sent since hold")
    correction.forget()
    assert correction.held(SECOND, 0.0) is None
