# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The public names come when they are asked for."""

import ast
import subprocess
import sys
from pathlib import Path

import numpy as np
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


@pytest.mark.parametrize(
    ("said", "call"),
    [
        ("roi.width must be a whole", lambda localizer: rsl.Roi(0, 0, "5", 5)),
        ("expected_share must be be", lambda it: it.localize([], [], expected_share="0.5")),
        ("rotation must be of type R", lambda it: it.localize([], [], rotation=3)),
        ("a: .points, pixels. or .po", lambda it: rsl.Localizer(
            rsl.Rig({"a": it.camera}, {"a": (np.eye(3), np.zeros(3))})).localize({"a": 3})),
        ("angular_velocity_deviation", lambda localizer: rsl.Prior(
            angular_velocity=(0, 0, 1), angular_velocity_deviation="x")),
        ("aid must be of type Aid, g", lambda localizer: rsl.Tracker(localizer, aid=5)),
        ("max_prediction must be 0 s", lambda it: rsl.Tracker(it, max_prediction="1")),
        ("time_ns must be a whole nu", lambda localizer: rsl.Tracker(localizer).at(None)),
        ("prior must be of type Prio", lambda localizer: rsl.Tracker(localizer).expect(0, 3)),
        ("context must be of type Fr", lambda it: rsl.Tracker(it).localize(0, [], [], context=3)),
        ("iterations must be 1 or mo", lambda it: rsl.solve_minimal(
            "p3p", np.zeros((1, 3, 3)), np.zeros((1, 3, 2)), np.zeros((1, 3)), iterations="x")),
    ],
)  # fmt: skip
def test_what_cannot_be_meant_is_refused_by_its_name(said, call):
    K = [[500, 0, 320], [0, 500, 240], [0, 0, 1]]
    with pytest.raises(ValueError, match=f"^{said}"):
        call(rsl.Localizer(rsl.Camera(640, 480, K, readout_time=0.03)))
