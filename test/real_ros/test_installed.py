# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The package as it is installed in a workspace of ROS 2: `make ros`, every night in containers.

Everything here needs the tools of a ROS machine, and says so where there is none.
"""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

if shutil.which("ros2") is None or "ROS_DISTRO" not in os.environ:
    pytest.skip("ROS 2 is not installed here: source its setup.sh", allow_module_level=True)

LAUNCHES = sorted(path.name for path in (Path(__file__).parents[2] / "launch").glob("*.launch.py"))


def ros2(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["ros2", *words], capture_output=True, text=True, check=False)


def until(text: str, *words: str) -> str:
    """What a command says, once it has said this."""
    while text not in (said := ros2(*words)).stdout:
        time.sleep(1.0)
    return said.stdout


@pytest.fixture(scope="module")
def flight(tmp_path_factory: Any) -> Path:
    """A simulated recording, as the installed command writes it."""
    folder: Path = tmp_path_factory.mktemp("flight")
    run = ["run", "rs_localizer", "rs_localizer", "simulate", str(folder / "flight")]
    done = ros2(*run)
    assert done.returncode == 0, done.stderr
    return folder / "flight"


@contextmanager
def launching(file: str, *words: str) -> Iterator[subprocess.Popen[str]]:
    """A launch file, in a process group of its own."""
    process = subprocess.Popen(
        ["ros2", "launch", "rs_localizer", file, *words],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
        process.communicate()


@pytest.fixture
def launched(flight: Path) -> Iterator[subprocess.Popen[str]]:
    """localizer.launch.py with the recording's parameters."""
    parameters = f"params_file:={flight / 'parameters.yaml'}"
    with launching("localizer.launch.py", parameters, "use_sim_time:=true") as process:
        yield process


# Beside the localizer, what each starts by these arguments.
NODES = {
    "localizer.launch.py": (),
    "features.launch.py": ("/feature_detector",),
    "markers.launch.py": ("/marker_detector",),
    "rig.launch.py": ("/front/marker_detector", "/rear/marker_detector"),
}


@pytest.mark.parametrize("file", LAUNCHES)
def test_each_launch_file_starts_its_nodes(file: str, tmp_path: Path) -> None:
    words = ["readout_time:=0.02"]
    if file in ("markers.launch.py", "rig.launch.py"):
        made = ros2(
            "run", "rs_localizer", "rs_localizer", "markers", "make", str(tmp_path / "wall")
        )
        assert made.returncode == 0, made.stderr
        words.append(f"marker_map:={tmp_path / 'wall.yaml'}")
    if file == "rig.launch.py":
        words.append("cameras:=front, rear")
    with launching(file, *words) as process:
        for node in ("/rs_localizer", *NODES[file]):
            until("active", "lifecycle", "get", node)
        assert process.poll() is None


@pytest.mark.parametrize("file", LAUNCHES)
def test_each_launch_file_says_its_arguments(file: str) -> None:
    done = ros2("launch", "rs_localizer", file, "--show-args")
    assert done.returncode == 0, done.stderr
    assert "'readout_time'" in done.stdout


@pytest.mark.parametrize("file", ["localizer.launch.py", "markers.launch.py"])
def test_a_value_that_no_setting_has_makes_the_launch_fail(file: str) -> None:
    done = ros2("launch", "rs_localizer", file, "readout_time:=abc")
    assert done.returncode != 0
    assert "readout_time must be of type float, got 'abc'" in done.stdout + done.stderr


def test_a_bag_is_played_to_the_node(launched: Any, flight: Path) -> None:
    until("active", "lifecycle", "get", "/rs_localizer")
    # ros2 topic echo ends after one message.
    echo = subprocess.Popen(
        ["ros2", "topic", "echo", "--once", "/rs_localizer/pose"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    while echo.poll() is None:  # again, until it had found the topic in time
        played = ros2("bag", "play", str(flight), "--clock")
        assert played.returncode == 0, played.stderr
    said, _ = echo.communicate()
    assert "orientation:" in said
    assert launched.poll() is None


def test_the_life_cycle_goes_round(launched: Any) -> None:
    until("active", "lifecycle", "get", "/rs_localizer")
    for change in ("deactivate", "cleanup", "configure", "activate"):
        done = ros2("lifecycle", "set", "/rs_localizer", change)
        assert "successful" in done.stdout, done.stdout + done.stderr


def test_our_transforms_are_those_of_tf2() -> None:
    code = """
import numpy as np, tf2_ros
from geometry_msgs.msg import TransformStamped
from rclpy.time import Time
from types import SimpleNamespace
from rs_localizer.io.transforms import TransformTree, read_transform
rng = np.random.default_rng(0)
tree, buffer = TransformTree(), tf2_ros.Buffer()
for parent, child in (("map", "odom"), ("odom", "base"), ("base", "camera")):
    for second in (1, 2, 3):
        item = TransformStamped(child_frame_id=child)
        item.header.frame_id, item.header.stamp.sec = parent, second
        q = rng.normal(size=4)
        q /= np.linalg.norm(q)
        t, r = item.transform.translation, item.transform.rotation
        t.x, t.y, t.z = rng.normal(size=3)
        r.x, r.y, r.z, r.w = q
        buffer.set_transform(item, "test")
        tree.add(SimpleNamespace(transforms=[item]), static=False)
for ns in (1_000_000_000, 1_234_567_890, 2_900_000_000):
    for target, source in (("map", "camera"), ("camera", "odom")):
        theirs = buffer.lookup_transform(target, source, Time(nanoseconds=ns)).transform
        theirs, ours = read_transform(theirs), tree.lookup(target, source, ns)
        assert np.allclose(theirs.rotation, ours.rotation, rtol=0, atol=1e-12)
        assert np.allclose(theirs.translation, ours.translation, rtol=0, atol=1e-12)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
