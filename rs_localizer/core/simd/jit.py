# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How kernels of this package are compiled and where the machine code is kept.

Numba's own cache, in one folder for each state of the sources. A kernel that is not there is
compiled by a process of its own (:mod:`rs_localizer.core.simd.compiler`) and loaded from there:
whoever compiled and whoever comes later run the same bits, and nobody keeps the memory of a
compiler. Who must not wait (:func:`at_once`) gets :class:`NotCompiled` meanwhile.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib
import importlib.util
import os
import pickle
import stat
import threading
import time
import warnings
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Self, TypeVar, cast

import llvmlite.binding
import numba
from numba.core.caching import CompileResultCacheImpl, FunctionCache, IndexDataCacheFile
from numba.core.codegen import JITCodeLibrary

from rs_localizer.core.simd import compiler
from rs_localizer.core.simd.compiler import Request

F = TypeVar("F", bound=Callable[..., Any])

if importlib.util.find_spec("scipy") is None:  # Numba would say so in the first kernel, and not why
    raise ModuleNotFoundError("No module named 'scipy', which compiled kernels need", name="scipy")

PARTS = ("core", "solvers", "estimation", "inertial", "matching", "markers", "tools")
"""Folders of the package with kernels; a kernel calls those of its own and of earlier ones."""

_PACKAGE = Path(__file__).resolve().parents[2]
# What reading a file that was cut off, overwritten or written by another program may raise.
_DAMAGE = (
    *(EOFError, ValueError, TypeError, KeyError, IndexError, AttributeError, ImportError),
    pickle.UnpicklingError,
)
_CHECKSUM_BYTES = 4
# A kernel whose object file is larger than this (bytes) is called where it is. Copied into its
# callers, as Numba does with all, it would be optimized and translated once more for each.
# Kernels of the default solver: 111 s without this, 94 s with; frames take as long.
_LARGE = 8192
# A module without a function.
_NOTHING = llvmlite.binding.parse_assembly("").as_bitcode()
_DAY = 86400.0
_OTHERS = stat.S_IWGRP | stat.S_IWOTH
_said: set[str] = set()


class NotCompiled(Exception):
    """A kernel is being compiled, and who called it must not wait."""


class _Missing(Exception):
    """A kernel is not in the cache."""


class _Thread(threading.local):
    waits = True  # for kernels that are not there
    asks = False  # whether the cache has a kernel
    # What is called whenever it has kept a kernel, if it compiles what it needs by itself.
    kept: Callable[[], None] | None = None
    compiles = False  # at present


_thread = _Thread()


@contextlib.contextmanager
def at_once() -> Iterator[None]:
    """Within ``with``, this thread waits for no compiler; kernels that lack are ordered.

    What calls one that is not there raises :class:`NotCompiled`.
    """
    before, _thread.waits = _thread.waits, False
    try:
        yield
    finally:
        _thread.waits = before


def compile_here(kept: Callable[[], None]) -> None:
    """From now on compile in this thread what is not in the cache.

    ``kept`` is called whenever a kernel has come into the cache; it may end the process.
    """
    _thread.kept = kept
    library: Any = JITCodeLibrary
    finalize = library._finalize_final_module

    def finalized(made: Any) -> None:
        _keep_copies(made)
        finalize(made)

    library._finalize_final_module = finalized


def _keep_copies(library: Any) -> None:
    """Have a kernel call its own copies of those that it calls.

    Numba leaves copies weak: the first that a process loads would serve all, and as each was
    optimized where it is, last digits would depend on the order of loading.
    """
    linkages, module = llvmlite.binding.Linkage, library._final_module
    library._shared_module = module.clone()  # for those that call this one, as Numba makes it
    for function in library._shared_module.functions:
        if not function.is_declaration and function.linkage == linkages.external:
            function.linkage = linkages.linkonce_odr
    for function in module.functions:
        if not function.is_declaration and function.linkage == linkages.linkonce_odr:
            function.linkage = linkages.internal


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


def make_folder(folder: Path) -> None:
    """Create a folder, and those above it, into which nobody else writes."""
    for path in (*reversed(folder.parents), folder):
        path.mkdir(0o700, exist_ok=True)


def digest(part: str, package: Path = _PACKAGE) -> str:
    """Digest of all sources that may be compiled into a kernel of this part.

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
    if Path(function.__code__.co_filename).is_file():  # not what was typed at a prompt
        compiled._cache = _Cache(function)
        if function.__module__.startswith(f"{_PACKAGE.name}.") and is_global(function):
            compiled.compile = functools.partial(_obtained, compiled, compiled.compile)
    return cast(F, compiled)


def is_global(function: Any) -> bool:
    """True if it can be looked up in its module; one that is made within a function cannot."""
    return "<locals>" not in function.__qualname__


def _obtained(compiled: Any, compile_or_load: Callable[..., Any], signature: Any) -> Any:
    """The entry point of a kernel: from the cache, where a process of its own compiles to."""
    if _thread.compiles:
        return compile_or_load(signature)
    if _thread.kept is not None:
        with compiler.alone():
            _thread.compiles = True
            try:
                return compile_or_load(signature)
            finally:
                _thread.compiles = False
    loaded = compiled.overloads.get(tuple(signature))
    if loaded is not None:
        return loaded.entry_point
    before, _thread.asks = _thread.asks, True
    try:
        return compile_or_load(signature)
    except _Missing:
        pass
    finally:
        _thread.asks = before
    request = Request(compiled.__module__, compiled.__qualname__, tuple(signature))
    # Not within Numba's lock, which other threads need to load what they have.
    if _thread.waits:
        compiler.obtain(request)
    elif compiler.order(request):
        raise NotCompiled(compiled.__qualname__)
    return compile_or_load(signature)  # or compiled here: which says what is wrong


class _Locator:
    """Numba's question where the machine code of a function is kept; the folder may be read-only.

    Numba's own locators take only folders into which they can write.
    """

    def __init__(self, function: Any, file: str) -> None:
        names = function.__module__.split(".")
        part = names[1] if names[0] == _PACKAGE.name and len(names) > 1 else ""
        self._py_file = file  # Numba's name, for its warnings
        self._directory = cache_directory() / _digest(part, _PACKAGE) / function.__module__
        self._line = function.__code__.co_firstlineno

    @classmethod
    def from_function(cls, function: Any, file: str) -> Self:
        return cls(function, file)

    def ensure_cache_path(self) -> None:
        make_folder(self._directory)

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
    """A kernel's callee was compiled again since, by a process beside this one."""


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


class _Cache(FunctionCache):
    """The machine code of a function on disk; whatever is wrong there, the function is compiled."""

    _impl_class = _Implementation

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        self._is_global = is_global(function)
        stamp = self._impl.locator.get_source_stamp()
        self._cache_file: _File = _File(self._cache_path, self._impl.filename_base, stamp)

    def holds(self, signature: Any, target: Any) -> bool:
        """True if a signature is there, by its files."""
        with contextlib.suppress(*_DAMAGE, OSError):
            _refresh_once(target)
            key = self._index_key(signature, target.codegen())
            return _is_ours(Path(self._cache_path)) and self._cache_file.load(key) is not None
        return False

    def load_overload(self, signature: Any, target: Any) -> Any:
        overload = None
        try:
            if _is_ours(Path(self._cache_path)):
                _refresh_once(target)
                overload = self._load_overload(signature, target)
        except _DAMAGE as error:
            if not isinstance(error, _AnotherCallee):
                _say(f"damaged files are compiled anew ({self._cache_path}: {error!r})")
            with contextlib.suppress(OSError):  # saving says what is wrong with the folder
                self.flush()
        except OSError:
            pass
        if overload is None and _thread.asks:
            raise _Missing
        return overload

    def save_overload(self, signature: Any, compiled: Any) -> None:
        if self._is_global and len(compiled.library._get_compiled_object()) > _LARGE:
            _call_where_it_is(compiled)
        if not _is_ours(Path(self._cache_path)):
            return
        try:
            super().save_overload(signature, compiled)
        except OSError as error:
            _say(f"kernels are compiled again at the next start: {error.strerror or error}")
            return
        if _thread.kept is not None:
            _thread.kept()


@functools.cache
def _refresh_once(target: Any) -> None:
    """Numba's run time and symbols, which it would look for anew with each kernel."""
    target.refresh()


@functools.cache
def _is_ours(folder: Path) -> bool:
    """True if nobody else puts files into a folder: what is there runs in this process.

    Marks the one above as used, once a day: :func:`compiler.serve` removes what nobody used.
    """
    with contextlib.suppress(OSError):  # what is not there yet will be made for this user
        for path in (folder, *folder.parents):
            about = path.stat()
            # In /tmp (sticky), nobody can replace what is another's.
            sticky = path != folder and about.st_mode & stat.S_ISVTX
            if about.st_uid not in {0, os.geteuid()} or (about.st_mode & _OTHERS and not sticky):
                _say(
                    f"not used, since other users can write to {path}: chmod -R go-w, or remove it"
                )
                return False
        if time.time() - folder.parent.stat().st_mtime > _DAY:
            os.utime(folder.parent)
    return True


def _say(text: str) -> None:
    """Warn, once of each kind and process."""
    kind = text.partition(" (")[0]
    if kind not in _said:
        _said.add(kind)
        warnings.warn(f"cache of kernels in {cache_directory()}: {text}", RuntimeWarning, 2)
