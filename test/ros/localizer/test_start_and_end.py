# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The node from its start to its end: signals, arguments that are wrong, what it says of itself."""

import os
import signal
import time

# A module that tells that it is being imported, and takes its time.
SLOW = "import pathlib, time; pathlib.Path(__file__).with_suffix('.seen').touch(); time.sleep(9999)"


def test_signals_while_it_imports(start_node, tmp_path):
    (tmp_path / "rclpy.py").write_text(SLOW)
    node = start_node(PYTHONPATH=f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    while not (tmp_path / "rclpy.seen").exists():
        assert node.process.poll() is None, node.log
        time.sleep(0.02)
    assert node.stop(signal.SIGTERM) == 0
    assert node.log == ""


def test_started_with_bad_parameters(start_node):
    node = start_node("--params-file", "/nowhere.yaml")
    assert node.process.wait() == 1
    fatal = [line for line in node.log.splitlines() if line.startswith("[FATAL]")]
    assert len(fatal) == 1
    assert "/nowhere.yaml" in fatal[0]
    assert "Traceback" not in node.log


def test_an_end_that_the_middleware_holds_up_is_cut_short(start_node):
    """Launch files kill what has not ended after five seconds."""
    node = start_node(
        run="import rclpy, sys, time; rclpy.try_shutdown = lambda: time.sleep(9999);"
        "from rs_localizer.ros.main import main; sys.exit(main())"
    )
    node.wait_for_log("active with solver")
    assert node.stop(signal.SIGTERM) == 0
    assert "did not end within 4 s" in node.log
    assert "in run" in node.log


def test_what_it_says_at_start_and_an_end_by_signals(start_node, tmp_path):
    file = tmp_path / "params.yaml"
    file.write_text("/**:\n  ros__parameters: {min_inlier: 9, use_sim_time: false}\n")
    node = start_node("--params-file", str(file), "-p", "readout_tim:=0.1")
    node.wait_for_log("active with solver")
    lines = [line.partition("]: ")[2] for line in node.log.splitlines()]
    ignored = "a parameter is ignored: {} is not a setting; did you mean {}?"
    assert [line for line in lines if "ignored" in line] == [
        ignored.format("'min_inlier'", "min_inliers"),
        ignored.format("'readout_tim'", "readout_time"),
    ]
    silent = "readout_time is 0 (unknown): no twist is published and frames are not tracked"
    assert lines.count(silent) == 1
    assert node.stop(signal.SIGINT, signal.SIGINT, signal.SIGTERM, signal.SIGTERM) == 0
    assert "Traceback" not in node.log
    assert "rror" not in node.log
