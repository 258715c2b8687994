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
        os.kill(os.getpid(), {number})
        time.sleep(0.1)
with StopSignals():
    try:
        {body}
        time.sleep(30)
    except KeyboardInterrupt:
        print("interrupted")
"""


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
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert ended.stdout == "ended -9\n", ended.stderr


@pytest.mark.parametrize(
    ("body", "number"), [("import slow", signal.SIGINT), ("Finalized()", signal.SIGHUP)]
)
def test_no_interrupt_is_lost(tmp_path, number, body):
    """Nor raised where it would be lost, or leave half a module."""
    folder = f"{tmp_path}"
    (tmp_path / "slow.py").write_text(
        f"import os, time\nos.kill(os.getpid(), {number:d})\ntime.sleep(0.1)\nprint('whole')\n"
    )
    program = PROGRAM.format(folder=folder, number=int(number), body=body)
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    expected = ["whole", "interrupted"] if "slow" in body else ["interrupted"]
    assert ended.stdout.split() == expected
    assert (ended.returncode, ended.stderr) == (0, "")


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
    said = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert said.stdout == f"{heard}\n"


# Imports until it is ended, or for longer than a signal is patient.
LONG = "import os, time\nos.kill(os.getpid(), 15)\ntime.sleep(9999)\n"
SHORT = "import time\ntime.sleep(1)\n"
CLEAN_UP = "try: os.kill(os.getpid(), 15); time.sleep(9)\n        finally: import slow"


@pytest.mark.parametrize(
    ("module", "body", "ended"),
    [
        (LONG, "import slow", (143, "", "interrupted\n")),
        (SHORT, CLEAN_UP, (0, "interrupted\n", "")),
    ],
)
def test_who_imports_for_long_is_ended_unless_to_clean_up(tmp_path, module, body, ended):
    (tmp_path / "slow.py").write_text(module)
    program = PROGRAM.format(folder=f"{tmp_path}", number=15, body=body)
    program = program.replace(
        "class", "StopSignals._interrupt.__globals__['_PATIENCE'] = 0.1\nclass"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == ended


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
    inherited = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", program + ASK], env=inherited | variables, text=True,
        capture_output=True, check=True,
    )  # fmt: skip
    found = done.stdout.split("\n")[-2].split()
    assert found == ["1"] * len(found)
