# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A matcher in 25 lines is answered by the node; PX4 hears the node's poses."""

import contextlib
import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from nav_msgs.msg import Odometry
from std_msgs.msg import String

EXAMPLES = Path(__file__).parents[2] / "examples"
CLIENT = str(EXAMPLES / "03_node_client.py")
PX4 = str(EXAMPLES / "px4_odometry.py")
# PX4's message for those who have none: what the example fills in, as text.
STAND_IN = """
import json
import numpy as np
from std_msgs.msg import String
class VehicleOdometry(String):
    def __init__(self, **fields):
        super().__init__(data=json.dumps(fields, default=np.ndarray.tolist))
"""


def until(is_so: Callable[[], bool], process: subprocess.Popen[bytes], log: Path) -> None:
    while not is_so():
        assert process.poll() is None, log.read_text()
        time.sleep(0.1)


@contextlib.contextmanager
def started(command: list[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process that ends by Ctrl-C, with nothing to say about it."""
    with log.open("w") as file:
        process = subprocess.Popen(command, stdout=file, stderr=file)
        try:
            yield process
            process.send_signal(signal.SIGINT)
            assert process.wait() == 0, log.read_text()
            assert "Traceback" not in log.read_text()
        finally:
            process.kill()
            process.wait()


def test_the_client_has_a_scene_that_nothing_is_wrong_with(start_node, tmp_path):
    node = start_node("-p", "readout_time:=0.03")
    node.wait_for_log("active with solver")
    log = tmp_path / "client.log"
    with started([sys.executable, "-u", CLIENT], log) as client:
        until(lambda: log.read_text().count("geometry_msgs.msg.Twist(") > 100, client, log)
    for notice in ("doubtful", "pixels_outside", "too_few_inliers", "map_scale", "lens:"):
        assert f" {notice}" not in node.log, node.log


def test_px4_hears_what_the_node_says(peer, tmp_path, monkeypatch):
    (tmp_path / "px4_msgs").mkdir()
    (tmp_path / "px4_msgs" / "__init__.py").touch()
    (tmp_path / "px4_msgs" / "msg.py").write_text(STAND_IN)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    heard: list[str] = []
    peer.node.create_subscription(
        String, "/fmu/in/vehicle_visual_odometry", lambda it: heard.append(it.data), 10
    )
    out = peer.node.create_publisher(Odometry, "/rs_localizer/odometry", 10)
    message = Odometry()
    message.pose.pose.orientation.w = 1.0
    message.pose.pose.position.y = 3.0
    log = tmp_path / "px4.log"
    with started([sys.executable, "-u", PX4, "ned"], log) as process:

        def answered() -> bool:
            out.publish(message)
            return peer.spin_until(lambda: heard, 0.1)

        until(answered, process, log)
    assert json.loads(heard[0])["position"] == [3.0, 0.0, 0.0]  # north, of x east and y north
