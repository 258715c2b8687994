# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer watch``: what a node publishes, as text; clean ends."""

import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from scipy.spatial.transform import Rotation

from rs_localizer.ros.graph.watch import Status, Values, Watched, euler, table

WATCH = [sys.executable, "-m", "rs_localizer", "watch"]


def seen() -> Watched:
    watched = Watched("/front/rs_localizer")
    deviations = np.array([0.003, 0.0, 0.004, 0.0, np.radians(0.3), 0.0])
    pose = Values(np.array([1.0, -2.0, 0.5]), np.radians([10.0, 20.0, 30.0]), deviations)
    for k in range(11):
        watched.arrived(pose, 100.0 + 0.05 * k)
    return watched


def test_a_table_has_a_line_for_each_quantity():
    watched = seen()
    watched.twist = Values(np.array([0.1, 0.0, 0.0]), np.radians([0.0, 90.0, 0.0]), np.ones(6))
    values = {"State": "tracking", "Refused: residual": "3", "Points": "24"}
    watched.status = Status(1, "3 frames were refused", values)
    lines = table(watched, 100.6)
    assert lines[0] == "/front/rs_localizer: tracking, 20.0 Hz"
    assert [text.split()[0] for text in lines[1:5]] == ["position", "roll", "linear", "angular"]
    assert "+90.00" in lines[4]
    assert lines[5:] == ["warning: 3 frames were refused", "refused: residual 3"]


def test_angles_are_those_of_rep_103():
    turn = Rotation.from_euler("z", 30, degrees=True) * Rotation.from_euler("x", 10, degrees=True)
    np.testing.assert_allclose(np.degrees(euler(turn.as_quat())), [10.0, 0.0, 30.0], atol=1e-9)
    up = Rotation.from_euler("y", 90, degrees=True)
    assert np.all(np.isfinite(euler(up.as_quat())))


class Node:
    """Stands for a localizer in the namespace /front."""

    def __init__(self, peer: Any) -> None:
        def make(kind: Any, topic: str) -> Any:
            return peer.node.create_publisher(kind, topic, 10)

        self._pose = make(PoseWithCovarianceStamped, "/front/rs_localizer/pose_with_covariance")
        self._twist = make(TwistWithCovarianceStamped, "/front/rs_localizer/twist_with_covariance")
        self._status = make(DiagnosticArray, "/diagnostics")

    def publish(self) -> None:
        pose, twist = PoseWithCovarianceStamped(), TwistWithCovarianceStamped()
        pose.pose.pose.position.x, pose.pose.pose.orientation.w = 7.25, 1.0
        pose.pose.covariance[0] = 0.01**2
        twist.twist.twist.linear.z = -1.5
        status = DiagnosticStatus(level=b"\x00", message="tracking with 24 of 24 points")
        status.name = "front/rs_localizer: localizer"
        status.values = [KeyValue(key="State", value="tracking")]
        self._pose.publish(pose)
        self._twist.publish(twist)
        self._status.publish(DiagnosticArray(status=[status]))


def told(peer: Any, node: Node, file: Path, wanted: str) -> str:
    def heard() -> bool:
        node.publish()
        return bool(re.search(wanted, file.read_text()))

    assert peer.spin_until(heard), file.read_text()
    return file.read_text()


def test_a_live_node_in_lines(peer, tmp_path):
    node, file = Node(peer), tmp_path / "said"
    with file.open("w") as output:
        watching = subprocess.Popen(
            [*WATCH, "front/rs_localizer", "--every", "0.1"], stdout=output, stderr=subprocess.PIPE
        )
    told(peer, node, file, r"tracking, \S+ Hz \| xyz +\+7\.250 .* m \+-10\.0 mm.*v .* -1\.50 .*ok:")
    watching.send_signal(signal.SIGINT)
    _, errors = watching.communicate(timeout=30)
    assert (watching.returncode, errors) == (130, b"rs_localizer watch: interrupted\n")
    assert "\x1b" not in file.read_text()


@pytest.mark.usefixtures("domain")
def test_without_a_node_it_says_what_is_missing_and_who_is_there(peer):
    node = Node(peer)
    watching = subprocess.Popen(
        [*WATCH, "--every", "0.1"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    assert watching.stdout is not None
    wanted = "no publisher on /rs_localizer/pose_with_covariance (ROS_DOMAIN_ID "
    while "there is /front/rs_localizer" not in (said := watching.stdout.readline()):
        assert said.startswith(wanted)
        node.publish()
    # As with | head.
    watching.stdout.close()
    assert watching.wait(30) == 141
    assert watching.stderr is not None
    assert watching.stderr.read() == ""
    watching.stderr.close()
