# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``localizer --help`` and ``--version`` answer, and start no node."""

import subprocess
import sys

import pytest

import rs_localizer
from rs_localizer.config import DetectorConfig, FeatureConfig, NodeConfig
from rs_localizer.ros.main import answer
from rs_localizer.settings import settings


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("localizer", NodeConfig),
        ("marker_detector", DetectorConfig),
        ("feature_detector", FeatureConfig),
    ],
)
def test_help_names_every_parameter_with_its_default(name, kind):
    text = answer(name, ["--help"])
    assert text is not None
    assert f"ros2 run rs_localizer {name} --ros-args" in text
    for parameter, one in settings(kind).items():
        assert f"\n  {parameter}: " in text
        assert one.description in text
    assert "\n  autostart: True\n" in text


@pytest.mark.parametrize(("function", "word"), [("main", "--version"), ("marker_detector", "-h")])
def test_the_executables(function, word):
    code = f"import sys; from rs_localizer.ros.main import {function} as f; sys.exit(f([{word!r}]))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(("usage: ", f"rs_localizer {rs_localizer.__version__}\n"))
