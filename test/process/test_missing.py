# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Packages that are not installed: one sentence, whoever is started."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rs_localizer.process.missing import BESIDE_ROS, BOUNDS

ROOT = Path(__file__).parents[2]
COMMAND = "import sys; from rs_localizer.__main__ import run; sys.exit(run())"
NODE = "import sys; from rs_localizer.ros.main import main; sys.exit(main())"
DETECTOR = "import sys; from rs_localizer.ros.main import marker_detector as m; sys.exit(m())"
# Nobody waits for what only commands need.
NOT_FOR_NODES = ("rosbags", "matplotlib", "scipy", "PIL", "tqdm")


def without(tmp_path: Path, *names: str) -> dict[str, str]:
    """An environment in which packages seem not to be installed."""
    for name in names:
        text = f"raise ModuleNotFoundError(\"No module named '{name}'\", name='{name}')\n"
        (tmp_path / f"{name}.py").write_text(text)
    hook = (
        "import importlib.util as u\nfind = u.find_spec\n"
        f"u.find_spec = lambda name, *a: None if name in {names!r} else find(name, *a)\n"
    )
    (tmp_path / "sitecustomize.py").write_text(hook)
    path = [str(tmp_path), str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path)}


def run(code: str, environment: dict[str, str], *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", code, *words]
    return subprocess.run(command, env=environment, text=True, capture_output=True, check=False)


@pytest.mark.parametrize(
    ("name", "words", "advice"),
    [
        (
            "scipy",
            ("calibrate", "video.mp4"),
            "sudo apt install python3-scipy, or pip install scipy",
        ),
        ("rosbags", ("evaluate", "a", "b"), f'pip install "rosbags{BOUNDS["rosbags"]}"; '),
        ("rosbags", ("evaluate", "a", "b"), BESIDE_ROS),
    ],
)
def test_a_command_says_it_in_one_line(tmp_path, name, words, advice):
    done = run(COMMAND, without(tmp_path, name), *words)
    assert done.returncode == 1
    assert done.stderr.startswith(
        f"rs_localizer {words[0]}: the Python package {name} is not installed: "
    )
    assert advice in done.stderr
    assert done.stderr.count("\n") == 1


PACKAGE = "the Python package {} is not installed: sudo apt install "


@pytest.mark.parametrize(
    ("name", "code", "said"),
    [
        ("numpy", NODE, f"localizer: {PACKAGE}"),
        ("yaml", DETECTOR, f"marker_detector: {PACKAGE}"),
        ("rclpy", NODE, "localizer: No module named '{}'; source a ROS 2 workspace"),
    ],
)
def test_a_node_says_it_in_one_line(tmp_path, name, code, said):
    pytest.importorskip("rclpy", reason="needs ROS 2")
    done = run(code, without(tmp_path, name))
    assert done.returncode == 1
    assert done.stderr.startswith(said.format(name))
    assert done.stderr.count("\n") == 1


def test_nodes_do_not_wait_for_packages_of_commands(tmp_path):
    pytest.importorskip("rclpy", reason="needs ROS 2")
    code = "import rs_localizer.ros.node.managed, rs_localizer.ros.detector.markers"
    done = run(code, without(tmp_path, *NOT_FOR_NODES))
    assert (done.returncode, done.stderr) == (0, "")
