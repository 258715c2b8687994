# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The cache of compiled kernels: used when it is right, and never in the way when it is not."""

import contextlib
import importlib
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from rs_localizer.core.simd import compiler, jit

PACKAGE = Path(jit.__file__).parents[2]
KERNEL = """
from rs_localizer.core.simd.jit import kernel

@kernel
def double(x):
    return 2.0 * x

@kernel
def quadruple(x):
    return double(double(x))
"""
Load = Callable[[], Any]


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(jit, "_said", set())
    jit._is_ours.cache_clear()
    return tmp_path / "cache"


@pytest.fixture
def load(tmp_path, monkeypatch, cache) -> Load:
    """Makes the kernel as a new process would."""
    (tmp_path / "doubling.py").write_text(KERNEL)
    monkeypatch.syspath_prepend(tmp_path)

    def load() -> Any:
        sys.modules.pop("doubling", None)
        return importlib.import_module("doubling").double

    return load


def files(cache: Path, suffix: str) -> list[Path]:
    return sorted(cache.rglob(f"*{suffix}"))


def hits(compiled: Any) -> int:
    return sum(compiled.stats.cache_hits.values())


@contextlib.contextmanager
def full_disk() -> Iterator[None]:
    """No file may grow: what the system says of each write is what it says of a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_warm_cache_is_used_and_not_written(load, cache):
    assert load()(1.5) == 3.0
    assert len(files(cache, ".nbc")) == 1
    before = {path: path.stat().st_mtime_ns for path in cache.rglob("*")}
    with full_disk():  # nor could it be: as where it is read-only
        compiled = load()
        assert compiled(1.5) == 3.0
    assert hits(compiled) == 1
    assert {path: path.stat().st_mtime_ns for path in cache.rglob("*")} == before


def cut(content: bytes) -> bytes:
    return content[: len(content) // 2]


def zeros(content: bytes) -> bytes:
    """What some file systems leave after a power cut: the length, and not the content."""
    return bytes(len(content))


def one_bit(content: bytes) -> bytes:
    """In the middle of the machine code: it would load, and run."""
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


@pytest.mark.parametrize(
    ("suffix", "damage"),
    [
        (".nbc", cut), (".nbc", zeros), (".nbc", one_bit), (".nbc", lambda content: b""),
        (".nbi", cut), (".nbi", zeros), (".nbi", lambda content: b""),
    ],
)  # fmt: skip
def test_a_damaged_file_is_removed_and_compiled_anew(load, cache, suffix, damage):
    load()(1.5)
    (file,) = files(cache, suffix)
    file.write_bytes(damage(file.read_bytes()))
    compiled = load()
    with pytest.warns(RuntimeWarning, match="damaged files are compiled anew"):
        assert compiled(1.5) == 3.0
    assert hits(compiled) == 0
    again = load()
    assert again(1.5) == 3.0
    assert hits(again) == 1


def test_a_full_disk_is_a_warning(load, cache, recwarn):
    compiled = load()
    with full_disk():
        assert compiled(1.5) == 3.0
        assert compiled(2) == 4.0  # another type, another file: said once
    (said,) = recwarn
    assert "kernels are compiled again at the next start" in str(said.message)
    assert str(cache) in str(said.message)
    assert files(cache, ".nbc") == []


@pytest.mark.parametrize("shared", ["cache", "rs_localizer", "digest", "kernels"])
def test_a_cache_that_others_can_write_is_not_used(load, monkeypatch, shared):
    """Numba unpickles what is there: whoever writes it runs code in this process."""
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:  # pytest's own is nobody else's
        Path(folder).chmod(0o755)
        monkeypatch.setenv("XDG_CACHE_HOME", f"{folder}/cache")
        check_shared(load, Path(folder) / "cache", shared)


def check_shared(load: Load, cache: Path, shared: str) -> None:
    load()(1.5)
    kernels = files(cache, ".nbc")[0].parent
    assert {path.stat().st_mode & 0o777 for path in (kernels, kernels.parent)} == {0o700}
    folders = [cache, cache / "rs_localizer", kernels.parent, kernels]
    for folder in folders:
        folder.chmod(0o755)
    folders[["cache", "rs_localizer", "digest", "kernels"].index(shared)].chmod(0o777)
    before = files(cache, ".nbi")[0].read_bytes()
    jit._is_ours.cache_clear()
    compiled = load()
    with pytest.warns(RuntimeWarning, match="not used, since other users can write to"):
        assert compiled(1.5) == 3.0
    assert compiled(2) == 4.0  # said once
    assert hits(compiled) == 0
    assert files(cache, ".nbi")[0].read_bytes() == before


def test_a_kernel_is_compiled_anew_when_one_that_it_calls_changes(tmp_path, monkeypatch, cache):
    package = tmp_path / "changing"
    (package / "matching" / "deep").mkdir(parents=True)
    inner = package / "matching" / "deep" / "inner.py"
    (package / "matching" / "outer.py").write_text(
        "from changing.matching.deep.inner import inner\n"
        "from rs_localizer.core.simd.jit import kernel\n\n"
        "@kernel\ndef outer(x):\n    return 10.0 * inner(x)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(jit, "_PACKAGE", package)

    def outer(change: str) -> Any:
        # Of another size with each change: Python reads what the compiler's process has left in
        # __pycache__ as long as size and second are the same.
        inner.write_text(
            "from rs_localizer.core.simd.jit import kernel\n\n"
            f"@kernel\ndef inner(x):\n    return x + {change}\n"
        )
        compiler._compiler._end()  # as an update does, which comes between processes
        jit._digest.cache_clear()
        jit._stamp.cache_clear()
        importlib.invalidate_caches()
        for name in [name for name in sys.modules if name.startswith("changing")]:
            del sys.modules[name]
        return importlib.import_module("changing.matching.outer").outer

    assert outer("1.0")(1.0) == 20.0
    same = outer("1.0")
    assert same(1.0) == 20.0
    assert hits(same) == 1
    changed = outer("2.00")
    assert changed(1.0) == 30.0
    assert hits(changed) == 0
    jit._digest.cache_clear()


def test_every_folder_with_kernels_counts():
    using = {
        path.relative_to(PACKAGE).parts[0]
        for path in PACKAGE.rglob("*.py")
        if "import kernel" in path.read_text() or "import inlined" in path.read_text()
    }
    assert using == set(jit.PARTS)


DAY = 86400.0


def folder(cache: Path, name: str, days: float, inside: str = "rs_localizer.core.so3") -> Path:
    """A folder of kernels that was used some days ago."""
    made = cache / name
    (made / inside).mkdir(parents=True)
    (made / inside / "hat-1.py311.nbi").write_bytes(b"")
    os.utime(made, times=(time.time() - days * DAY,) * 2)
    return made


def test_what_nobody_used_for_a_month_is_removed(tmp_path):
    """What may be in use, or is somebody else's, stays."""
    jit._is_ours.cache_clear()
    old = folder(tmp_path, "0123456789abcdef", 31)
    staying = [
        folder(tmp_path, "1" * 16, 29),  # another version, still in use
        folder(tmp_path, "another_package_of_numba", 100),
        folder(tmp_path, "2" * 16, 100, inside="somebody.elses"),
    ]
    (tmp_path / "3333333333333333").write_text("a file")
    empty = tmp_path / ("4" * 16)  # of anybody
    empty.mkdir()
    os.utime(empty, times=(time.time() - 100 * DAY,) * 2)
    staying.append(empty)
    compiler._remove_old(tmp_path)
    assert not old.exists()
    assert all(path.is_dir() for path in staying)
    assert (tmp_path / "3333333333333333").is_file()
