# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Programs of this package keep linear algebra in one thread; BLAS itself is asked."""

import os
import subprocess
import sys

import pytest

# How many threads each OpenBLAS that this process has loaded would use, by its own word.
ASK = """
import ctypes, re
import numpy, scipy.linalg
found = []
for path in set(re.findall(r"/\\S*openblas\\S*", open("/proc/self/maps").read())):
    library = ctypes.CDLL(path)
    for prefix in ("", "scipy_"):
        for suffix in ("", "64_"):
            name = f"{prefix}openblas_get_num_threads{suffix}"
            if hasattr(library, name):
                found.append(getattr(library, name)())
print(*found)
"""
COMMAND = "import sys; sys.argv[1:] = ['--version']; from rs_localizer.__main__ import run; run()"
NODE = """
import rs_localizer.ros.main as program
program._guarded("name", lambda name: lambda stop, args: 0, None)
"""


def threads(program: str, **variables: str) -> list[int]:
    """Of each OpenBLAS after a program has begun."""
    inherited = {k: v for k, v in os.environ.items() if not k.endswith("_NUM_THREADS")}
    done = subprocess.run(
        [sys.executable, "-c", program + ASK],
        env=inherited | variables,
        text=True,
        capture_output=True,
        timeout=120,
        check=True,
    )
    return [int(word) for word in done.stdout.split("\n")[-2].split()]


@pytest.fixture(scope="module")
def many() -> list[int]:
    found = threads("")
    if not found or max(found) < 2:
        pytest.skip("no OpenBLAS with threads here")
    return found


@pytest.mark.parametrize("program", [COMMAND, NODE])
def test_one_thread(program, many):
    assert threads(program) == [1] * len(many)


def test_the_user_decides(many):
    assert threads(COMMAND, OPENBLAS_NUM_THREADS="2") == [2] * len(many)
