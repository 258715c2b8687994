# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Examples start as their pages say, and end in one line where something is missing."""

import re
import shlex
from pathlib import Path

import pytest
from typed_commands import EXAMPLES, commands, started

WITH_ARGUMENTS = sorted(p for p in EXAMPLES.glob("*.py") if "__main__" in p.read_text())


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Where the page's commands for a table have been typed."""
    pytest.importorskip("pyarrow", exc_type=ImportError)
    made = tmp_path_factory.mktemp("clone")
    (made / "examples").symlink_to(EXAMPLES)
    for line in commands("README.md")[1:]:
        done = started(line, made)
        assert done.returncode == 0, (line, done.stderr)
    return made


@pytest.mark.parametrize(
    "name", ["to_gsplat", "to_nerfstudio", "to_ncore", "to_rerun", "to_global_shutter"]
)
def test_what_reads_a_table_runs_as_its_head_says(name, folder):
    if name == "to_rerun":
        pytest.importorskip("rerun")
    *_, line = commands(f"{name}.py")
    done = started(line, folder)
    assert (done.returncode, done.stderr) == (0, ""), done.stderr
    assert re.fullmatch(r"[\w.]+: 15 images\n", done.stdout)


@pytest.mark.parametrize("path", WITH_ARGUMENTS, ids=lambda path: path.stem)
def test_wrong_arguments_are_answered_in_a_line(path):
    words = ["a", "b"] if path.stem in ("05_export", "px4_odometry") else []  # they need none
    done = started(shlex.join(["python", str(path), *words]), EXAMPLES)
    assert done.returncode == 1
    assert done.stderr.startswith("usage: python ")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("name", "words", "package", "remedy"),
    [
        ("to_gsplat", "seen.parquet out", "pyarrow", "pip install pyarrow"),
        ("to_rerun", "seen.parquet out", "rerun", "pip install rerun-sdk"),
        ("hloc_queries", "a b c d e f 0.03", "h5py", "pip install h5py"),
        ("hloc_queries", "a b c d e f 0.03", "pycolmap", "pip install pycolmap"),
        ("03_node_client", "", "rclpy", "pip install 'rs_localizer[ros]'"),
        ("px4_odometry", "ned", "rclpy", "pip install 'rs_localizer[ros]'"),
        ("px4_odometry", "ned", "px4_msgs", "PX4's release"),
    ],
)
def test_a_missing_package_is_said_in_a_line(name, words, package, remedy, tmp_path):
    if package == "px4_msgs":
        pytest.importorskip("rclpy")
    missing = f"raise ModuleNotFoundError(\"No module named '{package}'\", name='{package}')\n"
    (tmp_path / f"{package}.py").write_text(missing)
    done = started(f"python {EXAMPLES}/{name}.py {words}", tmp_path, PYTHONPATH=str(tmp_path))
    assert done.returncode == 1
    assert done.stderr.startswith(f"{name}.py: the package {package} is not installed: ")
    assert remedy in done.stderr
    assert done.stderr.count("\n") == 1


def test_a_file_that_is_not_there_is_said_in_a_line(tmp_path):
    done = started(f"python {EXAMPLES}/to_gsplat.py none.parquet out", tmp_path)
    assert done.stderr == "to_gsplat.py: there is no file none.parquet\n"
