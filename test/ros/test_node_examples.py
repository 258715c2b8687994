# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A matcher in 25 lines is answered by the node."""

import time

from .test_doctor import MATCHER


def test_the_client_has_a_scene_that_nothing_is_wrong_with(start_node):
    node = start_node("-p", "readout_time:=0.03")
    node.wait_for_log("active with solver")
    client = start_node(run=MATCHER, PYTHONUNBUFFERED="1")
    while client.log.count("geometry_msgs.msg.Twist(") <= 100:
        assert client.process.poll() is None, client.log
        time.sleep(0.1)
    assert client.stop() == 0
    assert "Traceback" not in client.log
    for notice in ("doubtful", "pixels_outside", "too_few_inliers", "map_scale", "lens:"):
        assert f" {notice}" not in node.log, node.log
