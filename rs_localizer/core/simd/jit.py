# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How kernels of this package are compiled and where the machine code is kept."""

from __future__ import annotations

import contextlib
import functools
import gc
import hashlib
import importlib
import importlib.util
import os
import pickle
import re
import shutil
import stat
import time
import warnings
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar, cast

import llvmlite.binding
import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile

from rs_localizer.core.simd import shipped

F = TypeVar("F", bound=Callable[..., Any])

if importlib.util.find_spec("scipy") is None:  # Numba would say so in the first kernel, and not why
    raise ModuleNotFoundError("No module named 'scipy', which compiled kernels need", name="scipy")

PARTS = (
    *("core", "solvers", "estimation", "inertial", "matching", "markers", "trajectory", "mapping"),
    "simulation",
)
"""Folders of the package with kernels; a kernel calls those of its own and of earlier ones."""

_PACKAGE = Path(__file__).resolve().parents[2]
# What reading a file that was cut off, overwritten or written by another program may raise.
_DAMAGE = (EOFError, ValueError, TypeError, KeyError, IndexError, AttributeError, ImportError)
_CHECKSUM_BYTES = 4
# A kernel whose object file is larger than this (bytes) is called where it is. Copied into its
# callers, as Numba does with all, it would be optimized and translated once more for each.
# Kernels of the default solver: 111 s without this, 94 s with; frames take as long.
_LARGE = 8192
# A module without a function.
_NOTHING = llvmlite.binding.parse_assembly("").as_bitcode()
_said: set[str] = set()
_DAY = 86400.0
# Kernels of other versions, in other environments, may be at work beside this one.
_KEPT = 30.0 * _DAY
_OURS = re.compile(r"[0-9a-f]{16}")


def cache_directory() -> Path:
    """The user's folder of compiled kernels: ``NUMBA_CACHE_DIR``, or below ``XDG_CACHE_HOME``."""
    config: Any = numba.config
    chosen = config.CACHE_DIR or os.environ.get("XDG_CACHE_HOME")
    if not chosen:
        try:
            chosen = Path.home() / ".cache"
        except RuntimeError:  # a user without a home, as in some containers
            chosen = "/nonexistent"
    return Path(chosen) if config.CACHE_DIR else Path(chosen) / "rs_localizer"


@functools.cache
def open_to_others(folder: Path) -> Path | None:
    """The first of a folder and those above it into which other users can put files.

    What is kept there runs in this process; a folder that is not there yet is made for its user.
    """
    users, hidden = {0, os.geteuid()}, False
    folder = folder.resolve()
    for path in (*reversed(folder.parents), folder):
        try:
            about = path.stat()
        except (FileNotFoundError, NotADirectoryError):
            return None
        except OSError:
            return path
        # In /tmp (sticky), nobody can replace what is another's.
        sticky = path != folder and about.st_mode & stat.S_ISVTX
        shared = about.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not sticky and not hidden
        if about.st_uid not in users or shared:
            return path
        hidden |= not about.st_mode & (stat.S_IXGRP | stat.S_IXOTH)
    return None


def digest(part: str, package: Path) -> str:
    """Of all sources that may be compiled into a kernel of this part.

    Numba notices a change of the file that holds a kernel, not of what the kernel calls in other
    files; after an update it would run the old code. Hence one folder per state of the sources.
    """
    parts = PARTS[: PARTS.index(part) + 1] if part in PARTS else PARTS
    sha = hashlib.sha256()
    for folder in parts:
        for file in sorted((package / folder).rglob("*.py")):
            sha.update(file.relative_to(package).as_posix().encode())
            sha.update(file.read_bytes())
    return sha.hexdigest()[:16]


_digest = functools.cache(digest)


@functools.cache
def _stamp(file: str) -> str:
    return hashlib.sha256(Path(file).read_bytes()).hexdigest()


def kernel(function: F) -> F:
    """Compile a function with Numba: cached on disk, without the GIL, NaN preserved."""
    return _compiled(function, "never")


def inlined(function: F) -> F:
    """A :func:`kernel` that one other calls, at one place: compiled as a part of it.

    By itself it would be compiled, optimized and kept on disk twice, once for nobody.
    """
    return _compiled(function, "always")


def _compiled(function: F, inline: str) -> F:
    njit: Any = numba.njit  # its type knows fewer options than it does
    compiled = njit(
        nogil=True,
        inline=inline,
        no_cfunc_wrapper=True,  # for C's callbacks, which nobody wants
        # Without it every division is checked for zero, which stops vectorization.
        error_model="numpy",
        # NaN and infinity keep their meaning: they mark lanes and points without a solution.
        fastmath={"contract", "reassoc", "nsz", "arcp"},
    )(function)
    template = compiled.get_call_template
    # Numba would compile a callee for every constant among its arguments, as often with all that
    # it calls.
    compiled.get_call_template = lambda positional, named: template(
        tuple(map(numba.types.unliteral, positional)),
        {name: numba.types.unliteral(kind) for name, kind in named.items()},
    )
    compiled.compile = _uncollected(compiled.compile)
    if Path(function.__code__.co_filename).is_file():  # not what was typed at a prompt
        compiled._cache = _Cache(function)
    return cast(F, compiled)


def _uncollected(compiler: Callable[..., Any]) -> Callable[..., Any]:
    """The same without collections of garbage, which look through all of what compilers keep.

    They took 13 s of 94 for the kernels of the default solver.
    """

    def compiled(signature: Any) -> Any:
        collects = gc.isenabled()
        gc.disable()
        try:
            return compiler(signature)
        finally:
            if collects:
                gc.enable()

    return compiled


class _Locator:
    """Numba's question where the machine code of a function is kept; the folder may be read-only.

    Numba's own locators take only folders into which they can write.
    """

    def __init__(self, function: Any, file: str) -> None:
        names = function.__module__.split(".")
        part = names[1] if names[0] == _PACKAGE.name and len(names) > 1 else ""
        self._py_file = file  # Numba's name, for its warnings
        self.folder = Path(_digest(part, _PACKAGE), function.__module__)
        self._directory = cache_directory() / self.folder
        self._line = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Any, file: str) -> Self:
        return cls(function, file)

    def ensure_cache_path(self) -> None:
        folder = self._directory
        for path in (*reversed(folder.relative_to(cache_directory().parent).parents), folder):
            (cache_directory().parent / path).mkdir(0o700, parents=True, exist_ok=True)
        _remove_others(folder.parent)

    def get_cache_path(self) -> str:
        return str(self._directory)

    def get_source_stamp(self) -> str:
        return _stamp(self._py_file)

    def get_disambiguator(self) -> str:
        return str(self._line)


class _Implementation(CompileResultCacheImpl):
    def __init__(self, function: Any) -> None:
        self._locator_classes = [_Locator]
        super().__init__(function)

    def rebuild(self, target: Any, stored: Any) -> Any:
        """A function as it was kept.

        Numba would read its intermediate code, too, and list what is in it: half of the time that a
        process needs for its kernels. Only who compiles a function that calls it wants that.
        """
        match stored:
            case ((str() as name, "object", (code, intermediate)), described, *rest):
                kept = (name, "object", (code, _NOTHING)), described, *rest
                target.codegen()._engine._defined_symbols.add(described.llvm_cpython_wrapper_name)
                rebuilt = super().rebuild(target, kept)
                rebuilt.library._reload_init.update(rebuilt.reload_init)
                if not intermediate:
                    _call_where_it_is(rebuilt)
                    return rebuilt
                rebuilt.library._get_module_for_linking = functools.cache(
                    functools.partial(_intermediate, target.codegen(), intermediate)
                )
                return rebuilt
        return super().rebuild(target, stored)


class _AnotherCallee(ValueError):
    """What a kernel in the cache calls was compiled again since, by a process beside this one."""


class _Called(NamedTuple):
    """A kernel that is called where it is: it has to be loaded before who calls it."""

    module: str
    name: str
    arguments: tuple[Any, ...]  # types
    symbol: str

    def __call__(self) -> None:
        kernel = getattr(importlib.import_module(self.module), self.name)
        kernel.compile(self.arguments)
        if kernel.overloads[self.arguments].fndesc.llvm_func_name != self.symbol:
            raise _AnotherCallee(f"{self.name} has been compiled anew")


def _call_where_it_is(compiled: Any) -> None:
    """Let those who call a kernel refer to its code, and load it before theirs."""
    about, library = compiled.fndesc, compiled.library
    library._get_module_for_linking = functools.partial(llvmlite.binding.parse_bitcode, _NOTHING)
    library.serialize_using_object_code = lambda: (
        library.name,
        "object",
        (library._get_compiled_object(), b""),
    )
    library._reload_init.add(
        _Called(about.modname, about.qualname, compiled.signature.args, about.llvm_func_name)
    )


def _intermediate(codegen: Any, bitcode: bytes) -> Any:
    module = llvmlite.binding.parse_bitcode(bitcode)
    codegen._engine._load_defined_symbols(module)
    return module


class _File(IndexDataCacheFile):
    """Machine code behind a checksum: half of it would run, and end the process."""

    def _save_data(self, name: str, data: Any) -> None:
        code = self._dump(data)
        with self._open_for_write(self._data_path(name)) as file:
            file.write(zlib.crc32(code).to_bytes(_CHECKSUM_BYTES, "little") + code)

    def _load_data(self, name: str) -> Any:
        content = Path(self._data_path(name)).read_bytes()
        code = content[_CHECKSUM_BYTES:]
        if zlib.crc32(code).to_bytes(_CHECKSUM_BYTES, "little") != content[:_CHECKSUM_BYTES]:
            raise ValueError("the checksum is wrong")
        return pickle.loads(code)

    def remove(self) -> None:
        """Remove the function's files, as far as that is allowed."""
        start = self._index_name.removesuffix("nbi")
        for path in Path(self._cache_path).glob(f"{start}*"):
            path.unlink(missing_ok=True)


class _Cache(FunctionCache):
    """The machine code of a function on disk; whatever is wrong there, the function is compiled."""

    _impl_class = _Implementation

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        locator = self._impl.locator
        # One that is made within a function cannot be looked up where its callers are loaded.
        self._is_global = "<locals>" not in function.__qualname__
        name, stamp = self._impl.filename_base, locator.get_source_stamp()
        self._cache_file: _File = _File(self._cache_path, name, stamp)
        self._shipped = _File(str(shipped.FOLDER / locator.folder), name, stamp)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """What came with the package, so that a machine's users get the same bits, else theirs."""
        overload = self._load_shipped(signature, target)
        return self._load_own(signature, target) if overload is None else overload

    def _load_own(self, signature: Any, target: Any) -> Any:
        if not self._is_own():
            return None
        try:
            overload = super().load_overload(signature, target)
            if overload is not None:
                _mark(Path(self._cache_path).parent)
            return overload
        except (*_DAMAGE, pickle.UnpicklingError) as error:
            if not isinstance(error, _AnotherCallee):
                _say(f"damaged files are compiled anew ({self._cache_file._index_path}: {error!r})")
            with contextlib.suppress(OSError):  # saving says what is wrong with the folder
                self._cache_file.remove()
        except OSError:
            pass
        return None

    def _load_shipped(self, signature: Any, target: Any) -> Any:
        if not shipped.FOLDER.is_dir():
            return None
        target.refresh()  # or the code would call a runtime that is not there yet
        try:
            for key in shipped.keys(self._index_key(signature, target.codegen())):
                machine_code = self._shipped.load(key)
                if machine_code is not None:
                    return self._impl.rebuild(target, machine_code)
        except (*_DAMAGE, pickle.UnpicklingError, OSError) as error:
            _say(f"what came with the package is damaged ({shipped.FOLDER}: {error!r})")
        return None

    def _is_own(self) -> bool:
        intruded = open_to_others(Path(self._cache_path))
        if intruded is not None:
            _say(
                f"not used, since other users can write to {intruded}: chmod -R go-w, or remove it"
            )
        return intruded is None

    def save_overload(self, signature: Any, compiled: Any) -> None:
        if self._is_global and len(compiled.library._get_compiled_object()) > _LARGE:
            _call_where_it_is(compiled)
        if not self._is_own():
            return
        try:
            super().save_overload(signature, compiled)
        except OSError as error:
            _say(f"kernels are compiled again at the next start: {error.strerror or error}")


@functools.cache
def _mark(folder: Path) -> None:
    """Note that a folder is in use: by its time of change, once a day."""
    with contextlib.suppress(OSError):  # which is not ours to write
        if time.time() - folder.stat().st_mtime > _DAY:
            os.utime(folder)


@functools.cache
def _remove_others(used: Path) -> None:
    """Remove the neighbours of a folder that have not been marked for a month.

    A process that still had one open compiles again what it has not loaded.
    """
    oldest = time.time() - _KEPT
    with contextlib.suppress(OSError):
        for folder in used.parent.iterdir():
            if folder != used and _holds_kernels(folder) and folder.stat().st_mtime < oldest:
                shutil.rmtree(folder, ignore_errors=True)


def _holds_kernels(folder: Path) -> bool:
    """Whether there are kernels of this package, and nothing else.

    ``NUMBA_CACHE_DIR`` is everybody's, and an empty folder may be anybody's.
    """
    if not _OURS.fullmatch(folder.name) or not folder.is_dir():
        return False
    names = [item.name for item in folder.iterdir()]
    return bool(names) and all(name.startswith("rs_localizer.") for name in names)


def _say(text: str) -> None:
    """Warn, once of each kind and process."""
    kind = text.partition(" (")[0]
    if kind not in _said:
        _said.add(kind)
        warnings.warn(f"cache of kernels in {cache_directory()}: {text}", RuntimeWarning, 2)
