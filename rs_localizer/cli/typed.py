# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Commands to be pasted: after ``make`` the executables of this package are not in PATH."""

from __future__ import annotations

import os
import shlex
import shutil
import sys
from pathlib import Path


def typed(executable: str, *words: str) -> str:
    """Return the command line that runs an executable of this package here."""
    return shlex.join([*_program(executable), *words])


def _program(executable: str) -> list[str]:
    in_path = shutil.which(executable)
    # Look beside the running program, or, for ``python -m rs_localizer``, beside Python.
    for program in (sys.argv[0], sys.executable):
        beside = Path(os.path.abspath(program)).with_name(executable)
        if not shutil.which(str(beside)):
            continue
        if in_path is not None and Path(in_path).samefile(beside):
            return [executable]
        here = Path.cwd()
        return [str(beside.relative_to(here) if beside.is_relative_to(here) else beside)]
    if in_path is not None or executable != "rs_localizer":
        return [executable]
    return [sys.executable, "-m", "rs_localizer"]
