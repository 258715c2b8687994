# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The node from its start to its end: signals, arguments that are wrong, what it says of itself."""

import os
import re
import signal
import time

from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import GetState
from rcl_interfaces.srv import GetParameters

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
        "from rs_localizer.ros.main import main; sys.exit(main())",
    )
    node.wait_for_log("loading kernels")
    assert node.stop(signal.SIGTERM) == 0
    assert "did not end within 4 s" in node.log
    assert "in run" in node.log


def test_what_it_says_at_start_and_an_end_by_signals(start_node, tmp_path):
    file = tmp_path / "params.yaml"
    file.write_text("/**:\n  ros__parameters: {min_inlier: 9, use_sim_time: false}\n")
    node = start_node("--params-file", str(file), "-p", "readout_tim:=0.1")
    node.wait_for_log("active with solver")
    lines = [line.partition("]: ")[2] for line in node.log.splitlines()]
    prepares = re.compile(r"(compiling|loading) kernels.*")  # whether they are on disk already
    compiling = [bool(prepares.fullmatch(line)) for line in lines].index(True)
    ready = re.compile(r"kernels are ready after \d+\.\d s")
    # On a busy machine the node says in between what it waits for.
    assert len([line for line in lines[compiling:] if ready.fullmatch(line)]) == 1
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


def test_services_answer_and_signals_end_it_while_kernels_are_compiled(start_node, peer, tmp_path):
    states: list[tuple[bytes, str]] = []

    def take(message: DiagnosticArray) -> None:
        for status in message.status:
            states.append((status.level, {it.key: it.value for it in status.values}["State"]))

    peer.node.create_subscription(DiagnosticArray, "/diagnostics", take, 10)
    node = start_node(XDG_CACHE_HOME=str(tmp_path / "cache"))
    node.wait_for_log("compiling kernels")
    service = "/rs_localizer/get_parameters"
    first = GetParameters.Request(names=["solver"])
    # A few of some hundred are compiled by then.
    while len(list(tmp_path.rglob("*.nbc"))) < 4:
        values = peer.call(GetParameters, service, first).values
        assert [value.string_value for value in values] == ["r6p_vcwt"]
        state = peer.call(GetState, "/rs_localizer/get_state", GetState.Request())
        assert state.current_state.label == "unconfigured"
    # Diagnostics come once a second, and are heard when they have found us.
    assert peer.spin_until(lambda: (b"\1", "compiling") in states)
    assert "kernels are ready" not in node.log
    assert node.stop(signal.SIGINT, signal.SIGINT) == 0
    assert "active" not in node.log
    assert "Traceback" not in node.log
