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
    nodes = ast.walk(ast.parse(Path(rsl.__file__).read_text()))
    imports = [
        node for node in nodes
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("rs_localizer")
    ]  # fmt: skip
    seen = {alias.name: node.module for node in imports for alias in node.names}
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
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr.strip() == "[]"
