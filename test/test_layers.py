# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Imports inside the package go down only."""

import ast
import re
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from rs_localizer.native import COMPILES

PACKAGE = Path(__file__).parents[1] / "rs_localizer"

# Code in LLVM's own terms, imported while kernels are compiled.
TRACED = ("core/simd/tracing.py",)
# What each part may import besides itself; every part has a row.
METHOD = {
    *("core", "config", "solvers", "estimation", "inertial", "integrity", "localizer"),
    *("lens_watch", "pace_watch", "repeated_images", "shutter_watch", "tracking"),
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
    "pace_watch": {"core", "config"},
    "lens_watch": {"core", "config", "estimation", "localizer"},
    "shutter_watch": {"core", "estimation", "native"},
    "tracking": METHOD - {"tracking", "inertial"},
    "io": {"core"},
    "settings": {"config", "io"},
    "readout": {"data"},
    "matching": {"core", "config", "estimation", "io", "native"},
    "markers": {"core", "io", "native"},
    "features": {"core", "config", "io"},
    "pipeline": {*METHOD, "io", "features", "markers", "matching", "settings"},
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


TREES = {
    str(path.relative_to(PACKAGE)): ast.parse(path.read_text(encoding="utf-8"))
    for path in sorted(PACKAGE.rglob("*.py"))
}


def imported(tree: ast.AST, inside: list[str]) -> set[str]:
    """Absolute dotted names that a module of the package `inside` imports, late ones included."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parents = inside[: len(inside) + 1 - node.level] if node.level else []
            base = ".".join([*parents, *filter(None, [node.module])])
            names |= {f"{base}.{alias.name}" for alias in node.names}
    return names


def parts(names: set[str]) -> set[str]:
    """First-level parts of this package among dotted names; `__init__` for its public names."""
    below = {name.split(".")[1] for name in names if name.startswith("rs_localizer.")}
    here = {path.stem for path in PACKAGE.iterdir()}
    public = {"__init__"} if "rs_localizer" in names or below - here else set()
    return below & here | public


# Of each module: its file, its dotted name in parts, and what it imports.
MODULES = [
    (file, name, imported(tree, list(name[:-1])))
    for file, tree in TREES.items()
    for name in [("rs_localizer", *Path(file).with_suffix("").parts)]
]


def test_imports_go_down_only():
    wrong = []
    for file, (_, part, *_), names in MODULES:
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
    for file, _, names in MODULES:
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
    loaded = [".".join(name) for file, name, _ in MODULES if not file.startswith(apart)]
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
    folders = {path.parent.name for path in (PACKAGE / "ros").glob("*/__init__.py")}
    assert folders == set(ROS_MAY_IMPORT)
    wrong = []
    for file, (_, part, *inside), names in MODULES:
        folder = inside[0] if part == "ros" and inside else ""
        if folder in folders:
            used = {name.split(".")[2] for name in names if name.startswith("rs_localizer.ros.")}
            bad = (used & folders) - ROS_MAY_IMPORT[folder] - {folder}
            wrong += [f"{file} imports ros.{name}" for name in bad]
    assert wrong == []


def test_every_module_has_a_client() -> None:
    """Imported, or named where it is imported late; commands are found by their names."""
    names = {name for *_, used in MODULES for name in used}
    root, orphans = PACKAGE.parent, []
    texts = {path: path.read_text() for path in PACKAGE.rglob("*.py")}
    texts |= {path: path.read_text() for path in (root / "setup.py", *root.glob("launch/*.py"))}
    for file, (*_, folder, stem), _ in MODULES:
        module = ".".join(Path("rs_localizer", file).with_suffix("").parts)
        is_imported = any(f"{name}.".startswith(f"{module}.") for name in names)
        if stem.startswith("__") or file.startswith("cli/") or is_imported:
            continue
        others = [text for where, text in texts.items() if where != PACKAGE / file]
        late = f"{folder}.{stem}", f'"{stem}"', f"{stem}.py"
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
    "tracking.py: localize",
}


def takes_many(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    given = function.args
    every = [*given.posonlyargs, *given.args, *given.kwonlyargs, given.vararg, given.kwarg]
    named = {item.arg for item in every if item is not None} - {"self", "cls"}
    decorators = {ast.unparse(item).partition("(")[0] for item in function.decorator_list}
    for_type_checkers = ast.unparse(function.body[-1]) == "..."
    return len(named) > MOST and not decorators & COMPILED and not for_type_checkers


def test_no_function_takes_many_parameters():
    found = {
        f"{file}: {node.name}" for file, tree in TREES.items() for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and takes_many(node)
    }  # fmt: skip
    assert found == INSTEAD_OF_KERNELS | BY_KEYWORDS


def test_each_module_and_class_has_a_name_of_its_own():
    nodes = [node for tree in TREES.values() for node in ast.walk(tree)]
    names = [node.name for node in nodes if isinstance(node, ast.ClassDef)]
    names += [Path(file).name for file in TREES]
    shared = {name for name, count in Counter(names).items() if count > 1}
    # Of kernels and of maps there is a build.
    assert shared <= {"__init__.py", "__main__.py", "build.py", "Options"}


def test_nodes_use_public_names_of_rclpy_only():
    """What rclpy calls with an underscore, or keeps in ``impl``, changes without notice."""
    own, used = {"_exit"}, set()  # the former of os
    for file, tree in TREES.items():
        for node in ast.walk(tree) if file.startswith("ros/") else ():
            match node:
                case (
                    ast.FunctionDef(name=name)
                    | ast.AnnAssign(target=ast.Name(id=name))
                    | ast.Attribute(attr=name, ctx=ast.Store())
                ):
                    own.add(name)
                case ast.Attribute(attr=name):
                    used.add(name)
                case ast.ImportFrom(module=str(name)) if name.startswith("rclpy.impl"):
                    used.add("_impl")
                case ast.Constant(value=str(name)) if name.startswith("_LifecycleNode"):
                    used.add(name)
    private = {name for name in used - own if name.startswith("_") and not name.endswith("__")}
    assert private == set()
    assert not any(name.startswith("_LifecycleNode") for name in own)
