# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Signals at any moment: an orderly end, and nothing that is not whole."""

import os
import signal
import subprocess
import sys

import pytest

# What is interrupted in the middle of an import, or in a finalizer.
PROGRAM = """
import os, signal, sys, time
sys.path.insert(0, {folder!r})
from rs_localizer.process.stopping import StopSignals
class Finalized:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGHUP)
        time.sleep(0.1)
StopSignals._interrupt.__globals__["_PATIENCE"] = {patience}
with StopSignals():
    try:
        {body}
        time.sleep(30)
    except KeyboardInterrupt:
        print("interrupted")
"""


def run(program: str, **variables: str) -> tuple[int, str, str]:
    """Exit code, output and errors of a program."""
    environment = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment | variables, text=True,
        capture_output=True, check=False,
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


def test_a_process_that_is_being_started_is_not_lost():
    """Ctrl-C after the fork, before anybody has the process to end it."""
    program = """
import os, signal, subprocess, sys
from rs_localizer.process.stopping import StopSignals
fork, started = subprocess._fork_exec, None
def forked(*arguments):
    pid = fork(*arguments)
    os.kill(os.getpid(), signal.SIGINT)
    return pid
subprocess._fork_exec = forked
with StopSignals():
    try:
        started = subprocess.Popen(["sleep", "60"])
        import time; time.sleep(30)
    except KeyboardInterrupt:
        started.kill()
        print("ended", started.wait())
"""
    assert run(program)[1] == "ended -9\n"


# Is interrupted amidst an import; imports until it is ended, or for longer than a signal waits.
HALF = "import os, time\nos.kill(os.getpid(), 2)\ntime.sleep(0.1)\nprint('whole')\n"
LONG = "import os, time\nos.kill(os.getpid(), 15)\ntime.sleep(9999)\n"
SHORT = "import time\ntime.sleep(1)\n"
CLEAN_UP = "try: os.kill(os.getpid(), 15); time.sleep(9)\n        finally: import slow"


@pytest.mark.parametrize(
    ("module", "body", "patience", "ended"),
    [
        # No interrupt is lost, nor raised where it would be lost, or leave half a module.
        (HALF, "import slow", 9.0, (0, "whole\ninterrupted\n", "")),
        (HALF, "Finalized()", 9.0, (0, "interrupted\n", "")),
        # Who imports for long is ended, unless to clean up.
        (LONG, "import slow", 0.1, (143, "", "interrupted\n")),
        (SHORT, CLEAN_UP, 0.1, (0, "interrupted\n", "")),
    ],
)
def test_imports_and_finalizers_are_interrupted_at_their_ends(
    tmp_path, module, body, patience, ended
):
    (tmp_path / "slow.py").write_text(module)
    assert run(PROGRAM.format(folder=f"{tmp_path}", body=body, patience=patience)) == ended


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
NODE = "from rs_localizer.ros.main import main; main(['--version'])"


@pytest.mark.parametrize(
    ("program", "variables"),
    [(COMMAND, {}), (NODE, {}), (COMMAND, {"OPENBLAS_NUM_THREADS": "2"})],  # nor does a user
)
def test_one_thread_whose_bits_nobody_changes(program, variables):
    found = run(program + ASK, **variables)[1].split("\n")[-2].split()
    assert found == ["1"] * len(found)
