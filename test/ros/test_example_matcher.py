# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A localizer is answered by a pose without a matcher of one's own, and by one in 25 lines."""

import subprocess
import sys
import time
from pathlib import Path

EXAMPLES = Path(__file__).parents[2] / "examples"
MATCHER = "import sys; from rs_localizer.ros.main import example_matcher as m; sys.exit(m())"


def said(command: list[str], text: str, log: Path) -> None:
    """Wait until what a process prints has a text."""
    with log.open("w") as file:
        process = subprocess.Popen(command, stdout=file, stderr=file)
        try:
            while text not in log.read_text():
                assert process.poll() is None, log.read_text()
                time.sleep(0.1)
        finally:
            process.terminate()
            process.wait()


def test_both_are_answered_by_the_node(start_node, tmp_path):
    node = start_node("-p", "readout_time:=0.011")
    node.wait_for_log("active with solver")
    said([sys.executable, "-u", "-c", MATCHER], "twist ", tmp_path / "example_matcher.log")
    client = [sys.executable, "-u", str(EXAMPLES / "03_node_client.py")]
    said(client, "geometry_msgs.msg.Twist(", tmp_path / "client.log")
