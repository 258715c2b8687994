# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Libraries that are not to be trusted with any file, in a process of their own with limits.

A script is run by its path; it imports nothing of this package, takes a task and leaves arrays.
What it allocates, how long it works, and how it dies is then nobody else's fault.
"""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

_START = (
    "import resource as r, runpy, sys; memory, seconds = map(int, sys.argv[1:3]); "
    "limits = {r.RLIMIT_DATA: memory, r.RLIMIT_CPU: seconds, r.RLIMIT_CORE: 0}; "
    "[r.setrlimit(kind, (most, most)) for kind, most in limits.items()]; "
    "sys.argv = sys.argv[3:]; runpy.run_path(sys.argv[0], run_name='__main__')"
)
# Of a machine whose cores are busy: s for each second of work.
_WAITING = 10
_LONGEST_WORDS = 300


class LimitedError(ValueError):
    """Work that failed, or that took too much; the message says how it ended."""


def run_limited(
    script: Path, task: dict[str, Any], memory: int, seconds: int
) -> dict[str, NDArray[Any]]:
    """Arrays of numbers or of text, by name, that ``python SCRIPT TASK.json OUT.npz`` leaves.

    Args:
        script: run by its path.
        task: what the script finds in the JSON file.
        memory: bytes that it may allocate.
        seconds: that it may work.

    Raises:
        LimitedError: when it ends otherwise than with exit code 0; with its last line.
    """
    # Without the folder of the script, in which modules may have names of others.
    environment = os.environ | {"PYTHONSAFEPATH": "1", "OPENBLAS_NUM_THREADS": "1"}
    with TemporaryDirectory(prefix="rs_localizer-") as folder:
        given, out = Path(folder) / "task.json", Path(folder) / "out.npz"
        given.write_text(json.dumps(task), encoding="utf-8")
        words = map(str, (memory, seconds, script, given, out))
        try:
            done = subprocess.run(
                [sys.executable, "-c", _START, *words], env=environment, check=False,
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
                timeout=_WAITING * seconds,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise LimitedError(f"it takes longer than {seconds} s") from None
        if done.returncode == 0 and out.is_file():
            with np.load(out) as arrays:  # never unpickled
                return dict(arrays)
    if done.returncode in (-signal.SIGXCPU, -signal.SIGKILL):
        raise LimitedError(f"it takes longer than {seconds} s")
    lines = done.stderr.decode("utf-8", "replace").split("\n")
    last = next((line.strip() for line in reversed(lines) if line.strip()), "no word")
    last = last[:_LONGEST_WORDS]
    if "MemoryError" in last or "alloc" in last or done.returncode == -signal.SIGABRT:
        raise LimitedError(f"it needs more than {memory / 1e6:.0f} MB, or is damaged: {last}")
    raise LimitedError(last)
