# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What judges the estimator must not be made of it."""

import ast
import sys
from pathlib import Path

import benchmarks.independent

FOLDER = Path(benchmarks.independent.__file__).parent
OWN = "benchmarks.independent"


def test_nothing_of_the_package_is_imported():
    files = sorted(FOLDER.glob("*.py"))
    assert len(files) > 4
    for path in files:
        for node in ast.walk(ast.parse(path.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, path
                names = [node.module]
            for name in names:
                root = name.split(".")[0]
                fine = root in {"numpy", "scipy", *sys.stdlib_module_names}
                assert fine or name.startswith(OWN), f"{path.name} imports {name}"
