# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Prints what the build needs: the list of pyproject.toml, and a compiler if there is none."""

import shutil
import tomllib
from pathlib import Path

project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())
requires = project["build-system"]["requires"]
print(*requires, *([] if shutil.which("gcc") and shutil.which("g++") else ["ziglang"]))
