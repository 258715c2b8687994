"""The marker detector starts without what only localizes."""

from __future__ import annotations

import subprocess
import sys

# Modules, packages not counted.
MOST = 54


def test_the_detector_does_not_import_the_estimator() -> None:
    code = (
        "import sys, rs_localizer.ros.detector.node\n"
        "print(*(n for n, m in sys.modules.items() if n.startswith('rs_localizer.')"
        " and not hasattr(m, '__path__')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    names = done.stdout.split()
    parts = {name.split(".")[1] for name in names}
    assert parts.isdisjoint({"estimation", "localizer", "tracking", "trajectory", "matching"})
    assert len(names) < MOST
