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


MISSING = "the Python package {} is not installed: "


@pytest.mark.parametrize(
    ("name", "code", "words", "said", "advice"),
    [
        ("scipy", COMMAND, ("calibrate", "video.mp4"), f"rs_localizer calibrate: {MISSING}",
         "sudo apt install python3-scipy, or pip install scipy"),
        ("rosbags", COMMAND, ("evaluate", "a", "b"), f"rs_localizer evaluate: {MISSING}",
         f'pip install "rosbags{BOUNDS["rosbags"]}"; '),
        ("rosbags", COMMAND, ("evaluate", "a", "b"), f"rs_localizer evaluate: {MISSING}",
         BESIDE_ROS),
        ("numpy", NODE, (), f"localizer: {MISSING}", "sudo apt install "),
        ("yaml", DETECTOR, (), f"marker_detector: {MISSING}", "sudo apt install "),
        ("rclpy", NODE, (), "localizer: No module named '{}'; source a ROS 2 workspace", ""),
    ],
)  # fmt: skip
def test_it_is_said_in_one_line(tmp_path, name, code, words, said, advice):
    if code != COMMAND:
        pytest.importorskip("rclpy", reason="needs ROS 2")
    done = run(code, without(tmp_path, name), *words)
    assert done.returncode == 1
    assert done.stderr.startswith(said.format(name))
    assert advice in done.stderr
    assert done.stderr.count("\n") == 1


def test_nodes_do_not_wait_for_packages_of_commands(tmp_path):
    pytest.importorskip("rclpy", reason="needs ROS 2")
    code = "import rs_localizer.ros.node.managed, rs_localizer.ros.detector.markers"
    done = run(code, without(tmp_path, *NOT_FOR_NODES))
    assert (done.returncode, done.stderr) == (0, "")
