# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Old caches go; what may be in use, or is somebody else's, stays."""

import os
import time
from pathlib import Path

import pytest

from rs_localizer.core.simd import compiler, jit

DAY = 86400.0


@pytest.fixture
def cache(tmp_path) -> Path:
    jit._is_ours.cache_clear()
    return tmp_path


def folder(cache: Path, name: str, days: float, inside: str = "rs_localizer.core.so3") -> Path:
    """A folder of kernels that was used some days ago."""
    made = cache / name
    (made / inside).mkdir(parents=True)
    (made / inside / "hat-1.py311.nbi").write_bytes(b"")
    os.utime(made, times=(time.time() - days * DAY,) * 2)
    return made


def test_what_nobody_used_for_a_month_is_removed(cache):
    old = folder(cache, "0123456789abcdef", 31)
    staying = [
        folder(cache, "1" * 16, 29),  # another version, still in use
        folder(cache, "another_package_of_numba", 100),
        folder(cache, "2" * 16, 100, inside="somebody.elses"),
    ]
    (cache / "3333333333333333").write_text("a file")
    empty = cache / ("4" * 16)  # of anybody
    empty.mkdir()
    os.utime(empty, times=(time.time() - 100 * DAY,) * 2)
    staying.append(empty)
    compiler._remove_old(cache)
    assert not old.exists()
    assert all(path.is_dir() for path in staying)
    assert (cache / "3333333333333333").is_file()
