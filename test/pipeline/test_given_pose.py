# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A pose from outside: what it says of the camera, and when it is not used."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.config import NodeConfig
from rs_localizer.io.bags import make_message
from rs_localizer.io.messages import MessageError, make_header, make_quaternion, make_vector
from rs_localizer.io.transforms import Transform, TransformTree, make_transform
from rs_localizer.pipeline.aid import Moment
from rs_localizer.pipeline.given_pose import PosePrior, read_given_pose

SECOND = 10**9
CONFIG = NodeConfig(readout_time=0.03, base_frame="base_link")
# The camera looks to the left of the robot, half a metre before its axle.
MOUNT = Transform(
    Rotation.from_euler("xyz", [-90, 0, 0], degrees=True).as_matrix(), np.array([0.5, 0.0, 1.0])
)


def given(
    stamp_ns: int = 5 * SECOND, frame: str = "map", body: str = "",
    variances: Any = (0.25, 0.25, 0, 0, 0, 0.0685),
) -> Any:  # fmt: skip
    """As RViz sends it: a robot at (2, 3), turned to the left."""
    rotation = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    pose = make_message(
        "geometry_msgs/msg/Pose",
        position=make_vector(make_message, np.array([2.0, 3.0, 0.0]), "Point"),
        orientation=make_quaternion(make_message, rotation),
    )
    own = {"pose": pose, "covariance": np.diag(variances).astype(float).ravel()}
    message: Any = {
        "header": make_header(make_message, stamp_ns, frame),
        "pose": make_message("geometry_msgs/msg/PoseWithCovariance", **own),
    }
    return SimpleNamespace(**message, **({"child_frame_id": body} if body else {}))


def moment(time_ns: int, tree: TransformTree) -> Moment:
    tracker: Any = None
    return Moment(tracker, CONFIG, time_ns, "camera", tree)


def asked(message: Any, time_ns: int = 5 * SECOND) -> tuple[Any, list[str], PosePrior]:
    notices: list[str] = []
    tree = TransformTree()
    stamped = make_transform(make_message, 0, "base_link", "camera", MOUNT)
    tree.add(SimpleNamespace(transforms=[stamped]), static=True)
    prior = PosePrior(lambda name, text: notices.append(f"{name}: {text}"))
    prior.given = read_given_pose(message)
    return prior.prior(moment(time_ns, tree), "map"), notices, prior


def test_what_a_click_says_of_the_camera():
    found, notices, _ = asked(given())
    assert notices == []
    map_from_camera = found.motion.rotation.T
    centre = -map_from_camera @ found.motion.translation
    assert centre == pytest.approx([2.0, 3.5, 1.0])  # before the robot, which looks along y
    assert map_from_camera[:, 2] == pytest.approx([-1.0, 0.0, 0.0], abs=1e-9)
    deviations = np.sqrt(np.diag(found.covariance))
    # Camera axes: right is along y, down against z, forward against x. The heading turns about the
    # vertical, and moves the camera sideways by half a metre times that.
    heading = np.sqrt(0.0685 + 0.005**2)
    assert deviations[:3] == pytest.approx([0.05, heading, 0.05], rel=1e-3)
    expected = [0.5, 0.1, np.hypot(0.5, 0.5 * heading)]
    assert deviations[3:6] == pytest.approx(expected, rel=0.05)
    assert deviations[6:] == pytest.approx([6 * 0.03] * 3 + [3 * 0.03] * 3)


@pytest.mark.parametrize(
    ("message", "time_ns", "text"),
    [
        (given(frame="odom"), 5 * SECOND, "it is in 'odom', the points are in 'map'"),
        (given(), 16 * SECOND, "it is 11 s older, or newer, than the frame"),
        (given(body="trailer"), 5 * SECOND, "frame 'trailer' does not exist"),
    ],
)
def test_what_cannot_be_used_is_said_once(message, time_ns, text):
    found, (notice,), prior = asked(message, time_ns)
    assert found is None
    assert notice.startswith("prior_refused: the given pose is not used: ")
    assert text in notice
    assert prior.prior(moment(time_ns, TransformTree()), "map") is None


@pytest.mark.parametrize(("body", "lasts"), [("", False), ("base_link", True)])
def test_a_click_counts_once_and_a_filter_again_and_again(body, lasts):
    found, notices, prior = asked(given(body=body))
    at_it = SimpleNamespace(
        rotation=found.motion.rotation, covariance=1e-6 * np.eye(12),
        position=-found.motion.rotation.T @ found.motion.translation,
    )  # fmt: skip
    prior.judge_result(at_it)
    assert notices == []
    assert (prior.given is not None) == lasts
    _, notices, prior = asked(given(body=body))
    at_it.position = np.add(at_it.position, [0.0, 0.0, 5.0])
    prior.judge_result(at_it)
    assert notices[0].startswith(
        "prior_refused: the points disagree with the given pose, by 5.00 m"
    )


def test_covariances_that_are_none_are_named():
    for variance, shared, fault in (
        (np.nan, 0.0, "numbers that are not finite"),
        (np.inf, 0.0, "numbers that are not finite"),
        (-0.25, 0.0, r"variances below zero: \[1.0, -0.25, "),
        (1.0, 2.0, "correlations have an eigenvalue of -1"),
    ):
        message = given(variances=(1.0, variance, 1.0, 1.0, 1.0, 1.0))
        message.pose.covariance[1] = message.pose.covariance[6] = shared
        with pytest.raises(MessageError, match=fault):
            read_given_pose(message)


@pytest.mark.parametrize("variance", [1e-12, 1.0, 1e12, 1e30, np.finfo(float).max])
def test_numbers_that_a_filter_takes_for_one_are_a_prior(variance):
    """A prior that no frame can use would cost all of them their poses."""
    message = given()
    message.pose.covariance[:] = variance
    found, notices, _ = asked(message)
    assert notices == []
    assert found.covariance[0, 0] >= 0.9 * min(variance, 1e12)
