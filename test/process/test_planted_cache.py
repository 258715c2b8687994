# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Files that another user has put where this one's compiled code is looked for never run."""

import os
import pickle
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
NOBODY = 65534
USE = "import numpy as np, rs_localizer.core.so3 as s; print(s.exp(np.zeros(3)).tolist())"


class Payload:
    def __init__(self, mark: Path) -> None:
        self._code = f"open({str(mark)!r}, 'a').write('ran ')"

    def __reduce__(self) -> tuple[Any, ...]:
        return exec, (self._code,)


@pytest.fixture
def home() -> Iterator[Path]:
    """A checkout that everybody can enter; pytest's own folder is nobody else's."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        Path(folder).chmod(0o755)
        unwanted = shutil.ignore_patterns("*.so", "__pycache__", "data")
        shutil.copytree(ROOT / "rs_localizer", Path(folder) / "rs_localizer", ignore=unwanted)
        yield Path(folder)


def use(home: Path) -> str:
    """What ran of the payloads when a process used a kernel, whose result is right anyway."""
    mark = home / "RAN"
    mark.write_text("")
    environment = os.environ | {"RS_LOCALIZER_KERNELS": "numba", "PYTHONPATH": str(home)}
    done = subprocess.run(
        [sys.executable, "-P", "-c", USE], env=environment, cwd=home, capture_output=True,
        text=True, check=True,
    )  # fmt: skip
    assert done.stdout.strip() == "[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]"
    return mark.read_text()


def plant(home: Path) -> None:
    for path in (home / ".kernels").rglob("*"):
        if path.is_file() and path.stat().st_size:
            path.write_bytes(pickle.dumps(Payload(home / "RAN")))


@pytest.mark.parametrize("theirs", ["they own it", "they can write to it"])
def test_nothing_of_a_folder_of_others_runs(home, theirs):
    if theirs == "they own it" and os.geteuid() != 0:
        pytest.skip("only root can give files away")
    assert use(home) == ""
    plant(home)
    assert use(home) != "", "the control: nobody reads what was planted"
    plant(home)
    for path in (home / ".kernels", *(home / ".kernels").rglob("*")):
        if theirs == "they own it":
            os.chown(path, NOBODY, NOBODY)
        path.chmod(0o755 if theirs == "they own it" else 0o777)
    assert use(home) == ""
