# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""No function takes more than six parameters: what travels together has a name."""

import ast
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "rs_localizer"
MOST = 6

# Compiled code takes arrays one by one, and so does what stands in for a kernel.
COMPILED = {"kernel", "inlined", "error_model"}
INSTEAD_OF_KERNELS = {"solvers/r6p.py: solve_batch"}
# What is called with keywords: declarations, and the library's own entrance for cameras and rigs.
BY_KEYWORDS = {
    "config.py: setting",
    "solvers/minimal.py: solve_minimal",
    "localizer.py: localize",
    "localizer.py: find",
}


def functions(tree: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """All but those that only type checkers see."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
        yield from functions(node)


def parameters(function: ast.FunctionDef | ast.AsyncFunctionDef) -> list[str]:
    given = function.args
    named = [item.arg for item in (*given.posonlyargs, *given.args, *given.kwonlyargs)]
    more = [item.arg for item in (given.vararg, given.kwarg) if item is not None]
    return [name for name in named + more if name not in ("self", "cls")]


def is_compiled(function: ast.FunctionDef | ast.AsyncFunctionDef) -> bool:
    names = {ast.unparse(item).partition("(")[0] for item in function.decorator_list}
    return bool(names & COMPILED)


def test_no_function_takes_many_parameters():
    found = {
        f"{path.relative_to(PACKAGE)}: {function.name}"
        for path in PACKAGE.rglob("*.py")
        for function in functions(ast.parse(path.read_text()))
        if len(parameters(function)) > MOST and not is_compiled(function)
    }
    assert found == INSTEAD_OF_KERNELS | BY_KEYWORDS
