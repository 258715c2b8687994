# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The traced code against the same arithmetic in NumPy."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import rs_localizer

PACKAGE = Path(rs_localizer.__file__).parent
FOLDERS = ("core", "solvers", "estimation", "inertial")
MARKS = ("kernel", "inlined")


def innermost_loops(source: str) -> Iterator[ast.For]:
    for function in ast.walk(ast.parse(source)):
        if isinstance(function, ast.FunctionDef) and any(
            isinstance(mark, ast.Name) and mark.id in MARKS for mark in function.decorator_list
        ):
            for loop in ast.walk(function):
                if isinstance(loop, ast.For) and not any(
                    isinstance(inner, ast.For) for line in loop.body for inner in ast.walk(line)
                ):
                    yield loop


def names(node: ast.AST) -> set[str]:
    return {item.id for item in ast.walk(node) if isinstance(item, ast.Name)}


def two_ways(loop: ast.For) -> Iterator[ast.stmt]:
    """Statements of a loop whose result depends on whether it is vectorized."""
    counter = names(loop.target)
    steps = [item for item in ast.walk(loop) if isinstance(item, ast.Assign | ast.AugAssign)]
    stores = [
        step
        for step in steps
        if any(
            isinstance(target, ast.Subscript)
            for target in (step.targets if isinstance(step, ast.Assign) else [step.target])
        )
    ]
    changing = counter | {
        item.id
        for step in steps
        if isinstance(step, ast.Assign)
        for target in step.targets
        for item in ast.walk(target)
        if isinstance(item, ast.Name)
    }
    for step in steps:
        if not isinstance(step, ast.AugAssign):
            continue
        in_memory = isinstance(step.target, ast.Subscript)
        fixed_place = in_memory and not counter & names(step.target.slice)
        if fixed_place and counter & names(step.value):
            yield step  # a sum in memory
        if not in_memory and stores and counter & names(step.value):
            yield step  # a sum beside a store
        if in_memory and isinstance(step.op, ast.Div) and not changing & names(step.value):
            yield step  # a division that another loop would multiply


@pytest.mark.parametrize("folder", FOLDERS)
def test_kernels_round_in_one_way(folder):
    found = [
        f"{path.relative_to(PACKAGE)}:{step.lineno}: {ast.unparse(step)}"
        for path in sorted((PACKAGE / folder).rglob("*.py"))
        for loop in innermost_loops(path.read_text())
        for step in two_ways(loop)
        if not isinstance(loop.iter, ast.Call) or ast.unparse(loop.iter) != "range(3)"
    ]
    assert found == []
