# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The files that kernels are compiled from, and digests of them.

A kernel is compiled from its own file and from those that it imports, so machine code is known by
the digest of all of them: a callee that changed in another file makes another digest. Comments and
docstrings compile to nothing, and do not count.
"""

from __future__ import annotations

import ast
import functools
import hashlib
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1]
_NAME = PACKAGE.name


def path_of(module: str) -> Path | None:
    """Return the file of a module of this package; None: there is no such module."""
    base = PACKAGE.joinpath(*module.split(".")[1:])
    for path in (base.with_suffix(".py"), base / "__init__.py"):
        if path.is_file():
            return path
    return None


@functools.cache
def imports(module: str) -> frozenset[str]:
    """Return the modules of this package that a module imports when it is imported."""
    path = path_of(module)
    assert path is not None, module
    found: set[str] = set()
    _collect(ast.parse(path.read_bytes()).body, found)
    return frozenset(found)


def _collect(body: list[ast.stmt], found: set[str]) -> None:
    for statement in body:
        match statement:
            case ast.Import(names):
                found.update(alias.name for alias in names if path_of_ours(alias.name))
            case ast.ImportFrom(str() as module, names, 0) if path_of_ours(module):
                found.add(module)
                inner = (f"{module}.{alias.name}" for alias in names)
                found.update(each for each in inner if path_of_ours(each))
            case ast.If(test, then, other):
                if ast.unparse(test) != "TYPE_CHECKING":
                    _collect(then, found)
                _collect(other, found)


def path_of_ours(module: str) -> Path | None:
    """Return the file of a module of this package that kernels may be compiled from.

    What compiles them (:mod:`rs_localizer.native`) is no part of them.
    """
    first, _, rest = module.partition(".")
    is_tool = rest.partition(".")[0] == Path(__file__).parent.name
    return path_of(module) if first == _NAME and not is_tool else None


@functools.cache
def closure(module: str) -> frozenset[str]:
    """Return a module and all modules of this package that it imports, directly or not."""
    found, todo = {module}, [module]
    while todo:
        new = imports(todo.pop()) - found
        found |= new
        todo.extend(new)
    return frozenset(found)


@functools.cache
def digest_of_file(path: Path) -> str:
    """Return the SHA-256 digest of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


@functools.cache
def digest_of_code(path: Path) -> str:
    """Return the SHA-256 digest of a file's statements, without comments and docstrings."""
    tree = ast.parse(path.read_bytes())
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            node.body = [
                each for each in node.body
                if not (isinstance(each, ast.Expr) and isinstance(each.value, ast.Constant))
            ]  # fmt: skip
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest()


@functools.cache
def digest(module: str) -> str:
    """Return the digest of all sources that kernels of a module are compiled from."""
    return _digest_of(closure(module))


def _digest_of(modules: frozenset[str]) -> str:
    sha = hashlib.sha256()
    for each in sorted(modules):
        path = path_of(each)
        assert path is not None, each
        sha.update(f"{each} {digest_of_code(path)}\n".encode())
    return sha.hexdigest()


def kernel_modules() -> list[str]:
    """Return the modules of this package that declare entries, sorted by name."""
    return sorted(
        ".".join((_NAME, *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(
            ".__init__"
        )
        for path in PACKAGE.rglob("*.py")
        if b"\n@entry\n" in path.read_bytes()
    )


def digests() -> dict[str, str]:
    """Return the digest of each module that declares entries."""
    return {module: digest(module) for module in kernel_modules()}
