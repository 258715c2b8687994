# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The node from its start to its end: signals, arguments that are wrong, what it says of itself."""

import os
import re
import signal
import time
from typing import Any

import pytest
import rclpy
from rclpy.context import Context

from rs_localizer.io.outputs import TYPES
from rs_localizer.ros.localizer.node import LocalizerNode
from rs_localizer.ros.node import managed
from rs_localizer.ros.node.inputs import Inputs


def test_signals_end_it_in_order(start_node):
    node = start_node()
    node.wait_for_log("active with solver")
    assert node.stop(signal.SIGINT, signal.SIGINT, signal.SIGTERM, signal.SIGTERM) == 0
    assert "Traceback" not in node.log
    assert "rror" not in node.log


# A module that tells that it is being imported, and takes its time.
SLOW = "import pathlib, time; pathlib.Path(__file__).with_suffix('.seen').touch(); time.sleep(60)"


def test_signals_while_it_imports(start_node, tmp_path):
    (tmp_path / "rclpy.py").write_text(SLOW)
    node = start_node(PYTHONPATH=f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    while not (tmp_path / "rclpy.seen").exists():
        assert node.process.poll() is None, node.log
        time.sleep(0.02)
    assert node.stop(signal.SIGTERM) == 0
    assert node.log == ""


def test_missing_ros_is_said_in_one_line(start_node, tmp_path):
    text = "No module named 'rclpy'"
    (tmp_path / "rclpy.py").write_text(f"raise ModuleNotFoundError({text!r}, name='rclpy')")
    node = start_node(PYTHONPATH=f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    assert node.process.wait(60.0) == 1
    assert node.log.startswith(f"localizer: {text}; source a ROS 2 workspace")
    assert node.log.count("\n") == 1


def test_signals_while_it_compiles(start_node, tmp_path):
    cache = tmp_path / "cache"
    node = start_node(XDG_CACHE_HOME=str(cache))
    deadline = time.monotonic() + 60.0
    # The first kernel in the cache: the second is being compiled, and there are many.
    while not list(cache.rglob("*.nbc")):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert node.stop(signal.SIGINT, signal.SIGINT) == 0
    assert "active" not in node.log
    assert "Traceback" not in node.log


def test_started_with_bad_parameters(start_node):
    node = start_node("--params-file", "/nowhere.yaml")
    assert node.process.wait(60.0) == 1
    fatal = [line for line in node.log.splitlines() if line.startswith("[FATAL]")]
    assert len(fatal) == 1
    assert "/nowhere.yaml" in fatal[0]
    assert "Traceback" not in node.log


@pytest.mark.parametrize(
    ("override", "text"),
    [
        ("/correspondences.subscription.depth:=ten", "not activated: .*ten"),
        ("/rs_localizer/pose.publisher.depth:=ten", "not configured:"),
    ],
)
def test_qos_overrides_that_make_no_qos(start_node, override, text):
    node = start_node("-p", f"qos_overrides.{override}")
    assert node.process.wait(60.0) == 1
    errors = [line for line in node.log.splitlines() if line.startswith("[ERROR]")]
    assert len(errors) == 1
    assert re.search(text, errors[0], re.IGNORECASE)


def test_publishers_are_active_before_a_frame_can_come(monkeypatch):
    active: list[bool] = []

    class Early(Inputs):
        def __init__(self, node: LocalizerNode, *arguments: Any) -> None:
            publishers = node._outputs._publishers.values()
            active.extend(publisher.is_activated for publisher in publishers)
            super().__init__(node, *arguments)

    monkeypatch.setattr(managed, "Inputs", Early)
    context = Context()
    rclpy.init(context=context)
    node = LocalizerNode(context=context)
    try:
        node.trigger_configure()
        node.trigger_activate()
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
    assert active == [True] * len(TYPES)


def test_what_it_says_at_start(start_node, tmp_path):
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
        ignored.format("'min_inlier'", "'min_inliers'"),
        ignored.format("'readout_tim'", "'readout_time'"),
    ]
    silent = "readout_time is 0 (unknown): no twist is published and frames are not tracked"
    assert lines.count(silent) == 1
