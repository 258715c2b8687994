# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""rs_localizer warm: kernels are there, or the exit code says that they are not."""

import json
import os
import subprocess
import sys

from rs_localizer.cli.main import main
from rs_localizer.core.simd.jit import cache_directory


def test_it_says_where_the_kernels_are(capsys):
    assert main(["warm", "--solver", "p3p"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line[:10].strip() for line in lines[:2]] == ["markers", "solver p3p"]
    assert lines[2:] == [f"kernels are in {cache_directory()}"]
    assert list(cache_directory().rglob("*.nbc"))
    assert main(["warm", "--solver", "p3p", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)["result"]
    assert list(result["seconds"]) == ["markers", "solver p3p"]
    assert result["kernels"] == str(cache_directory())


def test_kernels_that_cannot_be_kept_are_a_failure(tmp_path):
    (tmp_path / "cache").write_text("a file in its place")
    done = subprocess.run(
        [sys.executable, "-m", "rs_localizer", "warm", "--solver", "p3p"],
        env={**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")},
        text=True,
        capture_output=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith(f"rs_localizer warm: cache of kernels in {tmp_path}/cache/")
    assert done.stderr.endswith(("Not a directory\n", "File exists\n"))
    assert done.stderr.count("\n") == 1
