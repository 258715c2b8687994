# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""All entries as one module of LLVM for one level, and the table by which C calls them.

Run by :mod:`rs_localizer.native.build` as a process of its own, with the level and a fixed seed of
hashes in its environment: Numba goes through sets, by whose order code would differ. It uses these
names of Numba that are private: ``CodeLibrary._final_module``, ``_get_module_for_linking``,
``_ensure_finalized``, ``_verify_declare_only_symbols``, ``JITCPUCodegen._add_module``,
``JITCodeLibrary._finalize_specific``. Hence the bounds of Numba in pyproject.toml.
"""

from __future__ import annotations

import importlib
import itertools
import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import llvmlite.binding as llvm
import numba.np.ufunc.array_exprs as array_exprs
from numba import types
from numba.core import codegen, ir
from numba.core.compiler_lock import global_compiler_lock
from numba.np import linalg

from rs_localizer.native import jit, sources
from rs_localizer.native.declared import CODES, declaration, encode

# A kernel whose bitcode is larger than this (bytes) is called where it is; copied into its callers,
# as Numba does with all, it would be optimized and translated once more for each.
_LARGE = 16000
_NOTHING = llvm.parse_assembly("").as_bitcode()
_MOST_SLOTS, _MOST_RESULT = 512, 2048  # as in runtime.c
_POINTER = 8


def main(folder: Path, cpu: str, triple: str, modules: Sequence[str] = ()) -> None:
    """Write ``kernels.o``, ``table.c`` and ``about.json`` into a folder.

    Args:
        cpu, triple: LLVM's names of the processor and the machine.
        modules: whose entries are compiled; of a test, a few.
    """
    _prepare()
    names = _import_all(modules or sources.kernel_modules())
    with _Linker() as linker:
        for i, name in enumerate(names):
            linker.add(name, i, len(names))
        merged = linker.merged()
    _emit(merged, folder, cpu, triple)
    (folder / "table.c").write_text(linker.table())


def _prepare() -> None:
    """Make Numba emit LLVM's modules only, and the same ones in every process."""
    codegen.JITCodeLibrary.get_pointer_to_function = lambda self, name: 0
    codegen.JITCPUCodegen._add_module = lambda self, module: None
    codegen.JITCodeLibrary._finalize_specific = lambda self: None
    codegen.JITCPUCodegen.set_env = lambda self, name, env: None
    codegen.CPUCodeLibrary._verify_declare_only_symbols = lambda self: None
    # Numba asks for SciPy, whose BLAS it would call: linear_algebra.cpp takes its place.
    linalg.ensure_blas = linalg.ensure_lapack = lambda: None
    # Names of files enter by messages, and the address of an expression by its name.
    made, root = ir.Loc.__init__, str(sources.PACKAGE.parent) + os.sep

    def relative(self: Any, filename: str, *rest: Any, **named: Any) -> None:
        short = filename.removeprefix(root)
        made(self, short if short != filename else Path(filename).name, *rest, **named)

    ir.Loc.__init__ = relative
    numbers: dict[int, int] = {}
    counter = itertools.count()
    array_exprs.hash = lambda expression: numbers.setdefault(hash(expression), next(counter))


def _import_all(modules: Sequence[str]) -> list[str]:
    for module in modules:
        importlib.import_module(module)
    return sorted(name for name in jit.ENTRIES if name.rpartition(".")[0] in modules)


class _Linker:
    """Compiles entries one after the other and keeps the modules that make them up."""

    def __init__(self) -> None:
        self._modules: list[bytes] = []
        self._texts: list[str] = []  # of the functions that C calls
        self._rows: list[str] = []
        self._externals: list[str] = []
        self._classes: list[Any] = []
        self._shared: dict[int, tuple[Any, Any]] = {}
        self._linked: set[int] = set()
        self._small: set[int] = set()

    def __enter__(self) -> _Linker:
        self._linking = codegen.CPUCodeLibrary._get_module_for_linking
        codegen.CPUCodeLibrary._get_module_for_linking = lambda library: self._for_linking(library)
        return self

    def __exit__(self, *_: object) -> None:
        codegen.CPUCodeLibrary._get_module_for_linking = self._linking

    def _for_linking(self, library: Any) -> Any:
        """Return the module that goes into a caller: an empty one for a large kernel."""
        if id(library) in self._shared:
            return self._shared[id(library)][1]
        module = self._linking(library)
        if id(library) in self._small:
            return module
        whole = library._final_module
        has_code = any(not function.is_declaration for function in whole.functions)
        if has_code and len(whole.as_bitcode()) > _LARGE and not library.name.startswith("nrt"):
            self._shared[id(library)] = library, llvm.parse_bitcode(_NOTHING)
            return self._shared[id(library)][1]
        self._small.add(id(library))
        return module

    def add(self, name: str, number: int, count: int) -> None:
        begun, dispatcher = time.process_time(), jit.ENTRIES[name]
        declared = declaration(dispatcher.py_func)
        signature = jit.signature(declared)
        dispatcher.compile(signature)
        result = dispatcher.overloads[signature]
        with global_compiler_lock:
            result.library._ensure_finalized()
        module, symbol = result.library._final_module.clone(), result.fndesc.llvm_func_name
        types_of = [str(each.type) for each in module.get_function(symbol).arguments]
        self._keep(result.library, module, {symbol})
        self._texts.append(_thunk(number, symbol, types_of))
        arguments = "".join(encode(kind, self._classes) for kind in declared.arguments.values())
        returned = _Result(self._classes, name).encode(result.signature.return_type)
        self._externals.append(f"extern Thunk rs_entry_{number};")
        self._rows.append(
            f'    {{"{name}", "{arguments}", {len(signature)}, "{returned}", rs_entry_{number}}},'
        )
        if len(types_of) - 2 > _MOST_SLOTS:
            raise TypeError(f"{name}: {len(types_of) - 2} numbers are more than {_MOST_SLOTS}")
        spent = time.process_time() - begun
        print(f"{number + 1:4} of {count}  {name}  {spent:.1f} s", flush=True)

    def _keep(self, library: Any, module: Any, symbols: set[str]) -> None:
        if id(library) in self._linked:
            return
        self._linked.add(id(library))
        for function in module.functions:
            if function.is_declaration:
                continue
            outside = function.name in symbols
            function.linkage = llvm.Linkage.external if outside else llvm.Linkage.internal
        for variable in module.global_variables:
            if variable.name.startswith("_ZN08NumbaEnv"):
                variable.linkage = llvm.Linkage.internal
        self._modules.append(module.as_bitcode())

    def merged(self) -> Any:
        """Return all modules in one, without unused functions."""
        for library, _ in list(self._shared.values()):
            with global_compiler_lock:
                library._ensure_finalized()
            module = library._final_module.clone()
            outside = {
                function.name
                for function in module.functions
                if not function.is_declaration
                and function.linkage == llvm.Linkage.external
                and not function.name.startswith("__excinfo_unwrap_args")
            }
            self._keep(library, module, outside)
        merged = llvm.parse_assembly("\n".join(dict.fromkeys(self._texts)))
        for bitcode in self._modules:
            merged.link_in(llvm.parse_bitcode(bitcode))
        return merged

    def table(self) -> str:
        """Return the C source of the module's table of entries."""
        return "\n".join([
            '#include "runtime.h"',
            *self._externals,
            "Class CLASSES[] = {",
            *(f'    {{"{it.__module__}", "{it.__qualname__}", NULL}},' for it in self._classes),
            "    {NULL, NULL, NULL},",
            "};",
            "const Entry ENTRIES[] = {",
            *self._rows,
            "    {NULL, NULL, 0, NULL, NULL},",
            "};",
            "",
        ])  # fmt: skip


def _thunk(number: int, symbol: str, types_of: list[str]) -> str:
    """Return LLVM's text of a function that takes arguments from one array of 64-bit slots."""
    lines, taken = (
        [f'declare i32 @"{symbol}"({", ".join(types_of)})'],
        ["ptr %result", "ptr %error"],
    )
    lines.append(f"define i32 @rs_entry_{number}(ptr %result, ptr %error, ptr %slots) {{")
    for i, kind in enumerate(types_of[2:]):
        lines.append(f"  %p{i} = getelementptr i64, ptr %slots, i64 {i}")
        if kind == "i8":
            lines.append(f"  %w{i} = load i64, ptr %p{i}")
            lines.append(f"  %v{i} = trunc i64 %w{i} to i8")
        else:
            lines.append(f"  %v{i} = load {kind}, ptr %p{i}")
        taken.append(f"{kind} %v{i}")
    lines += [f'  %code = call i32 @"{symbol}"({", ".join(taken)})', "  ret i32 %code", "}"]
    return "\n".join(lines)


class _Result:
    """Where in the memory of a result its parts lie, as C lays out a structure of them."""

    def __init__(self, classes: list[Any], name: str) -> None:
        self._classes, self._name = classes, name

    def encode(self, kind: Any, start: int = 0) -> str:
        """Encode a kind as ``declared.encode`` does, with a place in four digits behind each."""
        size, _ = self._layout(kind)
        if start == 0 and size > _MOST_RESULT:
            raise TypeError(f"{self._name}: a result of {size} bytes is more than {_MOST_RESULT}")
        if isinstance(kind, types.NoneType):
            return "n"
        if isinstance(kind, types.Array):
            return f"r{CODES[str(kind.dtype)]}{kind.ndim}{start:04}"
        if not isinstance(kind, types.BaseTuple):
            return f"{self._scalar(kind)}{start:04}"
        number = 99
        if isinstance(kind, types.BaseNamedTuple):
            named = kind.instance_class
            if named not in self._classes:
                self._classes.append(named)
            number = self._classes.index(named)
        parts, at = [], 0
        for part in kind:
            size, alignment = self._layout(part)
            at = -(-at // alignment) * alignment
            parts.append(self.encode(part, start + at))
            at += size
        return f"t{number:02}{len(parts):02}{''.join(parts)}"

    def _scalar(self, kind: Any) -> str:
        code = CODES.get("bool" if kind == types.boolean else str(kind), "")
        if code not in {"d", "q", "?"}:
            raise TypeError(f"{self._name} returns {kind}, which no entry can")
        return code

    def _layout(self, kind: Any) -> tuple[int, int]:
        """Return the size and alignment in bytes."""
        if isinstance(kind, types.Array):
            return _POINTER * (5 + 2 * kind.ndim), _POINTER
        if isinstance(kind, types.BaseTuple) and len(kind) > 0:
            at, most = 0, 1
            for size, alignment in map(self._layout, kind):
                at, most = -(-at // alignment) * alignment + size, max(most, alignment)
            return -(-at // most) * most, most
        return (1, 1) if kind == types.boolean else (_POINTER, _POINTER)


def _functions(module: Any) -> Iterator[Any]:
    return (function for function in module.functions if not function.is_declaration)


def _emit(merged: Any, folder: Path, cpu: str, triple: str) -> None:
    """Write one module of LLVM, and one object."""
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    machine = llvm.Target.from_triple(triple).create_target_machine(
        cpu=cpu, features="", opt=3, reloc="pic", codemodel="default"
    )
    merged.triple, merged.data_layout = triple, str(machine.target_data)
    for function in _functions(merged):
        if not function.name.startswith("rs_entry_"):
            function.linkage = llvm.Linkage.internal
    tuning = llvm.create_pipeline_tuning_options(speed_level=0)
    passes = llvm.create_new_module_pass_manager()
    passes.add_global_dead_code_eliminate_pass()
    passes.run(merged, llvm.create_pass_builder(machine, tuning))
    for function in _functions(merged):
        if function.linkage == llvm.Linkage.external:
            function.visibility = "hidden"
    merged.verify()
    (folder / "kernels.o").write_bytes(machine.emit_object(merged))
    count = sum(1 for _ in _functions(merged))
    (folder / "about.json").write_text(json.dumps({"functions": count, "cpu": cpu}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], sys.argv[3], sys.argv[4:])
