# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The memory of the compiler's library is given back, and the library goes on working."""

import re
import sys
from pathlib import Path

import numba
import pytest

from rs_localizer.pipeline.compiling import give_back_compiler


def resident() -> int:
    """kB of LLVM's library that are in memory."""
    text = Path("/proc/self/smaps").read_text()
    return sum(map(int, re.findall(r"libllvmlite\S*\n(?:\w+: .*\n)*?Rss: +(\d+) kB", text)))


@pytest.mark.skipif(sys.platform != "linux", reason="reads Linux's /proc")
def test_llvm_is_unmapped_and_comes_back():
    double = numba.njit(lambda x: 2 * x)
    assert double(3) == 6
    before = resident()
    give_back_compiler()
    assert resident() < 0.5 * before
    assert double(1.5) == 3.0  # compiled anew, for another type
