# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``localizer --help`` and ``--version`` answer, and start no node."""

import subprocess
import sys

import pytest

import rs_localizer


@pytest.mark.parametrize(("function", "word"), [("main", "--version"), ("marker_detector", "-h")])
def test_the_executables(function, word):
    code = f"import sys; from rs_localizer.ros.main import {function} as f; sys.exit(f([{word!r}]))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith(("usage: ", f"rs_localizer {rs_localizer.__version__}\n"))
