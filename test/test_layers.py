# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Imports inside the package go down only."""

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from rs_localizer.native import COMPILES

PACKAGE = Path(__file__).parents[1] / "rs_localizer"

# Code in LLVM's own terms, imported while kernels are compiled.
TRACED = ("core/simd/tracing.py",)
# What each part may import besides itself; every part has a row.
METHOD = {
    *("core", "config", "solvers", "estimation", "inertial", "integrity", "localizer"),
    *("lens_watch", "repeated_images", "shutter_watch", "tracking"),
}
MAY_IMPORT: dict[str, set[str]] = {
    "process": set(),
    "data": set(),
    "native": set(),
    "core": {"native"},
    "config": {"core", "solvers"},
    "solvers": {"core", "native"},
    "estimation": {"core", "config", "native", "solvers"},
    "inertial": {"core", "estimation", "native"},
    "localizer": {"core", "config", "solvers", "estimation"},
    "integrity": {"core", "config", "estimation", "native"},
    "repeated_images": {"core", "estimation"},
    "lens_watch": {"core", "config", "estimation", "localizer"},
    "shutter_watch": {"core", "estimation", "native"},
    "tracking": METHOD - {"tracking", "inertial"},
    "io": {"core"},
    "settings": {"config", "io"},
    "readout": {"data"},
    "matching": {"core", "config", "estimation", "io", "native"},
    "markers": {"core", "io", "native"},
    "features": {"core", "config", "io"},
    "pipeline": {*METHOD, "io", "features", "markers", "matching"},
    "offline": {*METHOD, *"io features markers matching pipeline process settings".split()},
}
# What makes a camera or a map known: nothing but the commands imports it.
MAY_IMPORT["tools"] = {*MAY_IMPORT}
EVERYTHING = {*MAY_IMPORT, "__init__"}
MAY_IMPORT |= {
    "__init__": {*METHOD, "io", "offline"},
    "ros": EVERYTHING - {"tools"},
    "cli": {*EVERYTHING, "ros"},
    "__main__": {"process", "cli"},
}


@cache
def imported(source: str, inside: str) -> set[str]:
    """Absolute dotted names that a module of the package `inside` imports, late ones included."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parents = inside.split(".")[: len(inside.split(".")) + 1 - node.level]
            base = ".".join([*parents, node.module or ""] if node.level else [node.module or ""])
            names |= {f"{base.strip('.')}.{alias.name}" for alias in node.names}
    return names


def parts(names: set[str]) -> set[str]:
    """First-level parts of this package among dotted names; `__init__` for its public names."""
    below = {name.split(".")[1] for name in names if name.startswith("rs_localizer.")}
    here = {path.stem for path in PACKAGE.iterdir()}
    public = {"__init__"} if "rs_localizer" in names or below - here else set()
    return below & here | public


def modules() -> Iterator[tuple[str, tuple[str, ...], set[str]]]:
    """The file of each module in the package, its dotted name in parts, and what it imports."""
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE.parent).with_suffix("").parts
        yield str(path.relative_to(PACKAGE)), name, imported(path.read_text(), ".".join(name[:-1]))


def test_imports_go_down_only():
    wrong = []
    for file, (_, part, *_), names in modules():
        used = parts(names) - {part} | {name for name in names if name.startswith("benchmarks")}
        wrong += [f"{file} imports {bad}" for bad in sorted(used - MAY_IMPORT[part])]
    assert wrong == []


# What package.xml names of ROS.
ROS = {
    name.removesuffix("_py")
    for name in re.findall(r"<exec_depend>(\w+)<", (PACKAGE.parent / "package.xml").read_text())
}
# Where packages are imported that a localizer does without: what begins so may.
ONLY_IN = {
    tuple(sorted(ROS)): ("ros/",),
    ("numba", "llvmlite"): ("native/jit.py", "native/bitcode.py", *TRACED),
    ("scipy",): ("tools/", "cli/"),
    ("matplotlib", "evo"): ("tools/",),
    ("pycolmap",): ("tools/", "io/maps/colmap_process.py"),
    ("av",): ("io/video.py",),
    ("dask", "distributed"): ("offline/fleet.py",),
    ("pyarrow",): ("offline/frame_table.py", "cli/replay_command.py"),
}


def test_what_few_need_is_imported_where_they_need_it():
    packages = {name: places for names, places in ONLY_IN.items() for name in names}
    wrong = []
    for file, _, names in modules():
        used = {name.partition(".")[0] for name in names} & packages.keys()
        wrong += [f"{file} imports {name}" for name in used if not file.startswith(packages[name])]
    assert wrong == []


@pytest.mark.skipif(COMPILES, reason="kernels are not those of the native module, Numba runs them")
def test_a_localizer_loads_nothing_that_few_need():
    """No module but of what makes cameras and maps known, of commands, and of extras.

    The IMU's room is loaded with its first reading.
    """
    apart = ("tools/", "cli/", "ros/", "native/", "__main__", *TRACED, "io/maps/colmap_process.py")
    apart += ("inertial/",)
    loaded = [".".join(name) for file, name, _ in modules() if not file.startswith(apart)]
    names = ["rs_localizer.inertial", *(name for names in ONLY_IN for name in names)]
    code = (
        f"import importlib, sys\nfor name in {loaded}:\n    importlib.import_module(name)\n"
        f"print(*[name for name in {names} if name in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    assert done.stdout == "\n"


# What each folder of ros may import of the others; every folder has a row.
ROS_MAY_IMPORT: dict[str, set[str]] = {"node": set(), "localizer": {"node"}, "detector": {"node"}}


def test_nodes_do_not_know_each_other():
    """What stands beside the folders starts nodes, and may import any of them."""
    ros = PACKAGE / "ros"
    folders = {path.name for path in ros.iterdir() if (path / "__init__.py").is_file()}
    assert folders == set(ROS_MAY_IMPORT)
    wrong = []
    for file, (_, part, folder, *_), names in ((f, (*n, ""), i) for f, n, i in modules()):
        if part == "ros" and folder in folders:
            used = {name.split(".")[2] for name in names if name.startswith("rs_localizer.ros.")}
            bad = (used & folders) - ROS_MAY_IMPORT[folder] - {folder}
            wrong += [f"{file} imports ros.{name}" for name in bad]
    assert wrong == []


def test_every_module_has_a_client() -> None:
    """Imported, or named where it is imported late; commands are found by their names."""
    texts = {path: path.read_text() for path in PACKAGE.rglob("*.py")}
    names = {name for *_, used in modules() for name in used}
    root = PACKAGE.parent
    starts = [path.read_text() for path in (root / "setup.py", *root.glob("launch/*.py"))]
    orphans = []
    for path in texts:
        module = ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
        late = (".".join(module.split(".")[-2:]), f'"{path.stem}"', path.name)
        if path.name.startswith("__") or module.startswith("rs_localizer.cli."):
            continue
        if any(f"{name}.".startswith(f"{module}.") for name in names):
            continue
        others = [*starts, *(text for where, text in texts.items() if where != path)]
        if not any(name in text for name in late for text in others):
            orphans.append(module)
    assert orphans == []


MOST = 6

# Compiled code takes arrays one by one, and so does what stands in for a kernel.
COMPILED = {"entry", "kernel", "inlined"}
INSTEAD_OF_KERNELS = {"solvers/r6p.py: solve_batch"}
# What is called with keywords: declarations, and the library's own entrance for cameras and rigs.
BY_KEYWORDS = {
    "cli/options.py: option",
    "solvers/minimal.py: solve_minimal",
    "localizer.py: localize",
    "localizer.py: find",
    "tracking.py: localize",
}


def functions(tree: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """All but those that only type checkers see."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
        yield from functions(node)


def takes_many(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    given = function.args
    named = [item.arg for item in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    more = [item.arg for item in (given.vararg, given.kwarg) if item is not None]
    decorators = {ast.unparse(item).partition("(")[0] for item in function.decorator_list}
    return len({*named, *more} - {"self", "cls"}) > MOST and not decorators & COMPILED


def test_no_function_takes_many_parameters():
    found = {
        f"{path.relative_to(PACKAGE)}: {function.name}"
        for path in PACKAGE.rglob("*.py")
        for function in functions(ast.parse(path.read_text()))
        if takes_many(function)
    }
    assert found == INSTEAD_OF_KERNELS | BY_KEYWORDS


def test_each_module_and_class_has_a_name_of_its_own():
    """But for ``__init__``, ``__main__``, ``build`` of kernels and of maps, and ``Options``."""
    homes: dict[str, list[str]] = {}
    for file in PACKAGE.rglob("*.py"):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        names = [node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
        for name in (*(name for name in names if name != "Options"), f"{file.stem}.py"):
            homes.setdefault(name, []).append(str(file.relative_to(PACKAGE)))
    excepted = ("__init__.py", "__main__.py", "build.py")
    shared = {name: of for name, of in homes.items() if len(of) > 1 and name not in excepted}
    assert shared == {}


def test_nodes_use_public_names_of_rclpy_only():
    """What rclpy calls with an underscore, or keeps in ``impl``, changes without notice."""
    own, used = set(), {}
    for path in sorted((PACKAGE / "ros").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                own.add(node.name)
            elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                own.add(node.target.id)
            elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
                own.add(node.attr)
            elif isinstance(node, ast.Attribute):
                used[node.attr] = f"{path.name}:{node.lineno}"
            elif isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rclpy.impl"):
                used["_impl"] = f"{path.name}:{node.lineno}"
            elif isinstance(node, ast.Constant) and str(node.value).startswith("_LifecycleNode"):
                used[node.value] = f"{path.name}:{node.lineno}"
    own |= {"_exit"}  # of os
    private = {
        name: where for name, where in used.items()
        if name.startswith("_") and not name.endswith("__") and name not in own
    }  # fmt: skip
    assert private == {}
    assert not any(name.startswith("_LifecycleNode") for name in own)
