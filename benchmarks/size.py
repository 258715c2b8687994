# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.size``: how large the package is, and how much of it one frame needs.

Numbers of lines and modules are shadows of how hard a house is to know; the table is for notes
that compare two states of it.
"""

from __future__ import annotations

import ast
import dataclasses
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import rs_localizer as rsl
from benchmarks.frames.generated import generate
from benchmarks.frames.judged import camera_of
from benchmarks.frames.timed import CONDITIONS, calls_of
from rs_localizer.estimation.posterior import Posterior

_PACKAGE = Path(rsl.__file__).parent
_ROOT = _PACKAGE.parent
_CLOUD = "50 points, static"


def main() -> int:
    """Print the table."""
    sources = {_name(file): file.read_text() for file in _files(_PACKAGE)}
    imports = {name: set(_imported(name, text, set(sources))) for name, text in sources.items()}
    estimation = {name: text for name, text in sources.items() if _part(name) == "estimation"}
    clients = Counter(one for name, others in imports.items() for one in others if one != name)
    arrows = {
        (_part(name), _part(one))
        for name, others in imports.items()
        for one in others
        if _part(one) != _part(name)
    }
    calls, kernels, files = _one_cloud()
    rows = {
        "lines of the package": _lines(sources),
        "modules": len(sources),
        "modules imported by exactly one other": sum(count == 1 for count in clients.values()),
        "parts / imports between them": f"{len(set(map(_part, sources)))} / {len(arrows)}",
        "estimation: modules / lines / constants": (
            f"{sum(not name.endswith('__init__') for name in estimation)} / {_lines(estimation)}"
            f" / {sum(map(_constants, estimation.values()))}"
        ),
        "localizer.py": _lines({"": sources["localizer"]}),
        "Estimate / Prior / Posterior: fields": " / ".join(
            str(len(fields))
            for fields in (*map(dataclasses.fields, (rsl.Estimate, rsl.Prior)), Posterior._fields)
        ),
        "one cloud: Python calls / kernels / files": f"{calls} / {kernels} / {files}",
        "lines of test": _lines(_texts("test")),
        "lines of benchmarks": _lines(_texts("benchmarks")),
    }
    for name, value in rows.items():
        sys.stdout.write(f"{name:44}{value:>20}\n")
    return 0


def _files(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.py"))


def _texts(folder: str) -> dict[str, str]:
    return {str(file): file.read_text() for file in _files(_ROOT / folder)}


def _name(file: Path) -> str:
    return ".".join(file.relative_to(_PACKAGE).with_suffix("").parts)


def _part(name: str) -> str:
    return name.split(".")[0]


def _lines(sources: dict[str, str]) -> int:
    return sum(text.count("\n") for text in sources.values())


def _imported(name: str, text: str, modules: set[str]) -> Iterator[str]:
    """Modules of the package that a module imports, late imports included."""
    for node in ast.walk(ast.parse(text)):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and not node.level:
            names = [f"{node.module}.{alias.name}" for alias in node.names] + [str(node.module)]
        for one in names:
            first, _, rest = one.partition(".")
            if first == _PACKAGE.name and rest in modules and rest != name:
                yield rest


def _constants(text: str) -> int:
    """Names in capitals that a module assigns."""
    targets = [
        target
        for node in ast.parse(text).body
        for target in (
            node.targets
            if isinstance(node, ast.Assign)
            else [node.target]
            if isinstance(node, ast.AnnAssign)
            else []
        )
    ]
    names = [one.id for target in targets for one in ast.walk(target) if isinstance(one, ast.Name)]
    return sum(name.isupper() for name in names)


def _one_cloud() -> tuple[int, int, int]:
    """Calls of Python functions and of kernels in one ``Localizer.localize``, and their files."""
    condition = next(one for one in CONDITIONS if one.name == _CLOUD)
    localizer = rsl.Localizer(camera_of(condition, 0))
    frames = list(generate(condition, 5, 1))
    return calls_of(lambda frame: localizer.localize(frame.points, frame.pixels), frames)


if __name__ == "__main__":
    sys.exit(main())
