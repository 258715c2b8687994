# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What builds, installs and checks is never silent for long, and its failures are seen."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture
def progress(monkeypatch) -> ModuleType:
    place = importlib.util.spec_from_file_location("progress", ROOT / ".ci" / "progress.py")
    module = importlib.util.module_from_spec(place)
    place.loader.exec_module(module)
    monkeypatch.setattr(module, "_PERIOD", 0.05)
    return module


def test_a_silent_command_is_told_with_its_last_line(progress, monkeypatch, capfd):
    code = "import time; print('one wheel', flush=True); time.sleep(1)"
    words = ["--quiet", "installing", sys.executable, "-c", code]
    monkeypatch.setattr(sys, "argv", ["progress.py", *words])
    assert progress.main() == 0
    lines = capfd.readouterr().out.splitlines()
    assert set(lines) & {"installing: 0 s, one wheel", "installing: 1 s, one wheel"}
    assert "one wheel" not in lines


@pytest.mark.parametrize("quiet", [True, False])
def test_what_a_failure_has_said_is_shown(progress, monkeypatch, capfd, quiet):
    monkeypatch.setattr(progress, "_PERIOD", 60.0)
    words = ["--quiet"] * quiet + ["checking", sys.executable, "-c", "print('bad'); exit(3)"]
    monkeypatch.setattr(sys, "argv", ["progress.py", *words])
    assert progress.main() == 3
    said = capfd.readouterr()
    assert (said.err if quiet else said.out) == "bad\n"
