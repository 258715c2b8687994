# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The public names come when they are asked for."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import rs_localizer as rsl


def test_every_public_name_is_there():
    for name in rsl.__all__:
        assert getattr(rsl, name).__module__.startswith("rs_localizer.")
    assert set(rsl.__all__) <= set(dir(rsl))
    chosen: dict[str, object] = {}
    exec("from rs_localizer import *; from rs_localizer import Camera", chosen)
    assert chosen["Camera"] is rsl.Camera
    assert set(rsl.__all__) <= set(chosen)


def test_type_checkers_see_the_same_names():
    tree = ast.parse(Path(rsl.__file__).read_text())
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    seen = {
        alias.name: node.module
        for node in imports
        if node.module and node.module.startswith("rs_localizer")
        for alias in node.names
    }
    assert sorted(seen) == rsl.__all__
    homes = {name: module for module, names in rsl._HOMES.items() for name in names}
    assert {name: f"rs_localizer.{module}" for name, module in homes.items()} == seen


@pytest.mark.parametrize(
    "module", ["rs_localizer", "rs_localizer.__main__", "rs_localizer.ros.main"]
)
def test_programs_start_with_light_imports(module):
    code = (
        f"import sys, {module}\n"
        "heavy = ('numpy', 'numba', 'cv2', 'rclpy', 'rosbags', 'scipy', 'matplotlib')\n"
        "sys.exit([name for name in sys.modules if name.startswith(heavy)])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stderr.strip() == "[]"


def test_type_checkers_accept_what_people_write(tmp_path):
    """Lists of whole numbers, sizes as JSON has them, no distortion."""
    api = pytest.importorskip("mypy.api", reason="mypy is not installed")
    program = tmp_path / "program.py"
    program.write_text(
        "import rs_localizer as rsl\n"
        "K = [[500.5, 0.0, 320.0], [0.0, 500.5, 240.0], [0.0, 0.0, 1.0]]\n"
        "camera = rsl.Camera(1280.0, 720, [[500, 0, 320], [0, 500, 240], [0, 0, 1]], None)\n"
        "camera = rsl.Camera(width=640, height=480, K=K, D=[0.1, 0, 0, 0])\n"
        "result = rsl.Localizer(camera).localize([[0, 0, 1]], [[1.0, 2]])\n"
        "if result:\n"
        "    speed: float = rsl.camera_state(result, camera).linear_velocity[0]\n"
        "    pixels = rsl.rectify(camera, result, [[1.0, 2.0]]).round(2)\n"
    )
    root = Path(rsl.__file__).parents[1]
    command = [sys.executable, "-m", "mypy", "--strict", str(program)]
    done = subprocess.run(
        command, cwd=root, capture_output=True, text=True, timeout=250, check=False
    )
    assert (done.returncode, done.stdout[:7]) == (0, "Success"), done.stdout
    assert api is not None
