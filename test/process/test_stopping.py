# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Signals at any moment: an orderly end, and nothing that is not whole."""

import os
import signal
import subprocess
import sys

import pytest


def run(program: str, **variables: str) -> tuple[int, str, str]:
    """Exit code, output and errors of a program."""
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment | variables, text=True,
        capture_output=True, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize(("number", "heard"), [(signal.SIGTERM, True), (signal.SIGHUP, False)])
def test_only_nohup_is_inherited(number, heard):
    """A parent that has ignored SIGTERM would have its nodes never end."""
    program = f"""
import os, signal
from rs_localizer.process.stopping import StopRequest
signal.signal({number:d}, signal.SIG_IGN)
with StopRequest() as stop:
    os.kill(os.getpid(), {number:d})
    print(stop.requested)
"""
    assert run(program) == (0, f"{heard}\n", "")


def test_two_signals_at_once_are_one_interrupt():
    program = """
import os, signal
from rs_localizer.process.stopping import StopSignals
with StopSignals() as stop:
    try:
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        finally:
            os.kill(os.getpid(), signal.SIGINT)
            print("whole")
    except KeyboardInterrupt:
        print("interrupted", stop.requested)
"""
    assert run(program) == (0, "whole\ninterrupted True\n", "")


# How many threads each OpenBLAS that this process has loaded would use, by its own word.
ASK = """
import ctypes, re
import numpy, scipy.linalg
found = []
for path in set(re.findall(r"/.*openblas.*", open("/proc/self/maps").read())):
    library = ctypes.CDLL(path)
    for prefix in ("", "scipy_"):
        for suffix in ("", "64_"):
            name = f"{prefix}openblas_get_num_threads{suffix}"
            if hasattr(library, name):
                found.append(getattr(library, name)())
print(*found)
"""
COMMAND = "import sys; sys.argv[1:] = ['--version']; from rs_localizer.__main__ import run; run()"
NODE = "from contextlib import suppress; from rs_localizer.ros.main import main\n"
NODE += "with suppress(SystemExit):\n    main(['--version'])\n"


@pytest.mark.parametrize(
    ("program", "variables"),
    [(COMMAND, {}), (NODE, {}), (COMMAND, {"OPENBLAS_NUM_THREADS": "2"})],  # nor does a user
)
def test_one_thread_whose_bits_nobody_changes(program, variables):
    found = run(program + ASK, **variables)[1].split("\n")[-2].split()
    assert found == ["1"] * len(found)
