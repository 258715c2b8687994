# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The detectors start without what only localizes."""

import subprocess
import sys

import pytest

# Modules, packages not counted.
MOST = {"markers": 50, "features": 41}


@pytest.mark.parametrize("kind", MOST)
def test_the_detectors_do_not_import_the_estimator(kind):
    code = (
        f"import sys, rs_localizer.ros.detector.{kind}\n"
        "print(*(n for n, m in sys.modules.items() if n.startswith('rs_localizer.')"
        " and not hasattr(m, '__path__')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    names = done.stdout.split()
    parts = {name.split(".")[1] for name in names}
    assert parts.isdisjoint({"estimation", "localizer", "tracking", "trajectory", "matching"})
    assert kind == "markers" or "markers" not in parts
    assert len(names) < MOST[kind]
